"""Graph picture: writes a graph as an SVG file, or in the language DOT of Graphviz."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

from dxlrun.errors import InputError
from dxlrun.output.escaping import escaped
from dxlrun.output.graph import Graph, Node, placed
from dxlrun.output.target import check_target, write_target

_FONT = 'node [fontname="monospace"];'
_MARKS = {".svg": '<rect class="paper"', ".dot": _FONT}
"""Text in a picture file that shows that dxlrun wrote it, by suffix; other files are not replaced."""
_CHARACTER, _LINE = 7.25, 17.0
"""Width of a character and height of a line, px: a monospaced font of 12 px is 0.6 em wide, plus some
margin."""
_PAD, _GAP, _ACROSS, _MARGIN = 12.0, 18.0, 74.0, 24.0
"""Distances in px: inside a box, between boxes of a layer, between layers, and around the picture."""
_TITLE = 30.0
_LIGHT: Mapping[str, str | tuple[str, str]] = {
    "paper": "#ffffff",
    "ink": "#1b1f24",
    "soft": "#57606a",
    "line": "#8c959f",
    "source": ("#f6f8fa", "#8c959f"),
    "controller": ("#ddf4ff", "#0969da"),
    "joints": ("#dafbe1", "#1a7f37"),
}
_DARK: Mapping[str, str | tuple[str, str]] = {
    "paper": "#0d1117",
    "ink": "#e6edf3",
    "soft": "#9198a1",
    "line": "#6e7681",
    "source": ("#161b22", "#6e7681"),
    "controller": ("#10233c", "#4493f8"),
    "joints": ("#0f2a18", "#3fb950"),
}
_FORMS = """
text { font-family: "DejaVu Sans Mono", Menlo, Consolas, monospace; font-size: 12px; }
.title { font-size: 14px; font-weight: bold; }
.name { font-weight: bold; }
.out { text-anchor: end; }
.edge { fill: none; stroke-width: 1.5; }
.inactive .box, .inactive.edge { stroke-dasharray: 5 4; }
"""


def _colours(theme: Mapping[str, str | tuple[str, str]]) -> str:
    """Return the CSS rules of the light or dark theme. Many SVG viewers do not support CSS variables."""
    boxes = ((kind, values) for kind, values in theme.items() if isinstance(values, tuple))
    return "\n".join(
        (
            f"text {{ fill: {theme['ink']}; }}",
            f".about, .out, .inactive text {{ fill: {theme['soft']}; }}",
            f".paper {{ fill: {theme['paper']}; }}",
            f".edge {{ stroke: {theme['line']}; }}",
            f".head {{ fill: {theme['line']}; }}",
            *(f".{kind} .box {{ fill: {fill}; stroke: {line}; }}" for kind, (fill, line) in boxes),
            f".inactive .box {{ fill: {theme['paper']}; }}",
        )
    )


def _style() -> str:
    return f"{_FORMS}{_colours(_LIGHT)}\n@media (prefers-color-scheme: dark) {{\n{_colours(_DARK)}\n}}\n"


def write_picture(graph: Graph, path: Path) -> None:
    """Write a graph to an `.svg` or `.dot` file; an older picture of dxlrun is replaced.

    Raises InputError as `check_picture`.
    """
    text = (graph_svg if path.suffix.lower() == ".svg" else graph_dot)(graph)
    write_target(path, text, _MARKS[path.suffix.lower()])


def check_picture(path: Path) -> None:
    """Raise InputError if a picture's suffix is not .svg or .dot, or its file cannot be written."""
    suffix = path.suffix.lower()
    if suffix not in _MARKS:
        raise InputError(
            f"--graph {path}: the file's suffix must be {' or '.join(_MARKS)}; "
            "to draw in the terminal, write --graph last, without a file"
        )
    check_target(path, _MARKS[suffix])


def graph_svg(graph: Graph) -> str:
    """Draw a graph as an SVG document, as text."""
    laid = placed(graph)
    boxes: dict[str, tuple[float, float, float, float]] = {}
    """Left, top, width and height of each box in px, by the node's name."""
    left, lowest = _MARGIN, _MARGIN + _TITLE
    columns = [sum(_height(laid.nodes.get(name)) + _GAP for name in layer) for layer in laid.layers]
    for layer, tall in zip(laid.layers, columns, strict=True):
        width = max(_width(laid.nodes.get(name)) for name in layer)
        top = _MARGIN + _TITLE + (max(columns) - tall) / 2
        for name in layer:
            height = _height(laid.nodes.get(name))
            boxes[name] = left, top, width, height
            top += height + _GAP
        lowest = max(lowest, top - _GAP)
        left += width + _ACROSS
    size = {"width": f"{max(left - _ACROSS, 300.0) + _MARGIN:g}", "height": f"{lowest + _MARGIN:g}"}
    root = Element("svg", {"xmlns": "http://www.w3.org/2000/svg", **size})
    root.set("viewBox", f"0 0 {size['width']} {size['height']}")
    ET.SubElement(root, "title").text = escaped(graph.title)
    ET.SubElement(root, "style").text = _style()
    defs = ET.SubElement(root, "defs")
    marker = {"id": "head", "viewBox": "0 0 8 8", "refX": "7", "refY": "4", "orient": "auto"}
    head = ET.SubElement(defs, "marker", {**marker, "markerWidth": "8", "markerHeight": "8"})
    ET.SubElement(head, "path", {"class": "head", "d": "M0 0 L8 4 L0 8 z"})
    ET.SubElement(root, "rect", {"class": "paper", "width": "100%", "height": "100%"})
    _text(root, graph.title, _MARGIN, _MARGIN + 6, "title")
    inactive = {node.name for node in graph.nodes if not node.active}
    for step in laid.steps:
        begin, end = boxes[step.source], boxes[step.target]
        ends = {name.partition(">")[0] for name in (step.source, step.target)}
        kind = "edge inactive" if ends & inactive else "edge"
        path = {"class": kind, "d": _curve(begin, end, step.source not in laid.nodes)}
        if step.target in laid.nodes:
            path["marker-end"] = "url(#head)"
        ET.SubElement(root, "path", path)
    for node in graph.nodes:
        root.append(_box(node, *boxes[node.name]))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def graph_dot(graph: Graph) -> str:
    """Return a graph as text in DOT (graphviz.org/doc/info/lang.html), for `dot -Tpdf`."""
    shapes = {"source": "note", "controller": "box", "joints": "box, style=rounded"}
    rows = [f"digraph {_quoted(graph.title)} {{", "  rankdir=LR;", f"  {_FONT}"]
    for node in graph.nodes:
        label = "\n".join(filter(None, (*node.lines, node.about)))
        style = "" if node.active else ", style=dashed"
        rows.append(f"  {_quoted(node.name)} [label={_quoted(label)}, shape={shapes[node.kind]}{style}];")
    named = {node.name: node for node in graph.nodes}
    for edge in graph.edges:
        label = _quoted(named[edge.source].out)
        rows.append(f"  {_quoted(edge.source)} -> {_quoted(edge.target)} [label={label}];")
    return "\n".join([*rows, "}"]) + "\n"


def _quoted(text: str) -> str:
    # Strings in DOT have the same escapes for " and line ends as JSON.
    return json.dumps(text, ensure_ascii=False)


def _texts(node: Node) -> tuple[str, ...]:
    about = node.about if node.active else f"{node.about}, inactive".removeprefix(", ")
    return (*node.lines, *([about] if about else []), *([node.out] if node.out else []))


def _width(node: Node | None) -> float:
    return 0.0 if node is None else max(map(len, _texts(node))) * _CHARACTER + 2 * _PAD


def _height(node: Node | None) -> float:
    return 0.0 if node is None else len(_texts(node)) * _LINE + 2 * _PAD - 4


def _curve(
    begin: tuple[float, float, float, float], end: tuple[float, float, float, float], passing: bool
) -> str:
    """Return an SVG path from one box to another; `passing`: the first is a placeholder of a long edge."""
    x, y = begin[0] + begin[2], begin[1] + begin[3] / 2
    to_x, to_y = end[0], end[1] + end[3] / 2
    bend = (to_x - x) / 2
    straight = f"M{begin[0]:g} {y:g} L{x:g} {y:g} " if passing else f"M{x:g} {y:g} "
    return f"{straight}C{x + bend:g} {y:g} {to_x - bend:g} {to_y:g} {to_x:g} {to_y:g}"


def _box(node: Node, left: float, top: float, width: float, height: float) -> Element:
    group = Element("g", {"class": node.kind if node.active else f"{node.kind} inactive"})
    place = {"x": f"{left:g}", "y": f"{top:g}", "width": f"{width:g}", "height": f"{height:g}", "rx": "6"}
    ET.SubElement(group, "rect", {"class": "box", **place})
    texts = _texts(node)
    for number, text in enumerate(texts):
        line = top + _PAD + 10 + number * _LINE
        if node.out and number == len(texts) - 1:
            _text(group, text, left + width - _PAD, line, "out")
        else:
            kind = "name" if number < len(node.lines) else "about"
            _text(group, text, left + _PAD, line, kind)
    return group


def _text(parent: Element, text: str, x: float, y: float, kind: str) -> None:
    ET.SubElement(parent, "text", {"class": kind, "x": f"{x:g}", "y": f"{y:g}"}).text = escaped(text)
