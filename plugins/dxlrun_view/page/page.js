// Main loop of the page: request the newest data, and draw them. A hidden page sends no requests.
import "./page.css";
import { Body } from "./body.js";
import { Charts, figure, isAngle } from "./charts.js";
import { drawControllers } from "./controllers.js";

const TOKEN = new URLSearchParams(location.search).get("token") ?? "";
const LOOK_MS = 40, CURVES_MS = 100, SHOWN_MS = 500;
const TORQUE = ["unknown", "on", "doubt", "limp", "limp", "lost", "rebooting", "given"];
const $ = (id) => document.getElementById(id);
const deg = 180 / Math.PI;

const page = { shown: null, joints: new Map(), places: {}, moment: null, after: 0, events: [], time: null, playing: false, rate: null, rates: [], touching: null };

async function ask(path, content) {
  const answer = await fetch(path, {
    method: content === undefined ? "GET" : "POST",
    headers: { "X-Dxlrun-Token": TOKEN, ...(content === undefined ? {} : { "Content-Type": "application/json" }) },
    body: content === undefined ? undefined : JSON.stringify(content),
  });
  if (!answer.ok) {
    const why = await answer.json().catch(() => ({ refused: `status ${answer.status}` }));
    throw new Error(why.refused);
  }
  return answer;
}

async function act(action, quiet) {
  try {
    const done = await (await ask("act", action)).json();
    if (!quiet && done.said) say(done.said);
    return done;
  } catch (error) {
    say(error.message, true);
    return null;
  }
}

let saidUntil = 0;
function say(text, bad = false, seconds = 6) {
  $("message").textContent = text;
  $("message").classList.toggle("bad", bad);
  $("message").hidden = !text;
  saidUntil = performance.now() + seconds * 1000;
}

// ---- drawing

const missingMeshes = new Set();
const body = webgl() && new Body($("scene"),
  async (path) => (await ask(`mesh?name=${encodeURIComponent(path)}`)).arrayBuffer(),
  (path) => { missingMeshes.add(path); say(`The URDF's mesh ${path} was not found beside the robot file; that part is not drawn.`, true); });
const charts = new Charts($("charts"), scaleOf);
charts.zoomed = () => pause(charts.zoom !== null);

function webgl() {
  try { return Boolean(document.createElement("canvas").getContext("webgl2")); } catch { return false; }
}

// Return the factor and the unit in which a column is displayed.
function scaleOf(name) {
  const [owner, column] = [name.slice(0, name.lastIndexOf("/")), name.slice(name.lastIndexOf("/") + 1)];
  const joint = page.joints.get(owner);
  if (name === "loop/late") return [1e3, "ms"];
  if (name in (page.shown?.units ?? {})) return [1, page.shown.units[name].replace("degC", "°C")];
  if (!joint && !(isAngle(name) && page.shown?.columns.includes(name))) return [1, ""];
  const linear = joint?.unit === "m";
  if (/position$/.test(column)) return linear ? [1e3, "mm"] : [deg, "deg"];
  if (/velocity$/.test(column)) return linear ? [1e3, "mm/s"] : [deg, "deg/s"];
  if (/effort$/.test(column)) return joint?.effortUnit ? [1, joint.effortUnit] : [100, "%"];
  return column === "temperature" ? [1, "°C"] : column === "voltage" ? [1, "V"] : [1, ""];
}

const value = (name) => { const found = page.moment?.values[page.places[name]]; return found === undefined ? null : found; };

async function arrived(shown) {
  const { info, live, control, problem } = shown;
  const first = page.shown?.run !== shown.run;
  page.shown = shown;
  if (first) {
    page.places = Object.fromEntries(shown.columns.map((name, at) => [name, at]));
    page.joints = new Map(info.joints.map((name) => [name, jointOf(info, name)]));
    page.rates = [];
    if (!charts.charts.length && shown.columns.length) charts.add(info.joints.length ? ["position", "goal_position"].map((column) => `${info.joints[0]}/${column}`) : ["loop/late"]);
    else for (const chart of charts.charts) chart.build();
    buildJoints();
    await loadBody();
    if (!live) buildTimeline();
  }
  fillNames();
  document.title = `${info.robot} – dxlrun`;
  document.body.classList.toggle("gone", Boolean(problem));
  $("robot").textContent = info.robot;
  $("kind").textContent = live ? (control ? "live, steered here" : "live") : `log${shown.every > 1 ? `, every ${shown.every}th cycle` : ""}`;
  $("stop").hidden = $("pause").hidden = !live;
  $("timeline").hidden = live;
  $("dot").className = `dot ${problem ? "bad" : info.paused ? "warn" : "good"}`;
  if (problem) say(problem, true, 1);
  buildButtons();
}

function jointOf({ units, effort_units, limits }, name) {
  const unit = units[name] ?? "rad", most = unit === "m" ? 0.1 : Math.PI;
  const [lower, upper] = limits[name] ?? [-most, most];
  return { name, unit, lower, upper, effortUnit: effort_units[name] ?? "" };
}

function fillNames() {
  const names = [...page.shown.columns.filter((name) => !/\/(mode|valid)$/.test(name)), ...page.shown.fields];
  if ($("names").children.length === names.length) return;
  $("names").replaceChildren(...names.map((name) => Object.assign(document.createElement("option"), { value: name })));
}

async function loadBody() {
  const text = await (await ask("urdf")).text();
  const why = !page.shown.run ? "waits for the robot …" : !body ? "This browser draws no 3-D (WebGL is off); curves and tables work."
    : text ? "" : "This robot has no URDF: its robot file names one by  model: {urdf: ...}. Curves and tables work.";
  $("no-scene").textContent = why;
  $("no-scene").hidden = !why;
  if (why) return;
  page.imu = `${page.shown.imu}/orientation.w` in page.places ? page.shown.imu : null;
  body.load(text, page.imu && page.shown.imu_link);
}

function buildButtons() {
  const { live, control, motions, info: { paused } } = page.shown;
  const wanted = live && control ? `${paused}|${motions.join()}` : "";
  if ($("buttons").dataset.made === wanted) return;
  $("buttons").dataset.made = wanted;
  $("buttons").replaceChildren();
  if (!live || !control) return;
  const add = (text, action, title) => {
    const button = Object.assign(document.createElement("button"), { textContent: text, type: "button", title });
    button.onclick = () => act(action);
    $("buttons").append(button);
  };
  if (motions.length) {
    const list = document.createElement("select");
    list.append(new Option("play …", ""), ...motions.map((file) => new Option(file.replace(/^.*\/|\.ya?ml$/g, ""), file)));
    list.onchange = () => { if (list.value) act({ verb: "play", motion: list.value }); list.value = ""; };
    $("buttons").append(list);
  }
  add("halt", { verb: "halt" }, "Bring every joint to rest within its limits, and hold");
  add(paused ? "resume" : "pause", { verb: paused ? "resume" : "pause" }, "Stop or go on with the controllers' time");
  add("torque on", { verb: "torque", joints: ["all"], on: true }, "Of all joints; each holds where it stands");
  add("torque off", { verb: "torque", joints: ["all"], on: false }, "Of all joints: they are limp");
}

// ---- joints

const rows = new Map();
function buildJoints() {
  const table = document.createElement("table");
  const heads = ["joint", "", "position", "goal", "load", "°C", "V", ""];
  table.createTHead().insertRow().append(...heads.map((text, at) => Object.assign(document.createElement("th"), { textContent: text, className: at === 4 ? "load" : [5, 6].includes(at) ? "wide" : "" })));
  const tbody = table.createTBody();
  rows.clear();
  for (const joint of page.joints.values()) {
    const cells = heads.map(() => document.createElement("td"));
    const [name, reach, position, goal, load, heat, volts, torque] = cells;
    load.className = "load"; heat.className = volts.className = "wide";
    const parts = joint.name.replace(/_joint$/, "").split(/(?<=_)/);
    name.append(...parts.flatMap((part) => [part, document.createElement("wbr")])); name.className = "joint"; name.tabIndex = 0;
    name.title = `${joint.name}; click: curve of position and goal`;
    name.onclick = () => { charts.toggle(`${joint.name}/position`); charts.toggle(`${joint.name}/goal_position`); };
    name.onkeydown = (event) => { if (event.key === "Enter") name.onclick(); };
    let slider = null, is = null, to = null;
    if (page.shown.control && page.shown.live) {
      slider = Object.assign(document.createElement("input"), { type: "range", min: joint.lower, max: joint.upper, step: "any" });
      slider.setAttribute("aria-label", `goal of ${joint.name}`);
      slider.oninput = () => { page.touching = joint.name; lead(joint.name, Number(slider.value)); };
      slider.onchange = slider.onpointerup = async () => {
        await lead(joint.name, Number(slider.value));
        // The slider follows the goal again after 600 ms, when the new goal has taken effect.
        setTimeout(() => { if (page.touching === joint.name) page.touching = null; }, 600);
      };
      reach.append(slider);
    } else {
      const bar = reach.appendChild(document.createElement("span"));
      bar.className = "reach";
      to = bar.appendChild(document.createElement("b")); is = bar.appendChild(document.createElement("i"));
    }
    const tag = torque.appendChild(document.createElement(slider ? "button" : "span"));
    tag.className = "tag";
    if (slider) tag.onclick = () => act({ verb: "torque", joints: [joint.name], on: tag.textContent !== "on" });
    tbody.insertRow().append(...cells);
    rows.set(joint.name, { joint, slider, is, to, position, goal, load, heat, volts, tag });
  }
  $("joints").replaceChildren(rows.size ? table : Object.assign(document.createElement("p"), { className: "empty", textContent: "waits for the robot …" }));
}

// Send the newest goal of a slider. One request is sent at a time, so that a fast slider does not queue old goals.
const goals = new Map();
let leading = null;
function lead(joint, goal) {
  goals.set(joint, goal);
  return leading ??= led().finally(() => { leading = null; });
}

async function led() {
  while (goals.size) {
    const [[name, to]] = goals;
    goals.delete(name);
    if (!(await act({ verb: "goal", joint: name, position: to }, true))) goals.clear();
  }
}

function drawJoints() {
  const set = (cell, text) => { if (cell.textContent !== text) cell.textContent = text; };
  for (const [name, row] of rows) {
    const { lower, upper } = row.joint;
    const [factor, unit] = scaleOf(`${name}/position`);
    const position = value(`${name}/position`), goal = value(`${name}/goal_position`), effort = value(`${name}/effort`);
    const share = (angle) => `${Math.min(100, Math.max(0, (angle - lower) / (upper - lower) * 100))}%`;
    set(row.position, position === null ? "–" : `${figure1(position * factor)} ${unit === "deg" ? "°" : unit}`);
    set(row.goal, goal === null ? "–" : `${figure1(goal * factor)}`);
    const beyond = goal !== null && position !== null && Math.abs(goal - position) > (unit === "deg" ? 0.09 : 0.005);
    row.goal.classList.toggle("hot", beyond);
    if (row.is) { row.is.style.left = share(position ?? lower); row.to.style.left = share(goal ?? position ?? lower); row.to.hidden = goal === null; }
    if (row.slider && page.touching !== name) row.slider.value = goal ?? position ?? 0;
    const [by, effortUnit] = scaleOf(`${name}/effort`);
    set(row.load, effort === null ? "–" : `${figure1(effort * by)} ${effortUnit}`);
    const heat = value(`${name}/temperature`), volts = value(`${name}/voltage`);
    set(row.heat, heat === null ? "–" : heat.toFixed(0)); row.heat.classList.toggle("hot", heat >= 65);
    set(row.volts, volts === null ? "–" : volts.toFixed(1));
    const fault = value(`${name}/hardware_error`), torque = TORQUE[value(`${name}/torque`) ?? 0];
    set(row.tag, fault ? `error ${fault}` : torque);
    row.tag.className = `tag ${fault ? "error" : torque}`;
  }
}
const figure1 = (number) => (Math.abs(number) < 0.05 ? 0 : number).toFixed(1);

// ---- events, figures, body

function drawEvents(fresh) {
  if (!fresh.length) return;
  page.events.push(...fresh);
  page.after = fresh[fresh.length - 1].number;
  page.events.splice(0, page.events.length - 400);
  const list = $("events").querySelector("ul") ?? $("events").appendChild(document.createElement("ul"));
  for (const event of fresh) {
    const item = document.createElement("li");
    item.className = event.severity >= 40 ? "bad" : event.severity >= 30 ? "warn" : "";
    const time = Object.assign(document.createElement("time"), { textContent: `${event.run_time.toFixed(2)} s` });
    const source = Object.assign(document.createElement("span"), { textContent: event.source });
    item.append(time, source, Object.assign(document.createElement("p"), { textContent: event.text }));
    if (!page.shown?.live) { item.classList.add("far"); item.onclick = () => jump(event.time); }
    list.prepend(item);
  }
  while (list.children.length > 400) list.lastChild.remove();
}

function drawFigures() {
  const { shown, moment } = page;
  const cycle = value("loop/cycle"), late = value("loop/late");
  if (shown.live && cycle !== null) {
    page.rates.push([moment.time, cycle]);
    while (page.rates.length > 2 && page.rates[0][0] < moment.time - 2) page.rates.shift();
    const [[t0, c0]] = page.rates;
    if (moment.time > t0) page.rate = (cycle - c0) / (moment.time - t0);
  }
  const { rate, skipped } = shown.info;
  const rows = [["rate", shown.live ? `${page.rate === null ? "–" : page.rate.toFixed(0)} of ${rate.toFixed(0)} Hz` : `${rate.toFixed(0)} Hz`],
    ["woke up late", `${((late ?? 0) * 1e3).toFixed(2)} ms`], ["skipped", String(skipped)], ["cycle", cycle === null ? "–" : cycle.toFixed(0)]];
  const list = $("figures");
  if (list.children.length !== rows.length) {
    list.replaceChildren(...rows.map(([name]) => {
      const pair = document.createElement("div");
      pair.append(Object.assign(document.createElement("dt"), { textContent: name }), document.createElement("dd"));
      return pair;
    }));
  }
  rows.forEach(([, text], at) => { const cell = list.children[at].lastChild; if (cell.textContent !== text) cell.textContent = text; });
}

// Draw the controllers that are active at the cursor of the time line, or now.
function drawGraph() {
  for (const one of page.shown.info.controllers) one.active = Boolean(value(`${one.name}/active`) ?? one.active);
  const graph = JSON.stringify(page.shown.info.controllers);
  if (graph === page.graph) return;
  page.graph = graph;
  drawControllers($("controllers"), page.shown, act);
}

function drawBody() {
  if (!body?.robot) return;
  const positions = {}, goals = {};
  for (const name of page.joints.keys()) {
    positions[name] = value(`${name}/position`);
    goals[name] = value(`${name}/goal_position`) ?? positions[name];
  }
  const turn = page.imu ? ["x", "y", "z", "w"].map((axis) => value(`${page.imu}/orientation.${axis}`)) : null;
  body.showGhost = $("ghost").checked;
  body.pose(positions, goals, turn?.every((one) => one !== null) ? turn : null);
}

// ---- a log's time line

let newestTime = 0;
function buildTimeline() {
  const [begin, end] = page.shown.span;
  page.time ??= begin;
  Object.assign($("time"), { min: begin, max: end, value: page.time });
  offer("worst cycles", page.shown.marks);
}

// Add a group of times to the jump menu.
function offer(label, places) {
  if (!places.length) return;
  const group = $("jump").appendChild(Object.assign(document.createElement("optgroup"), { label }));
  group.append(...places.map(({ time, what }) => new Option(`${time.toFixed(2)} s: ${what}`.slice(0, 70), time)));
}

function markEvents() {
  const [begin, end] = page.shown.span;
  const severe = page.events.filter((event) => event.severity >= 30);
  $("marks").replaceChildren(...severe.map((event) => {
    const mark = document.createElement("i");
    mark.style.left = `${(event.time - begin) / (end - begin) * 100}%`;
    mark.className = event.severity >= 40 ? "bad" : "";
    mark.title = event.text;
    return mark;
  }));
  offer("warnings", severe.slice(0, 40).map(({ time, text }) => ({ time, what: text })));
}

function jump(time) {
  page.time = Math.min(Math.max(time, page.shown.span[0]), page.shown.span[1]);
  pause(false);
}

function pause(paused) {
  charts.zoom = paused ? charts.span(centre()) : null;
  $("pause").textContent = paused ? "go on" : "pause";
  curvesDue = 0;
}

// ---- the loop

let curvesDue = 0, shownDue = 0, failures = 0;
// Newest time of the plots, s.
const centre = () => (page.shown.live ? newestTime : page.time + charts.seconds / 2);
async function look() {
  const now = performance.now();
  const log = page.shown && !page.shown.live;
  if (log && page.playing) {
    page.time = Math.min(page.time + (now - (page.clock ?? now)) / 1000 * Number($("speed").value), page.shown.span[1]);
    if (page.time >= page.shown.span[1]) play(false);
  }
  page.clock = now;
  const wantsCurves = page.shown && now >= curvesDue && (!log || page.time !== page.drawn || curvesDue === 0);
  const newest = wantsCurves && centre();
  const spans = wantsCurves ? charts.spans(newest) : [];
  const names = charts.charts.map((one) => one.names.join());
  const seen = await (await ask("look", { time: log ? page.time : null, after: page.after, shown: now >= shownDue, spans })).json();
  if (seen.shown) { shownDue = now + (log ? 1e9 : SHOWN_MS); await arrived(seen.shown); }
  if (log && page.time === null) page.time = seen.moment.time;
  if (!page.shown) return;
  page.moment = seen.moment;
  if (!log && seen.moment.values.length) newestTime = seen.moment.time;
  if (seen.events.length) { drawEvents(seen.events); if (log) markEvents(); }
  if (wantsCurves) {
    curvesDue = now + CURVES_MS;
    page.drawn = page.time;
    if (names.join(";") === charts.charts.map((one) => one.names.join()).join(";")) charts.draw(seen.curves, newest, log ? page.time : undefined);
  }
  drawFigures(); drawJoints(); drawGraph(); drawBody();
  if (log) { if (document.activeElement !== $("time")) $("time").value = page.time; $("now").textContent = `${page.time.toFixed(2)} of ${page.shown.span[1].toFixed(1)} s`; }
  if (performance.now() > saidUntil && !$("message").hidden) say("");
}

async function follow() {
  for (;;) {
    if (document.hidden) await new Promise((awake) => document.addEventListener("visibilitychange", awake, { once: true }));
    const began = performance.now();
    try {
      await look();
      failures = 0;
    } catch (error) {
      failures += 1;
      $("dot").className = "dot bad";
      const gone = error instanceof TypeError;
      say(gone ? "`dxlrun view` has ended; start it again, and open its new address." : error.message, true, 3);
    }
    window.looked = (window.looked ?? 0) + 1;
    await new Promise((next) => setTimeout(next, failures ? 1000 : Math.max(4, LOOK_MS - (performance.now() - began))));
  }
}

function play(playing) {
  if (playing && page.time >= page.shown.span[1]) page.time = page.shown.span[0];
  page.playing = playing;
  pause(false);
  $("play").textContent = playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
}

$("stop").onclick = () => act({ verb: "stop" });
$("pause").onclick = () => pause(charts.zoom === null);
$("window").onchange = () => { charts.seconds = Number($("window").value); pause(false); };
$("another").onclick = () => charts.add();
$("fit").onclick = () => body?.fit();
$("play").onclick = () => play(!page.playing);
$("time").oninput = () => jump(Number($("time").value));
$("jump").onchange = () => { if ($("jump").value) jump(Number($("jump").value)); $("jump").value = ""; };
$("pick").onchange = () => {
  const name = $("pick").value.trim();
  if (name && (name in page.places || page.shown.fields.includes(name))) { charts.toggle(name); $("pick").value = ""; curvesDue = 0; } else if (name) say(`there is no curve ${name}`, true);
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
  if (event.key === "Escape" && page.shown?.live) act({ verb: "stop" });
  if (event.key === " " && page.shown && !page.shown.live && event.target === document.body) { event.preventDefault(); play(!page.playing); }
});
if (!TOKEN) say("The address lacks the page's token: open the one that `dxlrun view` printed.", true, 1e6);
follow();
