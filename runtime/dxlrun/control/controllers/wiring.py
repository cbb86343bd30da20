"""Wiring: a controller's views of the robot's arrays, for its inputs and its commands.

The views are built once, before the loop. Rows at equal distances are views of the robot's arrays. Other rows
are copied before each call. A controller that is `into` others writes into their references instead of the
servos' commands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import NamedTuple, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Clamp, Commands, CycleLayout, CycleRecord, Floats, States
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan
from dxlwire.modes import COMMAND_INTERFACES

READABLE = ("position", "velocity", "effort", "temperature", "voltage", "age")
"""States of a joint that any controller may read, as `JOINT/position`. The age (time since the last reply) is
in s."""

_Element = TypeVar("_Element", bound=np.generic)
Columns = slice | NDArray[np.intp]
"""Indices of joints in an array. Indices at equal distances are a slice, which numpy indexes in a tenth of
the time."""


def _columns(rows: NDArray[np.intp]) -> Columns:
    """Return indices as a slice if they are at equal distances, ascending or descending, else unchanged."""
    if not rows.size:
        return rows
    first, last = int(rows[0]), int(rows[-1])
    step = int(rows[1]) - first if rows.size > 1 else 1
    if not step or not np.array_equal(rows, first + step * np.arange(rows.size)):
        return rows
    return slice(first, last + step if last + step >= 0 else None, step)


def _places(names: Sequence[str], known: Sequence[str]) -> NDArray[np.intp]:
    return np.array([known.index(name) for name in names], dtype=np.intp)


class ProvidedStates:
    """States that a controller provides to others, copied into the record after its updates."""

    def __init__(self, plan: ControllerPlan, record: CycleRecord) -> None:
        self.own = np.full(len(plan.provides), np.nan)
        """Array in which the controller writes the states."""
        sources = record.sources
        self._place = record.layout.sources.index(plan.name)
        self._shown = sources.values[record.layout.source_slice(plan.name)]
        self._valid, self._age_ns = sources.valid, sources.age_ns

    def grow_old(self, period_ns: int) -> None:
        """Mark the provided states as not updated in this cycle, and increase their age by a period, ns."""
        place, age_ns = self._place, self._age_ns
        self._valid[place] = False
        if age_ns[place] >= 0:
            age_ns[place] += period_ns

    def publish_states(self) -> None:
        """Copy the controller's array into the record. It is valid if all values are finite.

        An array of NaN only means that there are no new values, and is not copied.
        """
        known = np.count_nonzero(np.isfinite(self.own))
        if not known and np.isnan(self.own).all():
            return
        self._shown[:] = self.own
        if known == self.own.size:
            self._valid[self._place] = True
            self._age_ns[self._place] = 0


class Inputs:
    """Arrays that a controller reads: states and goals of its joints, its references, and its `reads`."""

    def __init__(self, plan: ControllerPlan, record: CycleRecord, rows: NDArray[np.intp]) -> None:
        place = _columns(rows)
        self._pairs: list[tuple[NDArray[np.generic], NDArray[np.generic], NDArray[np.intp]]] = []
        """Copies to make before each call: source array, controller's array, source indices."""
        sources = [getattr(record.states, field.name) for field in fields(States) if field.init]
        self.states = States(*(self._shown(source, place) for source in sources))
        self.goals = Commands(self._shown(record.goals.values, place))
        references = np.full((len(COMMAND_INTERFACES), len(plan.joints)), np.nan)
        if plan.joints and not set(plan.references) <= set(record.layout.references):
            raise ControllerFault(f"the record has no references of controller {plan.name}")
        for interface in plan.reference if plan.joints else ():
            names = [f"{plan.name}/{joint}/{interface}" for joint in plan.joints]
            own = references[COMMAND_INTERFACES.index(interface)]
            self._pairs.append((record.reference, own, _places(names, record.layout.references)))
        self.references = Commands(_read_only(references))
        self._reads = np.full(len(plan.reads), np.nan)
        places = dict(_readable(record.layout)) if plan.reads else {}
        if missing := [name for name in plan.reads if name not in places]:
            raise ControllerFault(f"controller {plan.name} reads {missing[0]}, but no source has it")
        at = np.array([places[name] for name in plan.reads], dtype=np.intp)
        if at.size:
            self._pairs.append((record.floats, self._reads, at))
        self._aged = [slot for slot, name in enumerate(plan.reads) if name.endswith("/age")]
        """Indices of the reads that are ages, which the record has as integers in ns."""
        self._ages_ns, self._age_places = record.floats.view("<i8"), at[self._aged]
        self.reads = _read_only(self._reads)
        self.gathered = bool(self._pairs)
        """True if `gather` has anything to copy; False if all inputs are views."""

    def gather(self) -> None:
        """Copy the inputs that are not views of the robot's arrays, and convert ages to s."""
        for source, own, place in self._pairs:
            # numpy buffers `out` with the default mode "raise" (numpy.take). The indices are always valid.
            source.take(place, axis=-1, out=own, mode="clip")
        if self._aged:
            ages_ns = self._ages_ns[self._age_places]
            self._reads[self._aged] = np.where(ages_ns < 0, np.nan, ages_ns * 1e-9)

    def _shown(self, source: NDArray[_Element], place: Columns) -> NDArray[_Element]:
        own = source[..., place]
        if not isinstance(place, slice):
            self._pairs.append((source, own, place))
        return _read_only(own)


def _read_only(values: NDArray[_Element]) -> NDArray[_Element]:
    shown = values.view()
    shown.flags.writeable = False
    return shown


def _readable(layout: CycleLayout) -> Iterator[tuple[str, int]]:
    """Yield each value that a controller may read, by name, with its index in `CycleRecord.floats`."""
    for sequence, names in (
        ("reference", layout.references),
        ("source_state", layout.source_states),
        ("source_age_ns", [f"{source}/age" for source in layout.sources]),
        *((state, [f"{joint}/{state}" for joint in layout.joints]) for state in READABLE[:-1]),
        ("age_ns", [f"{joint}/age" for joint in layout.joints]),
    ):
        begin = layout.float_index(sequence)
        yield from ((name, begin + index) for index, name in enumerate(names))


_CARRYING = ("effort", "pwm")
"""Command interfaces that carry a joint's load: without these commands, the joint falls."""


class _CommandInterface(NamedTuple):
    """Commands of a controller for one interface, and where they are written."""

    own: Floats
    """View of the controller's own array."""
    merged: Floats
    """Array of the robot that the commands are copied to."""
    place: Columns
    """Indices of the commands in `merged`."""
    goes_on: bool = True
    """True if commands are copied even while the joints are held."""
    held: float | None = None
    """Value written instead while the joints are held; None: the last command stays."""


class Outputs:
    """Commands of a controller: its arrays, their destinations, and the check for finite values.

    The destinations are the servos of its joints or the references of the controllers in `into`, and devices.

    Args:
        plan: The controller.
        record: The cycle's record.
        rows: Rows of the controller's joints.

    Raises:
        ControllerFault: The record lacks a reference or a device command.
    """

    def __init__(self, plan: ControllerPlan, record: CycleRecord, rows: NDArray[np.intp]) -> None:
        layout, count = record.layout, len(plan.joints)
        own = np.full(len(COMMAND_INTERFACES) * count + len(plan.source_commands), np.nan)
        sources = own.size - len(plan.source_commands)
        self.own: Floats = own
        """All commands of the controller in one array."""
        self.commands = Commands(own[:sources].reshape(len(COMMAND_INTERFACES), count))
        self.source_commands: Floats = own[sources:]
        self.taken = b""
        """Bytes of `own` when it was last checked."""
        self._parts: list[_CommandInterface] = []
        self._owner = plan.name
        self._names = [""] * own.size
        """Name of each command in `own`: `shoulder/position`, `arm_pid/shoulder/position`, `light/led`;
        empty: not commanded."""
        self._rows: NDArray[np.intp] | None = None if plan.into else rows
        """Rows of the commanded servos; None: the controller commands references."""
        self._clamped = record.clamped
        for interface in plan.command:
            begin = COMMAND_INTERFACES.index(interface) * count
            if plan.into:
                names = [_reference(plan, joint, interface, layout) for joint in plan.joints]
                places = _places(names, layout.references)
                self._send(begin, names, record.reference, places, interface)
            else:
                names = [f"{joint}/{interface}" for joint in plan.joints]
                self._send(begin, names, getattr(record.commands, interface), rows, interface)
        if missing := [name for name in plan.source_commands if name not in layout.source_commands]:
            raise ControllerFault(f"controller {plan.name} commands {missing[0]}, but no device has it")
        places = _places(plan.source_commands, layout.source_commands)
        self._send(sources, plan.source_commands, record.source_commands, places)
        self._claimed = np.array([name != "" for name in self._names], dtype=np.bool_)
        self._finite, self._seen = np.zeros((2, own.size), dtype=np.bool_)

    def _send(
        self, begin: int, names: Sequence[str], merged: Floats, rows: NDArray[np.intp], interface: str = ""
    ) -> None:
        if names:
            end = begin + len(names)
            self._names[begin:end] = names
            goes_on = not interface or interface in _CARRYING
            held: float | None = np.nan
            if self._rows is None:
                # Without a reference, the lower controller would hold the measured position. A joint that
                # sags below its reference would sag by the same distance again.
                held = {"position": None, "velocity": 0.0}.get(interface)
            self._parts.append(_CommandInterface(self.own[begin:end], merged, _columns(rows), goes_on, held))

    @property
    def is_empty(self) -> bool:
        """True if the controller has nothing to command."""
        return not self._parts

    def reset_commands(self) -> None:
        """Reset the controller's own commands to NaN, as before the first command."""
        self.own.fill(np.nan)
        self._seen.fill(False)
        self.taken = b""

    def check_commands(self) -> None:
        """Check that the controller's commands are finite. NaN is accepted before the first finite value.

        Raises:
            ControllerFault: A command is infinite, or is NaN after a finite value.
        """
        own, seen, finite = self.own, self._seen, self._finite
        np.isfinite(own, finite)
        # Bytes are compared in a tenth of the time of a numpy reduction.
        if finite.tobytes() != self._claimed.tobytes():
            wrong = self._claimed & ~finite & (seen | np.isinf(own))
            if wrong.any():
                self._report_wrong(wrong)
        np.logical_or(seen, finite, seen)
        self.taken = own.tobytes()

    def _report_wrong(self, wrong: NDArray[np.bool_]) -> NoReturn:
        if self._rows is not None:
            joints = wrong[: self.commands.values.size].reshape(self.commands.values.shape).any(axis=0)
            self._clamped[self._rows[joints]] |= np.uint8(Clamp.NOT_FINITE)
        first = int(np.flatnonzero(wrong)[0])
        after = " after a finite value" if self._seen[first] else ""
        raise ControllerFault(
            f"controller {self._owner} commanded {self._names[first]} = {self.own[first]}{after}"
        )

    def merge_commands(self) -> None:
        """Copy the controller's commands into the robot's arrays."""
        for own, merged, place, _, _ in self._parts:
            merged[place] = own

    def hold_joints(self) -> None:
        """Write commands into the robot's arrays that hold the joints: positions stay, velocities become 0.

        Efforts and PWM are still written because they carry the joints' load, and so are device commands.
        """
        for own, merged, place, goes_on, held in self._parts:
            if goes_on:
                merged[place] = own
            elif held is not None:
                merged[place] = held

    def withdraw(self) -> None:
        """Set the controller's commands in the robot's arrays to NaN, "not commanded"."""
        for _, merged, place, _, _ in self._parts:
            merged[place] = np.nan


def _reference(plan: ControllerPlan, joint: str, interface: str, layout: CycleLayout) -> str:
    found = [name for lower in plan.into if (name := f"{lower}/{joint}/{interface}") in layout.references]
    if len(found) != 1:
        many = "more than one" if found else "none"
        raise ControllerFault(
            f"controller {plan.name} commands {joint}/{interface}, but {many} of {', '.join(plan.into)} "
            "exports it"
        )
    return found[0]
