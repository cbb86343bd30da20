"""The controller graph: which controllers command which references, and the order of updates.

An edge goes from the controller that is updated first. `into`: the upper end of a chain before the lower one.
`reads` of a reference: all that command the reference before the one that reads it; of a state that a
controller provides: that controller before it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from heapq import heapify, heappop, heappush
from typing import Protocol

import msgspec

Circle = tuple[str, ...]
"""Names of controllers, each before the next, and the last one before the first."""


class Node(Protocol):
    """What stands in the graph; a ControllerPlan is one."""

    @property
    def name(self) -> str:
        """The controller's name in the robot file."""

    @property
    def into(self) -> tuple[str, ...]:
        """Controllers whose references it commands."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Interfaces that it reads without a claim."""

    @property
    def provides(self) -> tuple[str, ...]:
        """States that it provides to others."""


class Edge(msgspec.Struct, frozen=True):
    """`before` is updated before `after`, in the same cycle."""

    before: str
    after: str


def edges(nodes: Sequence[Node]) -> tuple[Edge, ...]:
    """Return the edges of the graph, each once, in the order of the nodes; none to what is not a node."""
    found = list(_chains(nodes))
    commanders: dict[str, list[str]] = {}
    for edge in found:
        commanders.setdefault(edge.after, []).append(edge.before)
    providing = {node.name for node in nodes if node.provides}
    for node in nodes:
        found += [
            Edge(owner, node.name)
            for owner in dict.fromkeys(name.partition("/")[0] for name in node.reads if name.count("/") == 1)
            if owner in providing
        ]
        found += [
            Edge(upper, node.name)
            for owner in _owners(node.reads)
            for upper in commanders.get(owner, ())
            if upper != node.name  # what it commands itself it need not await
        ]
    return tuple(dict.fromkeys(found))


def _owners(reads: Iterable[str]) -> Iterator[str]:
    for interface in reads:
        owner, *rest = interface.split("/")
        if len(rest) == 2:
            yield owner


def update_order(nodes: Sequence[Node]) -> tuple[str, ...]:
    """Return the names in the order of updates; where the graph leaves it open, in the order given.

    Raises ValueError that draws the circles, where there is one.
    """
    if found := circles(nodes):
        raise ValueError(f"controllers command each other in a circle: {'; '.join(map(drawn, found))}")
    place = {node.name: number for number, node in enumerate(nodes)}
    sorter = _sorter(nodes, edges(nodes))
    sorter.prepare()
    ready = [place[name] for name in sorter.get_ready()]
    heapify(ready)
    order: list[str] = []
    while ready:
        name = nodes[heappop(ready)].name
        order.append(name)
        sorter.done(name)
        for free in sorter.get_ready():
            heappush(ready, place[free])
    return tuple(order)


def circles(nodes: Sequence[Node]) -> tuple[Circle, ...]:
    """Return circles of the graph, so many that it has no other one without an edge of these.

    Each begins with the first of its controllers in the order given.
    """
    place = {node.name: number for number, node in enumerate(nodes)}
    left = list(edges(nodes))
    found: list[Circle] = []
    while True:
        try:
            _sorter(nodes, left).prepare()
        except CycleError as error:
            names: list[str] = error.args[1][:-1]  # the first one is repeated at its end
        else:
            return tuple(sorted(found, key=lambda circle: [place[name] for name in circle]))
        first = min(range(len(names)), key=lambda at: place[names[at]])
        circle = (*names[first:], *names[:first])
        found.append(circle)
        gone = {Edge(*pair) for pair in zip(circle, (*circle[1:], circle[0]), strict=True)}
        left = [edge for edge in left if edge not in gone]


def drawn(circle: Circle) -> str:
    """Return a circle as text: `a -> b -> a`."""
    return " -> ".join((*circle, circle[0]))


def above(nodes: Sequence[Node], name: str) -> tuple[str, ...]:
    """Return the controllers that command a controller's references, through others too, the nearest first.

    The controller itself need not be among the nodes.
    """
    return _reached(nodes, name, {(lower, node.name) for node in nodes for lower in node.into})


def below(nodes: Sequence[Node], name: str) -> tuple[str, ...]:
    """Return the controllers below one, whose references it commands, through others too, nearest first."""
    return _reached(nodes, name, {(node.name, lower) for node in nodes for lower in node.into})


def _chains(nodes: Sequence[Node]) -> Iterator[Edge]:
    known = {node.name for node in nodes}
    return (Edge(node.name, lower) for node in nodes for lower in node.into if lower in known)


def _reached(nodes: Sequence[Node], start: str, steps: Collection[tuple[str, str]]) -> tuple[str, ...]:
    found: list[str] = []
    newest = [start]
    while newest:
        newest = [
            node.name
            for node in nodes
            if node.name not in found and any((one, node.name) in steps for one in newest)
        ]
        found += newest
    return tuple(found)


def lowers_first(
    names: Iterable[str], known: Mapping[str, Node], without: Collection[str] = ()
) -> tuple[str, ...]:
    """Return controllers with all below them, each behind those below it, else in the order given.

    Those of `without` are left out, with what is below them.
    """
    found: list[str] = []
    for name in names:
        _add_lowers_first(name, known, without, found)
    return tuple(found)


def _add_lowers_first(
    name: str, known: Mapping[str, Node], without: Collection[str], found: list[str]
) -> None:
    # no closure: one that calls itself is a circle, and the loop collects no garbage
    if name in known and name not in found and name not in without:
        for lower in known[name].into:
            _add_lowers_first(lower, known, without, found)
        found.append(name)


def uppers_first(names: Collection[str], known: Mapping[str, Node]) -> tuple[str, ...]:
    """Return these controllers, each behind those above it, else in the order given."""
    order = [name for name in lowers_first(reversed(tuple(names)), known) if name in names]
    order.reverse()
    return tuple(order)


def commander(name: str, engaged: Iterable[Node]) -> str:
    """Return the first controller that commands references of this one; empty: none does."""
    return next((plan.name for plan in engaged if name in plan.into), "")


def _sorter(nodes: Sequence[Node], found: Iterable[Edge]) -> TopologicalSorter[str]:
    before: dict[str, list[str]] = {node.name: [] for node in nodes}
    for edge in found:
        before[edge.after].append(edge.before)
    return TopologicalSorter(before)
