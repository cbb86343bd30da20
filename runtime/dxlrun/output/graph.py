"""A directed graph as data, and where its nodes stand: in layers from left to right, with few crossings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

_SWEEPS = 6
"""How often the order in the layers is improved, from the left and from the right in turn."""
_LISTED = 40
"""Characters in a line of names."""


@dataclass(frozen=True, slots=True)
class Node:
    """A box: where values come from, a controller, or joints that controllers move."""

    name: str
    """Unique in its graph."""
    kind: Literal["source", "controller", "joints"]
    lines: tuple[str, ...]
    """What stands in the box."""
    out: str = ""
    """What leaves it, at its right edge."""
    about: str = ""
    """More about it, where there is room."""
    active: bool = True


@dataclass(frozen=True, slots=True)
class Edge:
    """An arrow from one node to another one."""

    source: str
    target: str


@dataclass(frozen=True, slots=True)
class Graph:
    """Nodes and edges; without circles."""

    title: str
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]


@dataclass(frozen=True, slots=True)
class Placed:
    """A graph in layers. An edge that passes a layer has a place of its own there, without a node."""

    layers: tuple[tuple[str, ...], ...]
    """Names from left to right, and from top to bottom."""
    steps: tuple[Edge, ...]
    """Each from one layer into the next."""
    nodes: Mapping[str, Node]
    """Those of the graph; a name that is not in it is a place that an edge passes."""


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

    Sources are left, joints right, and a controller as far right as what it commands allows. The order in a
    layer follows the middle of the neighbours'.
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
    """Return the layer of each node; layers that would be empty are left out."""
    following: dict[str, list[str]] = {node.name: [] for node in graph.nodes}
    kinds = {node.name: node.kind for node in graph.nodes}
    for edge in graph.edges:
        following[edge.source].append(edge.target)
    height: dict[str, int] = {}

    def high(name: str) -> int:
        if name not in height:
            height[name] = 1 + max((high(each) for each in following[name]), default=0)
            if kinds[name] == "controller":  # joints stand right of all, also of those that command none
                height[name] = max(height[name], 2)
        return height[name]

    most = max((high(node.name) for node in graph.nodes if node.kind != "source"), default=0)
    commanded = {edge.target for edge in graph.edges if kinds[edge.source] == "controller"}
    for name, kind in kinds.items():
        if kind == "controller" and not following[name] and name not in commanded:
            height[name] = most  # one that commands nothing stands beside what it reads
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
    """Order each layer by the middle of its neighbours' places, to and fro."""
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
