"""Graph: a directed graph as data, and its layout in layers from left to right with few crossings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import msgspec

_SWEEPS = 6
"""Number of passes that improve the order in the layers, alternately from the left and from the right."""
_LISTED = 40
"""Characters per line of names."""


class Node(msgspec.Struct, frozen=True):
    """A box: a source of values, a controller, or joints that controllers move."""

    name: str
    """Unique in its graph."""
    kind: Literal["source", "controller", "joints"]
    lines: tuple[str, ...]
    """Text in the box."""
    out: str = ""
    """Label of the outgoing edges, at the right edge."""
    about: str = ""
    """Additional text, if it fits."""
    active: bool = True


class Edge(msgspec.Struct, frozen=True):
    """An arrow from one node to another one."""

    source: str
    target: str


class Graph(msgspec.Struct, frozen=True):
    """Nodes and edges without cycles."""

    title: str
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]


class Placed(msgspec.Struct, frozen=True):
    """A graph in layers. An edge that crosses a layer occupies a place there, without a node."""

    layers: tuple[tuple[str, ...], ...]
    """Names of nodes by layer, from left to right, and within a layer from top to bottom."""
    steps: tuple[Edge, ...]
    """Edges between adjacent layers."""
    nodes: Mapping[str, Node]
    """Nodes of the graph by name; other names in `layers` are places of crossing edges."""


def listed(names: Sequence[str]) -> tuple[str, ...]:
    """Return names in lines, separated by commas."""
    lines = [""]
    for number, name in enumerate(names):
        word = name + "," * (number + 1 < len(names))
        if lines[-1] and len(lines[-1]) + 1 + len(word) > _LISTED:
            lines.append("")
        lines[-1] += " " * bool(lines[-1]) + word
    return tuple(lines)


def placed(graph: Graph) -> Placed:
    """Return the layers of a graph, after Sugiyama, Tagawa and Toda (IEEE Trans. SMC 11, 1981).

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
    return Placed(tuple(map(tuple, layers)), tuple(steps), {node.name: node for node in graph.nodes})


def _columns(graph: Graph) -> dict[str, int]:
    """Return the layer of each node, without empty layers."""
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
    """Order each layer by the mean position of its neighbours, in passes of alternate direction."""
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
