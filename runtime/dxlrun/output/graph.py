"""Graph: nodes and edges to be drawn, and their arrangement in layers from left to right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import msgspec

_SWEEPS = 6
"""Passes over all layers that reduce crossings, alternately from the left and from the right."""
_LISTED = 40
"""Longest line of joint names in a box, characters."""


class Node(msgspec.Struct, frozen=True):
    """A box of the drawing: a source of values, a controller, or joints that controllers move."""

    name: str
    """Identifier of the node, unique in its graph, to which edges refer."""
    kind: Literal["source", "controller", "joints"]
    lines: tuple[str, ...]
    """Lines of text in the box."""
    out: str = ""
    """Label of the edges that leave the node, written at its right edge."""
    about: str = ""
    """Additional line in pictures, which the text drawing omits."""
    active: bool = True


class Edge(msgspec.Struct, frozen=True):
    """An arrow between two nodes, given by their names."""

    source: str
    target: str


class Graph(msgspec.Struct, frozen=True):
    """A directed graph without cycles, with a title."""

    title: str
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]


class LayeredGraph(msgspec.Struct, frozen=True):
    """A graph whose nodes are arranged in layers; long edges have a placeholder in each layer they cross."""

    layers: tuple[tuple[str, ...], ...]
    """Names of nodes and placeholders, layer by layer from left to right, each from top to bottom."""
    steps: tuple[Edge, ...]
    """Edges between neighbouring layers, also to and from placeholders."""
    nodes: Mapping[str, Node]
    """Nodes of the graph by name; names in `layers` that are missing here are placeholders."""


def listed(names: Sequence[str]) -> tuple[str, ...]:
    """Join names by commas into lines of limited length."""
    lines = [""]
    for number, name in enumerate(names):
        word = name + "," * (number + 1 < len(names))
        if lines[-1] and len(lines[-1]) + 1 + len(word) > _LISTED:
            lines.append("")
        lines[-1] += " " * bool(lines[-1]) + word
    return tuple(lines)


def placed(graph: Graph) -> LayeredGraph:
    """Arrange a graph in layers, after Sugiyama, Tagawa and Toda (IEEE Trans. SMC 11, 1981).

    Sources are on the left, joints on the right, and each controller as far right as the nodes that it
    commands allow. The order in a layer follows the mean position of the neighbours.
    """
    column = _columns(graph)
    layers: list[list[str]] = [[] for _ in range(max(column.values(), default=-1) + 1)]
    for node in graph.nodes:
        layers[column[node.name]].append(node.name)
    steps: list[Edge] = []
    for number, edge in enumerate(graph.edges):
        way = [edge.source]
        for passed in range(column[edge.source] + 1, column[edge.target]):
            way.append(f"{edge.source}>{edge.target}>{number}>{passed}")
            layers[passed].append(way[-1])
        steps += [Edge(*pair) for pair in pairwise([*way, edge.target])]
    _ordered(layers, steps)
    return LayeredGraph(tuple(map(tuple, layers)), tuple(steps), {node.name: node for node in graph.nodes})


def _columns(graph: Graph) -> dict[str, int]:
    """Return the index of each node's layer, from the left."""
    following: dict[str, list[str]] = {node.name: [] for node in graph.nodes}
    kinds = {node.name: node.kind for node in graph.nodes}
    for edge in graph.edges:
        following[edge.source].append(edge.target)
    height: dict[str, int] = {}

    def high(name: str) -> int:
        if name not in height:
            height[name] = 1 + max((high(each) for each in following[name]), default=0)
            # Joints are to the right of all controllers, even those that command none.
            if kinds[name] == "controller":
                height[name] = max(height[name], 2)
        return height[name]

    most = max((high(node.name) for node in graph.nodes if node.kind != "source"), default=0)
    commanded = {edge.target for edge in graph.edges if kinds[edge.source] == "controller"}
    for name, kind in kinds.items():
        if kind == "controller" and not following[name] and name not in commanded:
            # A controller without outputs is next to its inputs.
            height[name] = most
    found = {
        node.name: most
        if node.kind == "joints"
        else 0
        if node.kind == "source"
        else most - height[node.name] + 1
        for node in graph.nodes
    }
    used = sorted(set(found.values()))
    return {name: used.index(column) for name, column in found.items()}


def _ordered(layers: list[list[str]], steps: Sequence[Edge]) -> None:
    """Sort each layer in place by the mean position of its neighbours, to reduce crossings."""
    before: dict[str, list[str]] = {}
    after: dict[str, list[str]] = {}
    for step in steps:
        before.setdefault(step.target, []).append(step.source)
        after.setdefault(step.source, []).append(step.target)
    for sweep in range(_SWEEPS):
        order = range(1, len(layers)) if sweep % 2 == 0 else range(len(layers) - 2, -1, -1)
        for index in order:
            beside, neighbours = (layers[index - 1], before) if sweep % 2 == 0 else (layers[index + 1], after)
            place = {name: number for number, name in enumerate(beside)}
            own = {name: number for number, name in enumerate(layers[index])}

            def middle(name: str) -> float:
                found = [place[each] for each in neighbours.get(name, ()) if each in place]  # noqa: B023  used at once
                return sum(found) / len(found) if found else own[name]  # noqa: B023  used at once

            layers[index].sort(key=middle)
