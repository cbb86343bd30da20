// Stacked plots of columns, with zoom and pause.
import uPlot from "uplot";

const COLOURS = ["--curve1", "--curve2", "--curve3", "--curve4", "--curve5", "--curve6"];
const isGoal = (name) => name.includes("/goal_");
const pairOf = (name) => name.replace("/goal_", "/");
export const isAngle = (name) => /\/(goal_|command_)?(position|velocity)$/.test(name);

export class Charts {
  constructor(element, scaleOf) {
    this.element = element;
    this.scaleOf = scaleOf; // function from the name of a column to [factor, unit]
    this.charts = [];
    this.zoom = null; // [begin, end], or null to follow the newest values
    this.seconds = 10;
    this.builds = 0; // number of changes of the plots
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.build());
  }

  // Build all plots again, after a change of units or colours.
  build() { this.charts.forEach((one) => one.build()); }

  add(names = []) {
    const chart = new Chart(this, names);
    this.charts.push(chart);
    this.choose(chart);
    return chart;
  }

  choose(chart) {
    this.chosen = chart;
    for (const one of this.charts) one.root.classList.toggle("chosen", one === chart && this.charts.length > 1);
  }

  // Add a curve to the chosen plot, or remove it.
  toggle(name) {
    const chart = this.chosen ?? this.add();
    chart.names = chart.names.includes(name) ? chart.names.filter((one) => one !== name) : [...chart.names, name];
    chart.build();
  }

  remove(chart) {
    if (this.charts.length === 1) { chart.names = []; chart.build(); return; }
    chart.root.remove();
    this.charts = this.charts.filter((one) => one !== chart);
    this.choose(this.charts[0]);
  }

  span(newest) { return this.zoom ?? [newest - this.seconds, newest]; }

  spans(newest) {
    const [begin, end] = this.span(newest);
    return this.charts.map(({ names, root }) => ({ names, begin, end, points: Math.max(200, Math.round(root.clientWidth)) }));
  }

  draw(curves, newest, cursor) {
    this.charts.forEach((chart, at) => chart.draw(curves[at] ?? [], this.span(newest), newest, cursor));
  }
}

class Chart {
  constructor(all, names) {
    this.all = all;
    this.names = names;
    this.root = document.createElement("div");
    this.root.className = "chart";
    this.legend = this.root.appendChild(document.createElement("div"));
    this.legend.className = "legend";
    this.place = this.root.appendChild(document.createElement("div"));
    this.place.className = "plot";
    this.root.addEventListener("pointerdown", () => all.choose(this));
    all.element.append(this.root);
    new ResizeObserver(() => this.resize()).observe(this.place);
    this.build();
  }

  build() {
    this.all.builds += 1;
    this.plot?.destroy();
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    // A goal is a dashed curve in the colour of its state.
    const pairs = [...new Set(this.names.map(pairOf))];
    const colourOf = (name) => colour(COLOURS[pairs.indexOf(pairOf(name)) % COLOURS.length]);
    const scales = this.names.map((name) => this.all.scaleOf(name));
    this.factors = scales.map(([factor]) => factor);
    const units = [...new Set(scales.map(([, unit]) => unit))].filter(Boolean);
    const axis = { stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 }, font: "11px system-ui" };
    this.legend.replaceChildren(...this.names.map((name) => {
      const item = document.createElement("span");
      const mark = item.appendChild(document.createElement("i"));
      mark.style.borderColor = colourOf(name);
      mark.classList.toggle("goal", isGoal(name));
      item.append(name, " ", item.value = document.createElement("b"));
      const away = item.appendChild(document.createElement("button"));
      away.textContent = "×"; away.title = `Remove ${name}`; away.type = "button";
      away.onclick = () => { this.names = this.names.filter((one) => one !== name); this.build(); };
      return item;
    }));
    if (this.all.charts.length > 1 || !this.names.length) {
      const away = this.legend.appendChild(document.createElement("button"));
      away.type = "button";
      away.textContent = this.names.length ? "Remove plot" : "Click a joint, or add a curve above";
      away.onclick = () => this.all.remove(this);
    }
    this.plot = new uPlot({
      width: Math.max(this.place.clientWidth, 50), height: Math.max(this.place.clientHeight, 60),
      scales: { x: { time: false, range: () => this.range ?? [0, 1] } },
      axes: [{ ...axis, size: 34, values: (_, ticks) => ticks.map(label) },
        { ...axis, size: 64, values: (_, ticks) => ticks.map((tick) => String(Number(tick.toPrecision(7)))), label: units.join(", ") || undefined, labelSize: units.length ? 18 : 0, labelFont: "11px system-ui" }],
      series: [{}, ...this.names.map((name) => ({ label: name, stroke: colourOf(name), width: 1.5, spanGaps: false,
        dash: isGoal(name) ? [5, 4] : undefined, points: { show: false } }))],
      legend: { show: false }, cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false } },
      hooks: {
        setSelect: [(plot) => {
          if (plot.select.width < 4) return;
          this.all.zoom = [0, plot.select.width].map((more) => plot.posToVal(plot.select.left + more, "x") + this.zero);
          plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          this.all.zoomed?.();
        }],
        draw: [(plot) => {
          if (this.cursor === undefined) return;
          const x = plot.valToPos(this.cursor, "x", true);
          const { ctx, bbox } = plot;
          if (x < bbox.left || x > bbox.left + bbox.width) return;
          ctx.save(); ctx.setLineDash([]); ctx.lineWidth = 1.5; ctx.strokeStyle = colour("--bad"); ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke(); ctx.restore();
        }],
      },
    }, [[], ...this.names.map(() => [])], this.place);
    this.plot.over.ondblclick = () => { this.all.zoom = null; this.all.zoomed?.(); };
  }

  resize() { this.plot?.setSize({ width: Math.max(this.place.clientWidth, 50), height: Math.max(this.place.clientHeight, 60) }); }

  draw(curves, range, newest, cursor) {
    // The time axis of a live plot is relative to the newest moment, s.
    this.zero = cursor === undefined ? newest : 0;
    this.range = range.map((time) => time - this.zero);
    this.cursor = cursor;
    const tables = this.names.map((name, at) => {
      const curve = curves.find((one) => one.name === name);
      if (!curve) return [[], []];
      const factor = this.factors[at];
      return [curve.time.map((time) => time - this.zero), curve.value.map((value) => (value === null ? null : value * factor))];
    });
    if (!tables.length) { this.plot.setData([[]]); return; }
    this.plot.setData(uPlot.join(tables, tables.map(() => [0, 2])));
    // Figures show the newest value, or in a log the value at the cursor of the time line.
    tables.forEach(([times, values], at) => {
      const behind = cursor === undefined ? -1 : times.findIndex((time) => time > cursor);
      const shown = values[(behind < 0 ? values.length : Math.max(behind, 1)) - 1];
      const item = this.legend.children[at];
      if (item?.value) item.value.textContent = shown === null || shown === undefined ? "" : figure(shown);
    });
  }
}

function label(seconds) {
  const rounded = Math.round(seconds * 1e6) / 1e6;
  return `${rounded} s`;
}

function figure(value) {
  const size = Math.abs(value);
  if (size !== 0 && size < 0.01) return value.toExponential(1);
  return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : 2);
}
