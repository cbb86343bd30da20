"""Wiring: a controller's views of the robot's arrays: what it sees, and where its commands go.

What lies in equal distances is shown as it is; everything else is copied before each call. A controller that
is `into` others writes into their references instead of the servos' commands.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, CycleLayout, CycleRecord, Floats, States
from dxlrun.description.modes import COMMAND_INTERFACES
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan

READABLE = ("position", "velocity", "effort", "temperature", "voltage", "age")
"""States of a joint that any controller may read as `JOINT/position`; the age in s."""

_Element = TypeVar("_Element", bound=np.generic)
Columns = slice | NDArray[np.intp]
"""Rows of some joints: a slice where they are equally far apart, which numpy takes in a tenth of the time."""


def _columns(rows: NDArray[np.intp]) -> Columns:
    """Return the rows as a slice if they are equally far apart, in either direction: any two are."""
    if not rows.size:
        return rows
    first, last = int(rows[0]), int(rows[-1])
    step = int(rows[1]) - first if rows.size > 1 else 1
    if not step or not np.array_equal(rows, first + step * np.arange(rows.size)):
        return rows
    return slice(first, last + step if last + step >= 0 else None, step)


class Provided:
    """The states that a controller provides: taken after its updates, older with each cycle without one."""

    def __init__(self, plan: ControllerPlan, record: CycleRecord) -> None:
        self.own = np.full(len(plan.provides), np.nan)
        """The controller's own array, which it writes."""
        sources = record.sources
        self._place = record.layout.sources.index(plan.name)
        self._shown = sources.values[record.layout.source_slice(plan.name)]
        self._valid, self._age_ns = sources.valid, sources.age_ns

    def grow_old(self, period_ns: int) -> None:
        """Begin a cycle, this long after the one before."""
        place, age_ns = self._place, self._age_ns
        self._valid[place] = False
        if age_ns[place] >= 0:
            age_ns[place] += period_ns

    def take(self) -> None:
        """Show what the controller has written: valid where all of it is finite; all NaN: nothing new."""
        known = np.count_nonzero(np.isfinite(self.own))
        if not known and np.isnan(self.own).all():
            return
        self._shown[:] = self.own
        if known == self.own.size:
            self._valid[self._place] = True
            self._age_ns[self._place] = 0


class Inputs:
    """What a controller sees, read-only for it: states and goals of its joints, its references, its reads.

    Raises ControllerFault for something that it reads which is not there.
    """

    def __init__(self, plan: ControllerPlan, record: CycleRecord, rows: NDArray[np.intp]) -> None:
        """`rows` are those of its joints."""
        place = _columns(rows)
        self._pairs: list[tuple[NDArray[np.generic], NDArray[np.generic], NDArray[np.intp]]] = []
        """What is copied: the robot's array, the controller's, and the rows."""
        sources = [getattr(record.states, field.name) for field in fields(States) if field.init]
        self.states = States(*(self._shown(source, place) for source in sources))
        self.goals = Commands(self._shown(record.goals.values, place))
        self.references = self._references(plan, record)
        self._ages: list[tuple[Floats, list[int], NDArray[np.int64], list[int]]] = []
        """The reads, where in them an age is, the ages of joints or sources, and their rows."""
        self.reads = self._reads(plan, record)
        self.gathered = bool(self._pairs or self._ages)
        """True when something must be copied."""

    def gather(self) -> None:
        """Copy what must be copied."""
        for source, own, place in self._pairs:
            source.take(place, axis=-1, out=own, mode="clip")
        for reads, slots, age_ns, rows in self._ages:
            ages = age_ns[rows]
            reads[slots] = np.where(ages < 0, np.nan, ages * 1e-9)

    def _shown(self, source: NDArray[_Element], place: Columns) -> NDArray[_Element]:
        if isinstance(place, slice):
            shown = source[..., place]
        else:
            own = source[..., place]
            self._pairs.append((source, own, place))
            shown = own.view()
        shown.flags.writeable = False
        return shown

    def _references(self, plan: ControllerPlan, record: CycleRecord) -> Commands:
        values = np.full((len(COMMAND_INTERFACES), len(plan.joints)), np.nan)
        if plan.joints and not set(plan.references) <= set(record.layout.references):
            raise ControllerFault(f"the record has no references of controller {plan.name}")
        for interface in plan.reference if plan.joints else ():
            names = [f"{plan.name}/{joint}/{interface}" for joint in plan.joints]
            at = np.array([record.layout.references.index(name) for name in names], dtype=np.intp)
            self._pairs.append((record.reference, values[COMMAND_INTERFACES.index(interface)], at))
        return Commands(_read_only(values))

    def _reads(self, plan: ControllerPlan, record: CycleRecord) -> Floats:
        values = np.full(len(plan.reads), np.nan)
        if plan.reads:
            at = np.array([_place(plan, name, record.layout) for name in plan.reads], dtype=np.intp)
            self._pairs.append((record.floats, values, at))
            for names, age_ns in (
                (record.layout.joints, record.states.age_ns),
                (record.layout.sources, record.sources.age_ns),
            ):
                owners = [name.removesuffix("/age") for name in plan.reads]
                aged = [
                    slot
                    for slot, name in enumerate(plan.reads)
                    if owners[slot] in names and name.endswith("/age")
                ]
                if aged:
                    self._ages.append((values, aged, age_ns, [names.index(owners[slot]) for slot in aged]))
        return _read_only(values)


def _read_only(values: Floats) -> Floats:
    shown = values.view()
    shown.flags.writeable = False
    return shown


def _state(name: str, layout: CycleLayout) -> str:
    """Return which state of a joint this names; empty: none."""
    joint, _, state = name.rpartition("/")
    return state if joint in layout.joints and state in READABLE else ""


def _place(plan: ControllerPlan, name: str, layout: CycleLayout) -> int:
    """Return where a readable interface is in `CycleRecord.floats`; an age's is read by itself."""
    if name in layout.references:
        return layout.place("reference") + layout.references.index(name)
    if name in layout.source_states:
        return layout.place("source_state") + layout.source_states.index(name)
    source, _, state = name.rpartition("/")
    if state == "age" and source in layout.sources:
        return layout.place("source_age_ns") + layout.sources.index(source)
    state = _state(name, layout)
    if not state:
        raise ControllerFault(f"controller {plan.name} reads {name}, which is not there")
    return layout.place("age_ns" if state == "age" else state) + layout.joints.index(name.rpartition("/")[0])


def claims(
    plan: ControllerPlan, own: Commands, record: CycleRecord, rows: NDArray[np.intp]
) -> tuple[Claim, ...]:
    """Return what a controller commands: the servos of its joints, or references of those that it is `into`.

    Raises ControllerFault for a reference that is not there.
    """
    if plan.into:
        return tuple(_reference_claim(plan, interface, own, record) for interface in plan.command)
    columns = _columns(rows)
    return tuple(
        Claim(
            tuple(f"{joint}/{name}" for joint in plan.joints),
            _array(own, name),
            _array(record.commands, name),
            columns,
            rows,
        )
        for name in plan.command
    )


def device_claim(plan: ControllerPlan, own: Floats, record: CycleRecord) -> tuple[Claim, ...]:
    """Return what a controller commands of devices, as one claim; nothing where it commands none.

    Raises ControllerFault for a command that no device has.
    """
    known = record.layout.device_commands
    if missing := [name for name in plan.device_commands if name not in known]:
        raise ControllerFault(f"controller {plan.name} commands {missing[0]}, which no device has")
    if not plan.device_commands:
        return ()
    at = np.array([known.index(name) for name in plan.device_commands], dtype=np.intp)
    return (Claim(plan.device_commands, own, record.device_command, _columns(at)),)


def _reference_claim(plan: ControllerPlan, interface: str, own: Commands, record: CycleRecord) -> Claim:
    known = record.layout.references
    names: list[str] = []
    for joint in plan.joints:
        found = [name for lower in plan.into if (name := f"{lower}/{joint}/{interface}") in known]
        if len(found) != 1:
            many = "more than one" if found else "none"
            raise ControllerFault(
                f"controller {plan.name} commands {joint}/{interface}, which {many} of "
                f"{', '.join(plan.into)} exports"
            )
        names += found
    at = np.array([known.index(name) for name in names], dtype=np.intp)
    return Claim(tuple(names), _array(own, interface), record.reference, _columns(at))


class Claim:
    """A claimed interface: the controller's array, the one it goes into, and where it was ever finite."""

    def __init__(
        self,
        names: tuple[str, ...],
        own: Floats,
        merged: Floats,
        place: Columns,
        rows: NDArray[np.intp] | None = None,
    ) -> None:
        """`rows`: of the joints whose servos it commands; None: it commands references or devices."""
        self.names = names
        """What its elements command: `shoulder/position`, `arm_pid/shoulder/position`, `light/led`."""
        self.own = own
        self.rows = rows
        self.finite = np.zeros(len(own), dtype=np.bool_)
        self.seen = np.zeros(len(own), dtype=np.bool_)
        self.all_seen = False
        self._merged = merged
        self._place = place
        self.shown = merged[place] if isinstance(place, slice) else None
        """Where it goes, as a view; None: its elements are in no equal distances."""
        self.taken = b""
        """The bytes of `own` that were checked and merged last."""

    def forget(self) -> None:
        """Begin anew: nothing was commanded yet."""
        self.own.fill(np.nan)
        self.seen.fill(False)
        self.all_seen = False
        self.taken = b""

    def merge(self) -> None:
        """Put what was checked into the robot's commands."""
        self.taken = self.own.tobytes()
        if self.shown is None:
            self._merged[self._place] = self.own
        else:
            self.shown[:] = self.own

    def withdraw(self) -> None:
        """Take it out of the robot's commands."""
        self._merged[self._place] = np.nan


def _array(commands: Commands, interface: str) -> Floats:
    array: Floats = getattr(commands, interface)
    return array
