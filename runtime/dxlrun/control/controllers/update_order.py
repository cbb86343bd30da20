"""Controller graph: edges between controllers, the order of updates, and controllers above and below.

An edge starts at the controller that is updated first:

- `into`: the upper controller of a chain is updated before the lower one.
- `reads` of a reference: all commanders of the reference are updated before its reader.
- `reads` of a provided state: the provider is updated before the reader.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from dxlrun.plan.loop_plan import ControllerPlan

Plans = Mapping[str, ControllerPlan]
"""Plans of controllers by the controllers' names."""
Circle = tuple[str, ...]
"""Names of controllers that depend on each other in a circle: each has an edge to the next, and the last one
to the first.
"""


class UpdateEdge(NamedTuple):
    """Constraint on the update order: controller `before` is updated before `after` in each cycle."""

    before: str
    after: str


def edges(plans: Sequence[ControllerPlan]) -> tuple[UpdateEdge, ...]:
    """Return the constraints on the update order of these controllers, without duplicates."""
    known = {plan.name for plan in plans}
    found = [UpdateEdge(plan.name, lower) for plan in plans for lower in plan.into if lower in known]
    chains = tuple(found)
    providing = {plan.name for plan in plans if plan.provides}
    for plan in plans:
        reads = [name.split("/") for name in plan.reads]
        # A controller that reads a value of its own reads that of the previous cycle, which needs no edge.
        providers = providing - {plan.name}
        found += [
            UpdateEdge(owner, plan.name) for owner, *rest in reads if len(rest) == 1 and owner in providers
        ]
        read = [owner for owner, *rest in reads if len(rest) == 2]
        found += [
            UpdateEdge(upper, plan.name)
            for owner in read
            for upper, lower in chains
            if lower == owner and upper != plan.name
        ]
    return tuple(dict.fromkeys(found))


def update_order(plans: Sequence[ControllerPlan]) -> tuple[str, ...]:
    """Return the controllers' names in update order. The given order decides between independent ones.

    Raises: ValueError: Controllers depend on each other in a circle; the message shows it.
    """
    if found := circles(plans):
        raise ValueError(f"controllers command each other in a circle: {'; '.join(map(drawn, found))}")
    place = {plan.name: number for number, plan in enumerate(plans)}
    sorter = _sorter(plans, edges(plans))
    sorter.prepare()
    # The heap keeps the given order among controllers that are ready at the same time.
    ready = [place[name] for name in sorter.get_ready()]
    heapify(ready)
    order: list[str] = []
    while ready:
        name = plans[heappop(ready)].name
        order.append(name)
        sorter.done(name)
        for free in sorter.get_ready():
            heappush(ready, place[free])
    return tuple(order)


def circles(plans: Sequence[ControllerPlan]) -> tuple[Circle, ...]:
    """Return the circular dependencies between controllers; empty if there are none.

    Removing the edges of these circles makes the graph acyclic. Each circle begins with its first controller
    in the given order.
    """
    place = {plan.name: number for number, plan in enumerate(plans)}
    left = list(edges(plans))
    found: list[Circle] = []
    while True:
        try:
            _sorter(plans, left).prepare()
        except CycleError as error:
            names: list[str] = error.args[1][:-1]  # graphlib repeats the first name as the last one
        else:
            return tuple(sorted(found, key=lambda circle: [place[name] for name in circle]))
        first = min(range(len(names)), key=lambda at: place[names[at]])
        circle = (*names[first:], *names[:first])
        found.append(circle)
        gone = set(zip(circle, (*circle[1:], circle[0]), strict=True))
        left = [edge for edge in left if edge not in gone]


def drawn(circle: Circle) -> str:
    """Return a circle as text: `a -> b -> a`."""
    return " -> ".join((*circle, circle[0]))


def above(plans: Sequence[ControllerPlan], name: str) -> tuple[str, ...]:
    """Return the controllers that command `name`, directly or through others, nearest first.

    The controller itself need not be among the plans.
    """
    return _reached(plans, name, lambda lower, plan: lower in plan.into)


def below(plans: Sequence[ControllerPlan], name: str) -> tuple[str, ...]:
    """Return the controllers that `name` commands, directly or through others, nearest first."""
    into = {plan.name: plan.into for plan in plans}
    return _reached(plans, name, lambda upper, plan: plan.name in into.get(upper, ()))


def _reached(
    plans: Sequence[ControllerPlan], start: str, leads: Callable[[str, ControllerPlan], bool]
) -> tuple[str, ...]:
    found: list[str] = []
    newest = [start]
    while newest:
        newest = [
            plan.name for plan in plans if plan.name not in found and any(leads(one, plan) for one in newest)
        ]
        found += newest
    return tuple(found)


def lowers_first(names: Iterable[str], known: Plans, without: Collection[str] = ()) -> tuple[str, ...]:
    """Return these controllers and all controllers below them, each after the ones below it.

    The given order decides otherwise. Controllers in `without` are omitted, with the controllers below them.
    """
    found: list[str] = []
    for name in names:
        _add_lowers_first(name, known, without, found)
    return tuple(found)


def _add_lowers_first(name: str, known: Plans, without: Collection[str], found: list[str]) -> None:
    # Not a closure: a recursive closure is a reference cycle, and the loop runs without a garbage collector.
    if name in known and name not in found and name not in without:
        for lower in known[name].into:
            _add_lowers_first(lower, known, without, found)
        found.append(name)


def uppers_first(names: Collection[str], known: Plans) -> tuple[str, ...]:
    """Return these controllers sorted so that each follows the ones above it.

    The given order decides otherwise.
    """
    order = [name for name in lowers_first(reversed(tuple(names)), known) if name in names]
    return tuple(reversed(order))


def commander(name: str, engaged: Iterable[ControllerPlan]) -> str:
    """Return the first of the `engaged` controllers that commands references of `name`.

    Empty if none does.
    """
    return next((plan.name for plan in engaged if name in plan.into), "")


def _sorter(plans: Sequence[ControllerPlan], found: Iterable[UpdateEdge]) -> TopologicalSorter[str]:
    before: dict[str, list[str]] = {plan.name: [] for plan in plans}
    for edge in found:
        before[edge.after].append(edge.before)
    return TopologicalSorter(before)


def rate_fits(rate: float | None, period_ns: int) -> bool:
    """Return whether the loop's rate is a multiple of a controller's own rate (Hz.

    None: updated in each cycle).
    """
    if rate is None:
        return True
    divider = 1e9 / period_ns / rate if rate > 0 else 0.0
    # A period in ns is off by half of one: at 3 kHz that is more than the digits of a rate in the file.
    tolerance = (1e-6 + 0.5 / period_ns) * divider
    return math.isfinite(divider) and round(divider) >= 1 and abs(divider - round(divider)) < tolerance


def rate_divider(rate: float | None, period_ns: int) -> int:
    """Return after how many loop cycles a controller with this rate (Hz) is updated again.

    Requires `rate_fits`.
    """
    return 1 if rate is None else max(1, round(1e9 / period_ns / rate))
