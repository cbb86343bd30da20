// List of the events, and the time line of a log.
import { $, isNew, make, setText } from "./dom.js";
import { isLog, state } from "./state.js";

const toneOf = ({ severity }) => (severity >= 40 ? "bad" : severity >= 30 ? "warn" : "");

// Draw the events, newest first. `jump` is called with the time of an event of a log that was clicked.
export function drawEvents(jump) {
  if (!isNew($("events"), state.events.at(-1)?.number)) return;
  const items = state.events.map((event) => {
    const item = make("li", { className: toneOf(event) }, make("time", { textContent: `${event.run_time.toFixed(2)} s` }),
      make("span", { textContent: event.source, title: event.source }), make("p", { textContent: event.text }));
    if (isLog()) item.onclick = () => jump(event.time);
    return item;
  });
  $("events").replaceChildren(make("ul", {}, ...items.reverse()));
}

// Draw the position on the time line, with marks at warnings and errors.
export function drawTimeline() {
  if (!isLog()) return;
  const { span: [begin, end], marks } = state.shown;
  const severe = state.events.filter((event) => event.severity >= 30);
  if (isNew($("timeline"), begin, end, severe.length)) {
    Object.assign($("time"), { min: begin, max: end });
    $("marks").replaceChildren(...severe.map((event) => {
      const mark = make("i", { className: toneOf(event), title: event.text });
      mark.style.left = `${(event.time - begin) / (end - begin) * 100}%`;
      return mark;
    }));
    const warnings = severe.slice(0, 40).map(({ time, text }) => ({ time, what: text }));
    $("jump").replaceChildren(new Option("Jump to …", ""), ...[["Most delayed wake-ups", marks], ["Warnings and errors", warnings]].filter(([, places]) => places.length).map(([label, places]) =>
      make("optgroup", { label }, ...places.map(({ time, what }) => new Option(`${time.toFixed(2)} s: ${what}`.slice(0, 70), time)))));
  }
  if (document.activeElement !== $("time")) $("time").value = state.time;
  setText($("now"), `${state.time.toFixed(2)} of ${end.toFixed(1)} s`);
  setText($("play"), state.playing ? "❚❚" : "▶");
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
}
