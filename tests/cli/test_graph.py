"""The graph of controllers and its pictures; what `dxlrun check --graph` prints is in check.txt."""

import io
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree as ET

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console
from tests.kit.commands import Dxlrun, cases

from dxlrun.output.graph import Edge, Graph, Node, placed
from dxlrun.output.graph_picture import graph_svg
from dxlrun.output.graph_text import graph_text
from dxlrun.output.terminal import show_parts

SVG = "{http://www.w3.org/2000/svg}"
NODES = (
    Node("reads", "source", ("wrist",), "temperature"),
    Node("arm", "controller", ("arm",), "position + velocity"),
    Node("pid", "controller", ("pid",), "effort", active=False),
    Node("joints", "joints", ("shoulder", "elbow")),
)
GRAPH = Graph("three", NODES, (Edge("reads", "pid"), Edge("arm", "pid"), Edge("pid", "joints")))


def test_dot_replaces_an_older_one_and_has_each_node_and_edge(dxlrun: Dxlrun, tmp_path: Path) -> None:
    files = cases("check.txt")[0].values[0].files
    (tmp_path / "chain.yaml").write_text(files["chain.yaml"])
    path = tmp_path / "graph.DOT"
    path.write_text('node [fontname="monospace"]; an older one')
    assert dxlrun("check", tmp_path / "chain.yaml", "--graph", path).code == 0
    text = path.read_text()
    assert text.startswith('digraph "chain: controllers" {\n')
    assert '  "arm" -> "arm_pid" [label="position"];\n' in text
    label = "still\\njoint_group_position_controller, 100 Hz"
    assert f'  "still" [label="{label}", shape=box, style=dashed];\n' in text
    assert text.count(" -> ") == 4
    assert sorted(one.name for one in tmp_path.iterdir()) == ["chain.yaml", "graph.DOT"]


def test_narrow_terminal_gets_a_list_that_is_broken_between_words() -> None:
    assert graph_text(GRAPH, 60) == (
        "wrist\n  temperature ─▶ pid\n"
        "arm\n  position + velocity ─▶ pid\n"
        "pid (inactive)\n  effort ─▶ shoulder elbow"
    )
    assert max(map(len, graph_text(GRAPH, 120).splitlines())) > 60
    joints = Node("joints", "joints", ("left_shoulder_joint, left_elbow_joint, left_wrist_joint",))
    graph = Graph("wide", (Node("arm", "controller", ("arm",), "position"), joints), (Edge("arm", "joints"),))
    assert graph_text(graph, 50).splitlines() == [
        "arm",
        "  position ─▶ left_shoulder_joint,",
        "      left_elbow_joint, left_wrist_joint",
    ]


def test_terminal_without_these_characters_gets_others() -> None:
    for width in (60, 120):
        assert graph_text(GRAPH, width, ascii_only=True).isascii()
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    show_parts(GRAPH, console=Console(file=stream, width=120))
    assert b"position + velocity" in stream.buffer.getvalue()  # type: ignore[attr-defined]  # a BytesIO, given above


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.sets(st.integers(0, 6), max_size=3), max_size=7))
def test_any_graph_is_placed_with_each_edge_a_step_to_the_right(above: list[set[int]]) -> None:
    """Node i leads to some of those before it, so there is no circle."""
    nodes = tuple(Node(f"n{i}", "controller", (f"n{i}",), "out") for i in range(len(above)))
    edges = tuple(Edge(f"n{i}", f"n{j}") for i, ends in enumerate(above) for j in sorted(ends) if j < i)
    graph = Graph("any", nodes, edges)
    laid = placed(graph)

    column = {name: at for at, layer in enumerate(laid.layers) for name in layer}
    assert all(column[step.target] - column[step.source] == 1 for step in laid.steps)
    following = {step.source: step.target for step in laid.steps if step.source not in laid.nodes}
    ends = []
    for step in laid.steps:
        if step.source in laid.nodes:
            end = step.target
            while end not in laid.nodes:
                end = following[end]
            ends.append(Edge(step.source, end))
    assert sorted(ends, key=str) == sorted(edges, key=str)
    text = graph_text(graph, 10_000)
    assert all(f"│ n{i}" in text for i in range(len(above)))
    assert text.count("▶") == len({edge.target for edge in edges})
    assert not set(text) & set("╴╵╶╷"), "a line ends in nothing"
    check_picture(graph)


def check_picture(graph: Graph) -> None:
    """Check that a picture has each name, and no box over another one or beyond the edges."""
    picture = graph_svg(graph)
    root = ET.fromstring(picture)  # noqa: S314  our own text
    assert "prefers-color-scheme: dark" in picture
    assert {name for node in graph.nodes for name in node.lines} <= {
        one.text for one in root.iter(f"{SVG}text")
    }
    boxes = [
        tuple(float(box.get(key, "")) for key in ("x", "y", "width", "height"))
        for box in root.iter(f"{SVG}rect")
        if box.get("class") == "box"
    ]
    assert len(boxes) == len(graph.nodes)
    for (x, y, width, height), (x2, y2, width2, height2) in combinations(boxes, 2):
        assert x + width <= x2 or x2 + width2 <= x or y + height <= y2 or y2 + height2 <= y
    for x, y, width, height in boxes:
        assert x + width < float(root.get("width", ""))
        assert y + height < float(root.get("height", ""))


def test_lines_that_cross_differ_from_lines_that_are_joined() -> None:
    nodes = [Node(name, "source", (name,), "x") for name in "abc"]
    nodes += [Node(name, "controller", (name,)) for name in "pqr"]
    edges = [Edge(start, end) for start, end in ("aq", "ar", "bp", "br", "cp", "cq")]
    crossing = Graph("", tuple(nodes), tuple(edges))
    drawn = graph_text(crossing, 80)
    assert "╫" in drawn
    assert "┼" in drawn  # b's line meets a's, which leads to r too
    assert graph_text(crossing, 80, ascii_only=True).isascii()
    straight = Graph("", tuple(nodes), (Edge("a", "p"), Edge("b", "p"), Edge("b", "q"), Edge("c", "r")))
    assert "╫" not in graph_text(straight, 80)
