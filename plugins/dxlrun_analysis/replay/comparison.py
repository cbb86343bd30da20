"""Comparison of commands and goals of a replayed loop with those in the log, bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, LogError
from dxlrun.tooling.plans import ControllerPlan, LoopPlan
from dxlrun.tooling.records import CycleRecord
from dxlrun_analysis.replay.recorded_inputs import RecordedInputs, ReplayDifference
from dxlwire import COMMAND_INTERFACES

_COMMANDS = tuple(f"command_{interface}" for interface in COMMAND_INTERFACES)
_GOALS = tuple(f"goal_{interface}" for interface in COMMAND_INTERFACES)
_COMPARED = (*CycleRecord.COMPUTED, *_COMMANDS, *_GOALS)
"""Fields of a cycle that are compared, in order of computation: a difference causes later ones."""
_WHAT = {
    **{f"command_{interface}": f"command of the {interface}" for interface in COMMAND_INTERFACES},
    **{
        f"goal_{interface}": f"goal of the {interface}, after the last gate"
        for interface in COMMAND_INTERFACES
    },
}
_Words = NDArray[np.uint64]
_MASK = 0xFFFFFFFFFFFFFFFF  # Width of the mask in the log


class JointDifferences(msgspec.Struct, frozen=True):
    """Number of cycles in which command, goal or reference of one joint differ between run and replay."""

    joint: str
    commands: int
    goals: int
    references: int = 0


class Comparison:
    """Counter of the differences between replayed and recorded cycles, which are compared bit by bit."""

    def __init__(
        self, plan: LoopPlan, inputs: RecordedInputs, controllers: Callable[[], Sequence[ControllerPlan]]
    ) -> None:
        """Create a comparison without cycles.

        Args:
            plan: Plan of the replayed loop.
            inputs: Recorded inputs and results.
            controllers: Function that returns the plans of the running controllers, in order of their
                bits in the masks.
        """
        self.first: ReplayDifference | None = None
        self.compared = 0  # Cycles
        self.different = 0  # Cycles in which any value differs
        self._plan = plan
        self._inputs = inputs
        self._controllers = controllers
        count = len(plan.joints)
        self._counts = {name: np.zeros(count, np.int64) for name in ("reference", "command", "goal")}
        self._joint_of = np.array(
            [[one.name for one in plan.joints].index(name.split("/")[1]) for name in plan.references], np.intp
        )

    def joints(self) -> tuple[JointDifferences, ...]:
        """Return the joints with differences, in the order of the log."""
        found = (
            JointDifferences(joint.name, int(command), int(goal), int(reference))
            for joint, command, goal, reference in zip(
                self._plan.joints,
                self._counts["command"],
                self._counts["goal"],
                self._counts["reference"],
                strict=True,
            )
        )
        return tuple(one for one in found if one.commands or one.goals or one.references)

    def compare_cycle(self, record: CycleRecord, row: np.void, index: int) -> None:
        """Compare one replayed cycle with the recorded row of the same index.

        Raises:
            LogError: Number, deadline or period of the cycle are not the recorded ones.
        """
        if record.cycle == row["cycle"] and record.scheduled_ns != row["scheduled_ns"]:
            raise LogError(
                f"cycle {record.cycle} was due {self._since_start(int(row['scheduled_ns']))} in the run and "
                f"{self._since_start(record.scheduled_ns)} in the replay: the log is damaged, or "
                "from an incompatible version of dxlrun"
            )
        if record.cycle != row["cycle"] or record.period_ns != row["period_ns"]:
            raise LogError(
                f"cycle {int(row['cycle'])} had a period of {int(row['period_ns'])} ns in the run, and cycle "
                f"{record.cycle} {record.period_ns} ns in the replay: the log is damaged, or from an "
                "incompatible version of dxlrun"
            )
        active, recorded_active = record.active & _MASK, int(row["active"]) & _MASK
        differ = active != recorded_active
        if differ:
            self.first = self.first or self._of_activity(index, active, recorded_active)
        differs: dict[str, NDArray[np.bool_]] = {}
        for name, values in zip(_COMPARED, _values(record), strict=True):
            bits: _Words = values.view(np.uint64)
            recorded: _Words = row[name].view("<u8")
            if bits.tobytes() == recorded.tobytes():
                continue
            wrong = differs[name] = bits != recorded
            if self.first is None:
                place = int(np.argmax(wrong))
                what, joint, owner = self._named(name, place, active | recorded_active)
                both = [shown_bits(int(words[place])) for words in (recorded, bits)]
                self.first = self._inputs.difference(index, what, joint, owner, *both)
        if differs:
            self._count(differs)
        self.different += bool(differ or differs)
        self.compared += 1

    def _count(self, differs: Mapping[str, NDArray[np.bool_]]) -> None:
        for what, names in (("command", _COMMANDS), ("goal", _GOALS)):
            found = [differs[name] for name in names if name in differs]
            if found:
                self._counts[what] += np.logical_or.reduce(found)
        if "reference" in differs:
            self._counts["reference"][np.unique(self._joint_of[differs["reference"]])] += 1

    def _of_activity(self, index: int, active: int, recorded: int) -> ReplayDifference:
        changed = recorded ^ active
        bit = (changed & -changed).bit_length() - 1
        states = [("active" if mask >> bit & 1 else "not active") for mask in (recorded, active)]
        plans = self._controllers()
        # A controller that the replay could not load has no name here.
        name = plans[bit].name if bit < len(plans) else f"number {bit} (name unknown)"
        return self._inputs.difference(index, "active", None, name, *states)

    def _named(self, field: str, place: int, active: int) -> tuple[str, str | None, str | None]:
        """Return name, joint and commanding controller of one element of a cycle's field, for a message.

        Args:
            field: Name of the field.
            place: Index in the field.
            active: Mask of the controllers that were active in the run or in the replay.
        """
        layout, plans = self._plan.layout, self._controllers()
        actives = [one for bit, one in enumerate(plans) if active >> bit & 1]
        name = layout.names_of(field)[place] if field in CycleRecord.COMPUTED else ""
        if name and field != "reference":
            owners = [
                one.name for one in plans if name in one.source_commands or name.partition("/")[0] == one.name
            ]
            return f"{CycleRecord.COMPUTED[field]} {name}", None, next(iter(owners), None)
        if name:
            lower, joint, interface = name.split("/")
            owners = [
                one.name
                for one in actives
                if lower in one.into and joint in one.joints and interface in one.command
            ]
            return f"reference {name}", joint, next(iter(owners), None)
        joint = self._plan.joints[place].name
        owners = [one.name for one in actives if one.commands_servos and joint in one.joints]
        return _WHAT[field], joint, next(iter(owners), None)

    def _since_start(self, time_ns: int) -> str:
        return f"at {(time_ns - self._inputs.start_ns) * 1e-9:.6f} s"


def _values(record: CycleRecord) -> tuple[Floats, ...]:
    return *record.computed, *record.commands.values, *record.goals.values


def shown_bits(bits: int) -> str:
    """Return the float64 with these bits as text that preserves them; a bare `nan` would hide its payload."""
    value = float(np.uint64(bits).view(np.float64))
    return repr(value) if np.isfinite(value) else f"{value} (bits {bits:#018x})"
