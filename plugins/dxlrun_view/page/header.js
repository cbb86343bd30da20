// Header of the page: name and phase, what a user needs first, buttons, and why there are no fresh values.
import { $, isNew, make, setText } from "./dom.js";
import { act, stop } from "./requests.js";
import { conditionOf, errorEvents, extreme, isHot, isLog, opensLog, rateOf, shortOf, state, value } from "./state.js";

const ALL = ["all"];

export function drawHeader(phase, reason) {
  const { shown, message } = state;
  const { robot = "dxlrun", paused = false } = shown?.info ?? {};
  document.title = shown ? `${robot} – dxlrun` : "dxlrun";
  setText($("robot"), robot);
  setText($("phase"), phase === "loading" ? (opensLog() ? "Reading" : "Waiting") : phase === "gone" ? "No data" : isLog() ? "Log" : paused ? "Paused" : "Live");
  setText($("kind"), isLog() ? (shown.every > 1 ? `1 of ${shown.every} cycles` : "") : shown?.control ? "Control" : shown ? "View only" : "");
  $("kind").title = shown?.live && !shown.control ? "To control the robot from this page, start `dxlrun view --control`" : "";
  setText($("banner"), reason);
  $("banner").hidden = !reason;
  const due = message && performance.now() < message.until;
  $("message").hidden = !due;
  if (due) { setText($("message"), message.text); $("message").classList.toggle("bad", message.bad); }
  drawFigures();
  drawButtons(paused);
}

function drawFigures() {
  const [lowest, hottest] = [extreme("voltage", -1), extreme("temperature")];
  const hot = [...state.joints.keys()].filter(isHot);
  const faults = [...state.joints.keys()].map((name) => [name, ...conditionOf(name)]).filter(([, , isFault]) => isFault);
  const events = errorEvents();
  const { rate = 0, skipped = 0 } = state.shown?.info ?? {};
  const late = value("loop/late"), measured = isLog() ? null : rateOf();
  const figures = [
    { name: "Voltage", text: lowest ? `${lowest[1].toFixed(1)} V` : "–", title: lowest && `Lowest: ${lowest[0]}` },
    { name: "Hottest servo", text: hottest ? `${hottest[1].toFixed(0)} °C` : "–", about: hottest && shortOf(hottest[0]), tone: hot.length && "bad", title: hot.length ? `Near the temperature limit: ${hot.join(", ")}` : hottest?.[0] },
    { name: "Errors", ...errorsOf(faults, events) },
    { name: "Rate", text: rate ? `${measured === null ? "" : `${measured.toFixed(0)} of `}${rate.toFixed(0)} Hz` : "–" },
    { name: "Late wake-up", text: late === null ? "–" : `${(late * 1e3).toFixed(2)} ms` },
    { name: "Skipped cycles", text: rate ? String(skipped) : "–" },
  ];
  const list = $("figures");
  if (isNew(list, figures.length)) {
    list.replaceChildren(...figures.map(({ name }) => make("div", {}, make("dt", { textContent: name }), make("dd", {}, make("b"), " ", make("small")))));
    list.children[2].onclick = () => document.querySelector("[data-tab=events]").click();
  }
  figures.forEach(({ text, about, tone, title }, at) => {
    const [figure, small] = list.children[at].lastChild.children;
    setText(figure, text); setText(small, about || "");
    figure.className = tone || "";
    list.children[at].title = title || "";
  });
}

function errorsOf(faults, events) {
  const title = [...faults.map(([name, word]) => `${name}: ${word}`), ...events.slice(-3).map(({ text }) => text), "Click to show the events"].join("\n");
  const [first, ...rest] = faults.length ? faults[0][1].split("; ") : [];
  if (first) return { text: rest.length ? `${first} + ${rest.length}` : first, about: faults.length > 1 ? `and ${faults.length - 1} more` : shortOf(faults[0][0]), tone: "bad", title };
  if (events.length) return { text: `${events.length} event${events.length > 1 ? "s" : ""}`, tone: "bad", title };
  return value("loop/cycle") === null ? { text: "–" } : { text: "None", tone: "good", title };
}

function drawButtons(paused) {
  const motions = state.shown?.motions ?? [];
  $("motion").hidden = !motions.length;
  if (isNew($("motion"), motions)) {
    $("motion").replaceChildren(new Option("Play …", ""), ...motions.map((file) => new Option(file.replace(/^.*\/|\.ya?ml$/g, ""), file)));
  }
  setText($("pause"), paused ? "Resume" : "Pause");
}

$("stop").onclick = stop;
$("halt").onclick = () => act({ verb: "halt" });
$("pause").onclick = () => act({ verb: state.shown.info.paused ? "resume" : "pause" });
$("torque-on").onclick = () => act({ verb: "torque", joints: ALL, on: true });
$("torque-off").onclick = () => act({ verb: "torque", joints: ALL, on: false });
$("motion").onchange = () => { if ($("motion").value) act({ verb: "play", motion: $("motion").value }); $("motion").value = ""; };
