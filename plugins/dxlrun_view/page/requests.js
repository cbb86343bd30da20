// Requests to the server of the page, and the actions of buttons and sliders.
import { state } from "./state.js";

const TOKEN = new URLSearchParams(location.search).get("token") ?? "";

// Send a request. Throws an Error with the reason if it is refused, or if the server has ended.
export async function ask(path, content) {
  const json = content === undefined ? {} : { "Content-Type": "application/json" };
  const answer = await fetch(path, {
    method: content === undefined ? "GET" : "POST",
    headers: { "X-Dxlrun-Token": TOKEN, ...json },
    body: content === undefined ? undefined : JSON.stringify(content),
  }).catch(() => { throw new Error("The server of this page has ended; start `dxlrun view` again, and open its new address."); });
  if (answer.ok) return answer;
  const { refused } = await answer.json().catch(() => ({ refused: `status ${answer.status}` }));
  throw new Error(refused);
}

// Show the result of an action for some seconds.
export function say(text, bad = false, seconds = 6) {
  state.message = { text, bad, until: performance.now() + seconds * 1000 };
}

// Perform an action. Returns the response, or null after a refusal, which is shown.
export async function act(action, quiet = false) {
  try {
    const done = await (await ask("act", action)).json();
    if (!quiet && done.said) say(done.said);
    return done;
  } catch (error) {
    say(error.message, true);
    return null;
  }
}

// Disable the torque of all joints.
export async function stop() {
  if (!(await act({ verb: "stop" }))) say(`STOP did not reach the robot; switch off its power. (${state.message.text})`, true, 60);
}

// Send the newest goal of a slider. One request is sent at a time, so that a fast slider does not queue old goals.
const goals = new Map();
let sending = null;
export function lead(joint, goal) {
  goals.set(joint, goal);
  return sending ??= sendGoals().finally(() => { sending = null; });
}

async function sendGoals() {
  while (goals.size) {
    const [[joint, position]] = goals;
    goals.delete(joint);
    if (!(await act({ verb: "goal", joint, position }, true))) goals.clear();
  }
}
