// Main loop of the page: request the newest data, note them in the state, and draw the page from it.
import "./page.css";
import { Body } from "./body.js";
import { Charts } from "./charts.js";
import { drawControllers } from "./controllers.js";
import { $, isNew, make } from "./dom.js";
import { drawEvents, drawTimeline } from "./events.js";
import { drawHandle, trial } from "./handle.js";
import { drawHeader } from "./header.js";
import { drawJoints } from "./joints.js";
import { act, ask, say, stop } from "./requests.js";
import { isLog, note, phaseOf, reasonOf, scaleOf, state, value, waitingText } from "./state.js";

const LOOK_MS = 40, CURVES_MS = 100, SHOWN_MS = 500, RETRY_MS = 1000;
const POSITION = ["position", "goal_position"];

const body = hasWebgl() && new Body($("scene"),
  async (path) => (await ask(`mesh?name=${encodeURIComponent(path)}`)).arrayBuffer(),
  (error) => say(`A link is not drawn: ${error.message}`, true));
const charts = new Charts($("charts"), scaleOf);
charts.zoomed = () => freeze(charts.zoom !== null);
let curvesDue = 0, shownDue = 0, clock = 0, drawn = "";

function hasWebgl() {
  try { return Boolean(document.createElement("canvas").getContext("webgl2")); } catch { return false; }
}

// ---- drawing

// Draw everything from the state. The phase decides what is shown, and whether a control can be used.
function draw() {
  const { shown } = state;
  const phase = phaseOf(performance.now());
  Object.assign(document.body.dataset, { phase, source: shown ? (shown.live ? "live" : "log") : "", control: Boolean(shown?.control) });
  for (const controls of document.querySelectorAll("fieldset")) controls.disabled = phase !== "live";
  drawHeader(phase, reasonOf(phase));
  drawJoints(toggleJoint);
  drawControllers($("controllers"), state, act);
  drawEvents(jump);
  drawTimeline();
  drawBody();
  drawPlots();
}

function drawPlots() {
  const { shown, joints } = state;
  if (!shown?.columns.length) return;
  $("freeze").textContent = charts.zoom ? "Follow" : "Freeze";
  const [first] = joints.keys();
  if (!charts.charts.length) charts.add(first ? POSITION.map((column) => `${first}/${column}`) : ["loop/late"]);
  else if (isNew($("charts"), shown.run)) charts.build();
  const names = [...shown.columns.filter((name) => !/\/(mode|valid)$/.test(name)), ...shown.fields];
  if (isNew($("names"), names)) $("names").replaceChildren(...names.map((name) => make("option", { value: name })));
}

function toggleJoint(joint) {
  for (const column of POSITION) charts.toggle(`${joint}/${column}`);
}

function drawBody() {
  const { shown, joints } = state;
  if (isNew($("scene"), shown?.run, Boolean(shown?.columns.length))) loadBody().catch(() => { delete $("scene").shownKey; });
  if (!body?.robot) return;
  const positions = {}, goals = {};
  for (const name of joints.keys()) {
    positions[name] = value(`${name}/position`);
    goals[name] = value(`${name}/goal_position`) ?? positions[name];
  }
  drawHandle(body);
  Object.assign(goals, trial());
  const turn = ["x", "y", "z", "w"].map((axis) => value(`${shown.imu}/orientation.${axis}`));
  body.showGhost = $("ghost").checked || Boolean(trial());
  body.pose(positions, goals, turn.includes(null) ? null : turn);
}

async function loadBody() {
  const { shown, places } = state;
  const urdf = shown?.columns.length ? await (await ask("urdf")).text() : "";
  const why = !shown?.columns.length ? waitingText() : !body ? "No 3-D view, because WebGL is off in this browser. Curves and tables work."
    : urdf ? "" : "No 3-D view, because the robot has no URDF. Add model: {urdf: FILE} to the robot file.";
  $("no-scene").textContent = why;
  $("no-scene").hidden = !why;
  if (!why) body.load(urdf, `${shown.imu}/orientation.w` in places && shown.imu_link);
}

// ---- the loop

// Return the newest time of the plots, s.
const newestTime = () => (isLog() ? state.time + charts.seconds / 2 : state.moment?.time ?? 0);

async function look() {
  const now = performance.now(), log = isLog();
  if (log && state.playing) {
    state.time = Math.min(state.time + (now - clock) / 1000 * Number($("speed").value), state.shown.span[1]);
    state.playing = state.time < state.shown.span[1];
  }
  clock = now;
  const newest = newestTime(), spans = charts.spans(newest), plots = JSON.stringify([charts.builds, spans]);
  const wanted = now >= curvesDue && plots !== drawn, { builds } = charts;
  const asked = { time: log ? state.time : null, after: state.events.at(-1)?.number ?? 0, shown: now >= shownDue, spans: wanted ? spans : [] };
  const seen = await (await ask("look", asked)).json();
  if (seen.shown) shownDue = now + (seen.shown.live ? SHOWN_MS : Infinity);
  note(seen, performance.now());
  // A plot may have been changed while the request was under way.
  if (!wanted || builds !== charts.builds) return;
  [curvesDue, drawn] = [now + CURVES_MS, plots];
  charts.draw(seen.curves, newest, log ? state.time : undefined);
}

// Look for new data until the page is closed. A hidden page sends no requests.
async function follow() {
  draw();
  for (;;) {
    if (document.hidden) {
      await new Promise((awake) => document.addEventListener("visibilitychange", awake, { once: true }));
      state.freshAt = performance.now();
    }
    const began = performance.now();
    await look().catch((error) => { state.failure = error.message; });
    draw();
    window.looked = (window.looked ?? 0) + 1;
    await new Promise((next) => setTimeout(next, state.failure ? RETRY_MS : Math.max(4, LOOK_MS - (performance.now() - began))));
  }
}

// ---- controls of the page itself; those that steer the robot are in header.js, joints.js and controllers.js

function freeze(frozen) {
  charts.zoom = frozen ? charts.span(newestTime()) : null;
}

function jump(time) {
  state.time = Math.min(Math.max(time, state.shown.span[0]), state.shown.span[1]);
  freeze(false);
}

function play() {
  state.playing = !state.playing;
  jump(state.time >= state.shown.span[1] ? state.shown.span[0] : state.time);
}

$("freeze").onclick = () => freeze(charts.zoom === null);
$("window").onchange = () => { charts.seconds = Number($("window").value); freeze(false); };
$("another").onclick = () => charts.add();
$("fit").onclick = () => body?.fit();
$("play").onclick = play;
$("time").oninput = () => jump(Number($("time").value));
$("jump").onchange = () => { if ($("jump").value) jump(Number($("jump").value)); $("jump").value = ""; };
$("pick").onchange = () => {
  const name = $("pick").value.trim();
  if (name in state.places || state.shown?.fields.includes(name)) { charts.toggle(name); $("pick").value = ""; } else if (name) say(`Curve ${name} not found; choose one from the list.`, true);
};
for (const tab of document.querySelectorAll("#tabs button")) {
  tab.onclick = () => {
    for (const other of document.querySelectorAll("#tabs button")) {
      other.setAttribute("aria-selected", other === tab);
      const pane = $(other.dataset.tab);
      if (pane) pane.hidden = other !== tab;
    }
    document.querySelector("main").classList.toggle("curves", tab.dataset.tab === "curves");
  };
}
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && state.shown?.live) stop();
  if (event.key === " " && isLog() && event.target === document.body) { event.preventDefault(); play(); }
});
follow();
