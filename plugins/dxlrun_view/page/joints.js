// Table of the joints, with a slider for the goal of each joint where the page may steer.
import { $, isNew, make, setText } from "./dom.js";
import { act, lead } from "./requests.js";
import { conditionOf, isCommanded, isHot, scaleOf, shortOf, state, value, waitingText } from "./state.js";

const COLUMNS = [["Joint", "joint"], ["", "reach"], ["Position", ""], ["Goal", "goal"], ["Load", "load"], ["°C", ""], ["V", "wide"], ["Torque", ""]];
// The slider follows the goal again after this time, when the new goal has taken effect, ms.
const RELEASE_MS = 600;
let rows = [];

// `draw` is a function that adds or removes the curves of a joint.
export function drawJoints(draw) {
  const steer = Boolean(state.shown?.live && state.shown.control);
  const joints = [...state.joints.values()];
  if (isNew($("joints"), joints, steer)) {
    rows = joints.map((joint) => rowOf(joint, steer, draw));
    const head = make("tr", {}, ...COLUMNS.map(([textContent, className]) => make("th", { textContent, className })));
    const table = make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows.map((row) => row.element)));
    $("joints").replaceChildren(rows.length ? table : make("p", { className: "empty", textContent: waitingText() }));
  }
  rows.forEach(drawRow);
}

function rowOf(joint, steer, draw) {
  const cells = COLUMNS.map(([, className]) => make("td", { className }));
  const [name, reach, position, goal, load, heat, volts, torque] = cells;
  const parts = shortOf(joint.name).split(/(?<=_)/);
  name.append(...parts.flatMap((part) => [part, make("wbr")]));
  Object.assign(name, { tabIndex: 0, title: `${joint.name}: click to draw position and goal` });
  name.onclick = () => draw(joint.name);
  name.onkeydown = (event) => { if (event.key === "Enter") draw(joint.name); };
  const slider = steer && reach.appendChild(sliderOf(joint));
  const bar = !steer && reach.appendChild(make("span", { className: "bar-of-reach" }, make("b"), make("i")));
  const tag = torque.appendChild(make(steer ? "button" : "span", { className: "tag" }));
  if (steer) tag.onclick = () => act({ verb: "torque", joints: [joint.name], on: tag.textContent !== "on" });
  return { joint, element: make("tr", {}, ...cells), slider, bar, position, goal, load, heat, volts, tag };
}

function sliderOf({ name, lower, upper }) {
  const slider = make("input", { type: "range", min: lower, max: upper, step: "any" });
  slider.setAttribute("aria-label", `Goal of ${name}`);
  slider.oninput = () => { state.touching = name; lead(name, Number(slider.value)); };
  slider.onchange = slider.onpointerup = async () => {
    await lead(name, Number(slider.value));
    setTimeout(() => { if (state.touching === name) state.touching = null; }, RELEASE_MS);
  };
  return slider;
}

function drawRow({ joint, slider, bar, position, goal, load, heat, volts, tag }) {
  const of = (column) => value(`${joint.name}/${column}`);
  const show = (cell, shown, factor, digits, unit = "") => setText(cell, shown === null ? "–" : `${fixed(shown * factor, digits)}${unit}`);
  const [factor, unit] = scaleOf(`${joint.name}/position`), [effortFactor, effortUnit] = scaleOf(`${joint.name}/effort`);
  const is = of("position"), to = of("goal_position");
  show(position, is, factor, 1, unit === "deg" ? " °" : ` ${unit}`);
  show(goal, to, factor, 1);
  show(load, of("effort"), effortFactor, 1, ` ${effortUnit}`);
  show(heat, of("temperature"), 1, 0);
  show(volts, of("voltage"), 1, 1);
  goal.classList.toggle("hot", is !== null && to !== null && Math.abs(to - is) > (unit === "deg" ? 0.09 : 0.005));
  heat.classList.toggle("hot", isHot(joint.name));
  const [word, isFault] = conditionOf(joint.name);
  setText(tag, word);
  tag.className = `tag ${isFault ? "bad" : word}`;
  if (slider) {
    tag.title = word === "on" ? "Switch off the torque of this joint" : "Switch on the torque of this joint";
    // Without a known position, a slider would be drawn somewhere; without a controller, it would move nothing.
    slider.hidden = is === null && to === null;
    slider.disabled = !isCommanded(joint.name);
    slider.title = slider.disabled ? "No active controller commands the position of this joint; activate one" : "";
    if (state.touching !== joint.name) slider.value = to ?? is ?? 0;
  } else {
    const share = (angle) => `${Math.min(100, Math.max(0, (angle - joint.lower) / (joint.upper - joint.lower) * 100))}%`;
    [to, is].forEach((angle, at) => { bar.children[at].hidden = angle === null; bar.children[at].style.left = share(angle); });
  }
}

const fixed = (number, digits) => (Math.abs(number) < 0.05 ? 0 : number).toFixed(digits);
