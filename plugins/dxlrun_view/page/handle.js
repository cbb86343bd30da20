// Handle at the tip of an arm: it is dragged, the ghost shows the planned joints, and a button sends the pose.
import { $, isNew } from "./dom.js";
import { act } from "./requests.js";
import { state } from "./state.js";

let held = null; // {controller, tip, base} of the handle
let pose = null; // pose of the handle since it was dragged
let turned = false; // the orientation was dragged, too
let planned = null; // {pose, goal}: a pose, and the joint positions that were planned for it
let planning = false;

// Return the joint positions that the ghost shows before they are sent, or null.
export const trial = () => planned?.goal ?? null;

export function drawHandle(body) {
  const active = (name) => state.graph.some((one) => one.name === name && one.active);
  const handles = state.shown.control ? state.shown.handles.filter(({ controller, tip }) => active(controller) && body.robot.links[tip]) : [];
  $("handle").hidden = !handles.length;
  if (isNew($("handle"), handles)) $("handle").replaceChildren(new Option("Drag …", ""), ...handles.map(({ controller }) => new Option(controller, controller)));
  const chosen = handles.find(({ controller }) => controller === $("handle").value) ?? null;
  if (chosen?.controller !== held?.controller || Boolean(body.handle) !== Boolean(chosen)) {
    held = chosen;
    forget();
    body.grab(chosen);
    body.drag.setMode("translate");
    body.dragged = () => drag(body);
    $("turn").onclick = () => body.drag.setMode(body.drag.mode === "rotate" ? "translate" : "rotate");
  }
  if (held && !pose) body.moveGripToTip();
  for (const id of ["turn", "send"]) $(id).hidden = !held;
  $("send").disabled = !(pose && planned?.pose === pose && planned.goal);
  $("handle").dataset.place = held ? body.placeOfGrip() : ""; // where a test drags
}

function forget() {
  pose = planned = null;
  turned = false;
}

function drag({ grip, drag: { mode } }) {
  turned ||= mode === "rotate";
  pose = { position: grip.position.toArray(), quaternion: turned ? grip.quaternion.toArray() : null };
  if (!planning) plan().finally(() => { planning = false; });
}

// Plan the newest pose. One request is sent at a time, so that a fast hand does not queue old poses.
async function plan() {
  planning = true;
  while (pose && planned?.pose !== pose) {
    const asked = pose, done = await act({ verb: "plan", controller: held.controller, ...asked });
    if (pose) planned = { pose: asked, goal: Object.keys(done?.goal ?? {}).length ? done.goal : null };
  }
}

$("send").onclick = async () => {
  if (await act({ verb: "pose", controller: held.controller, ...pose })) forget();
};
