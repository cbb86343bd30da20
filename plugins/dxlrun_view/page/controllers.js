// Graph of the controllers and of the references that they command, with buttons to switch and tune them.
import { isNew, make } from "./dom.js";
import { waitingText } from "./state.js";

const SVG = "http://www.w3.org/2000/svg";

// Draw the graph of the state again if it has changed.
export function drawControllers(element, { shown, graph: controllers }, act) {
  if (!isNew(element, controllers, shown?.live, shown?.control)) return;
  const open = element.dataset.open;
  element.replaceChildren();
  const names = controllers.map((one) => one.name);
  const depths = depthsOf(controllers);
  const graph = document.createElement("div");
  graph.className = "graph";
  const deepest = Math.max(0, ...Object.values(depths));
  graph.style.gridTemplateColumns = `repeat(${deepest + 1}, minmax(0, 1fr))`;
  const nodes = {};
  for (const controller of controllers) {
    const node = graph.appendChild(document.createElement("div"));
    node.className = `node${controller.active ? " active" : ""}`;
    node.style.gridColumn = deepest - depths[controller.name] + 1;
    const joints = controller.joints.length;
    const what = controller.command.length ? `${controller.command.join(", ")} of ${joints} joint${joints === 1 ? "" : "s"}` : "commands no joint";
    node.append(make("div", {}, text("strong", controller.name), text("small", controller.type), text("small", `${controller.active ? "Active" : "Not active"}; ${what}`)));
    if (shown.live) {
      const row = node.appendChild(document.createElement("div"));
      row.className = "row";
      if (shown.control) {
        const button = text("button", controller.active ? "Deactivate" : "Activate");
        button.type = "button";
        button.setAttribute("aria-label", `${button.textContent} ${controller.name}`);
        button.onclick = () => act({ verb: "switch", controller: controller.name, on: !controller.active });
        row.append(button);
      }
      const more = text("button", "Parameters");
      more.type = "button";
      more.onclick = () => parameters(element, shown, controller.name, act);
      row.append(more);
    }
    nodes[controller.name] = node;
  }
  element.append(names.length ? graph : make("p", { className: "empty", textContent: shown?.columns.length ? "No controllers" : waitingText() }));
  const lines = graph.appendChild(document.createElementNS(SVG, "svg"));
  const draw = () => connect(lines, graph, nodes, controllers);
  new ResizeObserver(draw).observe(graph);
  if (open && names.includes(open)) parameters(element, shown, open, act);
}

function depthsOf(controllers) {
  const into = Object.fromEntries(controllers.map((one) => [one.name, one.into]));
  const depth = (name, seen = []) => (seen.includes(name) || !into[name]?.length ? 0 : 1 + Math.max(...into[name].map((one) => depth(one, [...seen, name]))));
  return Object.fromEntries(controllers.map((one) => [one.name, depth(one.name)]));
}

function connect(lines, graph, nodes, controllers) {
  const place = graph.getBoundingClientRect();
  lines.replaceChildren();
  if (!place.width) return;
  const line = (from, to, back) => {
    const path = lines.appendChild(document.createElementNS(SVG, "path"));
    const [a, b] = [from.getBoundingClientRect(), to.getBoundingClientRect()];
    const y1 = a.top + a.height / 2 - place.top, y2 = b.top + b.height / 2 - place.top;
    const [x1, x2] = back ? [a.left - place.left, b.left - place.left] : [a.right - place.left, b.left - place.left];
    const bend = back ? -22 : Math.max(14, (x2 - x1) / 2);
    path.setAttribute("d", `M${x1},${y1} C${x1 + bend},${y1} ${back ? x2 + bend : x2 - bend},${y2} ${x2},${y2}`);
    path.setAttribute("class", back ? "back" : "");
  };
  for (const one of controllers) {
    for (const other of one.into) if (nodes[other]) line(nodes[one.name], nodes[other], false);
    if (one.fallback && nodes[one.fallback]) line(nodes[one.name], nodes[one.fallback], true);
  }
}

async function parameters(element, shown, name, act) {
  element.querySelector(".parameters")?.remove();
  element.dataset.open = name;
  for (const node of element.querySelectorAll(".node")) node.classList.toggle("chosen", node.querySelector("strong").textContent === name);
  const found = await act({ verb: "parameters", controller: name }, true);
  if (!found) return;
  const table = document.createElement("table");
  table.className = "parameters";
  table.createTHead().insertRow().append(text("th", `Parameters of ${name}`), text("th", ""));
  const body = table.createTBody();
  for (const { name: parameter, value: now, live, range, description } of found.parameters) {
    const row = body.insertRow();
    const label = row.appendChild(text("td", parameter));
    label.title = [description, range].filter(Boolean).join("; ");
    const cell = row.insertCell();
    if (live && shown.control) {
      const input = cell.appendChild(Object.assign(document.createElement("input"), { value: now, size: 10 }));
      input.setAttribute("aria-label", parameter);
      input.onchange = async () => {
        const number = Number(input.value);
        const value = input.value.trim() && Number.isFinite(number) ? number : input.value === "true" ? true : input.value === "false" ? false : input.value;
        if (!(await act({ verb: "set_parameter", controller: name, parameter, value }))) input.value = now;
      };
    } else cell.textContent = now;
  }
  if (!found.parameters.length) body.insertRow().append(text("td", "None"));
  element.append(table);
}

const text = (tag, textContent) => make(tag, { textContent });
