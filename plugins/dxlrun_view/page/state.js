// State of the page. The server's answers and the clicks change it; everything on the page is drawn from it.
export const TORQUE = ["unknown", "on", "doubt", "limp", "limp", "lost", "rebooting", "given"];
// A servo is hot from this difference to its temperature limit on, °C. The run warns from the same temperature.
const HOT_BELOW_C = 10;
// Temperature from which a servo with an unknown limit is hot, °C: the lowest limit of all models (XL-320).
const HOT_C = 65;
// Time without a new cycle after which the values are stale: longer than any pause of a run on a busy machine, ms.
const STALE_MS = 2000;
const RATE_S = 2;
const DEGREES = 180 / Math.PI;

export const state = {
  shown: null, // properties that rarely change: robot, joints, controllers, motions, problem
  moment: null, // time and values of all columns
  failure: "", // why the last request failed
  freshAt: 0, // when the newest cycle arrived, on the clock of performance.now(), ms
  events: [],
  message: null, // result of the last action: {text, bad, until}
  time: null, playing: false, // position on the time line of a log, s
  touching: null, // joint whose slider is held
  errors: {}, // hardware errors in words, by joint
  places: {}, joints: new Map(), cycles: [], graph: [],
};

export const isLog = () => state.shown?.live === false;

// Return true if the page opens a log; known before the first response, because the server writes it into the page.
export const opensLog = () => document.body.dataset.opens === "log";

// Return the text in place of data before the first values.
export const waitingText = () => (opensLog() ? "Reading the log …" : "Waiting for the robot …");

// Return "loading" before the first values, "live" while they are fresh, and "gone" when no new ones arrive.
export function phaseOf(now) {
  const { shown, moment, failure, freshAt } = state;
  if (!shown?.columns.length || !moment?.values.length) return "loading";
  const stale = shown.live && now - freshAt > Math.max(STALE_MS, 5000 / shown.info.rate);
  return failure || shown.problem || stale ? "gone" : "live";
}

// Return why there are no fresh values.
export function reasonOf(phase) {
  const { shown, failure } = state;
  if (phase === "live") return "";
  return failure || shown?.problem || (phase === "gone" ? `No new cycles from ${shown.info.robot}; check its terminal.` : "");
}

// Note a response of the server to `look`.
export function note({ shown, moment, events, errors }, now) {
  Object.assign(state, { failure: "", errors });
  if (shown) {
    if (state.shown?.run !== shown.run || state.shown.columns.join() !== shown.columns.join()) begin(shown);
    state.shown = shown;
  }
  if (moment.time !== state.moment?.time) state.freshAt = now;
  state.moment = moment;
  state.events = [...state.events, ...events].slice(-400);
  if (state.shown && isLog()) state.time ??= state.shown.span[0];
  state.graph = (state.shown?.info.controllers ?? []).map((one) => ({ ...one, active: Boolean(value(`${one.name}/active`) ?? one.active) }));
  const cycle = value("loop/cycle");
  if (cycle !== null) state.cycles.push([moment.time, cycle]);
  while (state.cycles.length > 2 && state.cycles[0][0] < moment.time - RATE_S) state.cycles.shift();
}

function begin({ info, columns }) {
  state.places = Object.fromEntries(columns.map((name, at) => [name, at]));
  state.joints = new Map(info.joints.map((name) => {
    const unit = info.units[name] ?? "rad", most = unit === "m" ? 0.1 : Math.PI;
    const [lower, upper] = info.limits[name] ?? [-most, most];
    return [name, { name, unit, lower, upper, effortUnit: info.effort_units[name] ?? "" }];
  }));
  state.cycles = [];
}

// Return the present value of a column, or null.
export function value(column) { return state.moment?.values[state.places[column]] ?? null; }

// Return the factor and the unit in which a column is displayed.
export function scaleOf(name) {
  const at = name.lastIndexOf("/"), column = name.slice(at + 1);
  const joint = state.joints.get(name.slice(0, at));
  const unit = state.shown?.units[name];
  if (name === "loop/late") return [1e3, "ms"];
  if (unit !== undefined) return [1, unit.replace("degC", "°C")];
  const isReference = /^(goal_|command_)?(position|velocity)$/.test(column) && name in state.places;
  if (!joint && !isReference) return [1, ""];
  const [factor, length] = joint?.unit === "m" ? [1e3, "mm"] : [DEGREES, "deg"];
  if (/position$/.test(column)) return [factor, length];
  if (/velocity$/.test(column)) return [factor, `${length}/s`];
  if (/effort$/.test(column)) return joint?.effortUnit ? [1, joint.effortUnit] : [100, "%"];
  return [1, { temperature: "°C", voltage: "V" }[column] ?? ""];
}

export const shortOf = (joint) => joint.replace(/_joint$/, "");

// Return the loop's measured rate, Hz, or null.
export function rateOf() {
  const [first, last] = [state.cycles[0], state.cycles.at(-1)];
  return first && last[0] > first[0] ? (last[1] - first[1]) / (last[0] - first[0]) : null;
}

// Return [joint, value] of the joint whose column is the largest, or with `sign` -1 the smallest; null if none is known.
export function extreme(column, sign = 1) {
  const known = [...state.joints.keys()].map((name) => [name, value(`${name}/${column}`)]).filter(([, one]) => one !== null);
  return known.reduce((best, one) => (best && best[1] * sign >= one[1] * sign ? best : one), null);
}

// Return a joint's hardware errors or its torque state in words, and true if it is a fault.
export function conditionOf(joint) {
  const error = state.errors[joint], torque = TORQUE[value(`${joint}/torque`) ?? 0];
  return error ? [error, true] : [torque, torque === "lost"];
}

// Return true if a joint's servo is near its temperature limit.
export function isHot(joint) {
  const limit = state.shown?.info.servos[joint]?.temperature_limit ?? null;
  return value(`${joint}/temperature`) >= (limit === null ? HOT_C : limit - HOT_BELOW_C);
}

// Return the events of severity ERROR of this run; in a log, those up to the position on the time line.
export function errorEvents() {
  const [begin, end] = isLog() ? [-Infinity, state.time] : [state.shown?.info.began ?? -Infinity, Infinity];
  return state.events.filter(({ severity, time }) => severity >= 40 && time >= begin && time <= end);
}

// Return true if an active controller commands the position of a joint.
export const isCommanded = (joint) => state.graph.some((one) => one.active && one.joints.includes(joint) && one.command.includes("position"));
