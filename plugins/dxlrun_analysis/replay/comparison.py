"""Comparison: what a replayed loop commands, cycle by cycle, against the log; down to the bits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import CycleRecord, Floats
from dxlrun.control.controllers.manager import Manager
from dxlrun.description.modes import COMMAND_INTERFACES
from dxlrun.errors import LogError
from dxlrun.plan.loop_plan import LoopPlan
from dxlrun_analysis.replay.inputs import RecordedHardware
from dxlrun_analysis.replay.recorded import RecordedInputs

_COMMANDS = tuple(f"command_{interface}" for interface in COMMAND_INTERFACES)
_GOALS = tuple(f"goal_{interface}" for interface in COMMAND_INTERFACES)
_COMPARED = ("source_state", "reference", "device_command", *_COMMANDS, *_GOALS)
"""In the order in which they are computed: what differs first is the cause of the rest."""
_OF_NO_JOINT = {"source_state": "state", "device_command": "command"}
_WHAT = {
    **{f"command_{interface}": f"command of the {interface}" for interface in COMMAND_INTERFACES},
    **{
        f"goal_{interface}": f"goal of the {interface}, after the last gate"
        for interface in COMMAND_INTERFACES
    },
}
_Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ReplayDifference:
    """One value that is not the same."""

    cycle: int
    time_s: float
    """Of the cycle's wake-up, since the loop's first deadline."""
    what: str
    """`command of the position`, `goal of the velocity ...`, `reference arm_pid/j0/position`, `active`."""
    joint: str | None
    """None: a controller was active in one of the two and not in the other, or a message differs."""
    controller: str | None
    """The one that claims the joint, or commands the reference; None when none does."""
    recorded: str
    """The shortest number with these bits, and the bits where they are not a finite number's."""
    replayed: str


@dataclass(frozen=True, slots=True)
class JointDifferences:
    """In how many cycles one joint's values differ."""

    joint: str
    commands: int
    goals: int
    references: int = 0


class Comparison:
    """The sink of a replayed loop: compares each cycle as it comes; NaN and zero by their bits too."""

    def __init__(
        self, plan: LoopPlan, inputs: RecordedInputs, manager: Manager, hardware: RecordedHardware
    ) -> None:
        self.first: ReplayDifference | None = None
        self.compared = 0
        """Cycles."""
        self.different = 0
        """Cycles in which anything differs."""
        self._plan = plan
        self._cycles = inputs.cycles
        self._start_ns = inputs.start_ns
        self._manager, self._hardware = manager, hardware
        count = len(plan.joints)
        self._counts = {name: np.zeros(count, np.int64) for name in ("reference", "command", "goal")}
        self._joint_of = np.array(
            [[one.name for one in plan.joints].index(name.split("/")[1]) for name in plan.references], np.intp
        )

    def joints(self) -> tuple[JointDifferences, ...]:
        """Return the joints of which anything differs, in the order of rows."""
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

    def wake(self, cycle: int) -> None:
        """Nothing is exchanged."""

    def begin(self, record: CycleRecord) -> None:
        """Nothing was commanded yet."""

    def append(self, record: CycleRecord) -> None:
        """Compare one finished cycle. Raises LogError when its inputs are not the recorded ones."""
        index, row = self._hardware.index, self._hardware.recorded()
        if record.cycle == row["cycle"] and record.scheduled_ns != row["scheduled_ns"]:
            raise LogError(
                f"cycle {record.cycle} was due {self._since_start(int(row['scheduled_ns']))} in the run and "
                f"{self._since_start(record.scheduled_ns)} in the replay: a change of the rate in the log is "
                "not the one that was made, or the dxlrun that made the log counts in another way"
            )
        if record.cycle != row["cycle"] or record.period_ns != row["period_ns"]:
            raise LogError(
                f"cycle {int(row['cycle'])} was given a period of {int(row['period_ns'])} ns in the run and "
                f"cycle {record.cycle} {record.period_ns} ns in the replay: the log is damaged, or was made "
                "by a dxlrun whose loop counts in another way"
            )
        active = record.active & 0xFFFFFFFFFFFFFFFF
        differ = active != int(row["active"]) & 0xFFFFFFFFFFFFFFFF
        if differ:
            self.first = self.first or self._of_activity(index, active)
        differs: dict[str, NDArray[np.bool_]] = {}
        for name, values in zip(_COMPARED, _values(record), strict=True):
            bits: _Words = values.view(np.uint64)
            recorded: _Words = row[name].view("<u8")
            if bits.tobytes() == recorded.tobytes():
                continue
            wrong = differs[name] = bits != recorded
            if self.first is None:
                self.first = (
                    self._of_reference(index, wrong, recorded, bits, active)
                    if name == "reference"
                    else self._of_no_joint(index, name, wrong, recorded, bits)
                    if name in _OF_NO_JOINT
                    else self._of_joint(index, name, wrong, recorded, bits, active)
                )
        if differs:
            self._count(differs)
        self.different += bool(differ or differs)
        self.compared += 1
        self._hardware.next()

    def _count(self, differs: Mapping[str, NDArray[np.bool_]]) -> None:
        for what, names in (("command", _COMMANDS), ("goal", _GOALS)):
            found = [differs[name] for name in names if name in differs]
            if found:
                self._counts[what] += np.logical_or.reduce(found)
        if "reference" in differs:
            self._counts["reference"][np.unique(self._joint_of[differs["reference"]])] += 1

    def _since_start(self, time_ns: int) -> str:
        return f"at {(time_ns - self._start_ns) * 1e-9:.6f} s"

    def _of_activity(self, index: int, active: int) -> ReplayDifference:
        recorded = int(self._cycles["active"][index])
        changed = recorded ^ active
        bit = (changed & -changed).bit_length() - 1
        states = [("active" if mask >> bit & 1 else "not active") for mask in (recorded, active)]
        cycle, time_s = self._when(index)
        plans = self._manager.plans
        # one that the replay could not load has no name here
        name = plans[bit].name if bit < len(plans) else f"number {bit}, loaded in the run"
        return ReplayDifference(cycle, time_s, "active", None, name, *states)

    def _of_joint(  # noqa: PLR0917  what is known of it
        self, index: int, name: str, wrong: NDArray[np.bool_], recorded: _Words, bits: _Words, active: int
    ) -> ReplayDifference:
        row = int(np.argmax(wrong))
        joint = self._plan.joints[row].name
        cycle, time_s = self._when(index)
        both = active | int(self._cycles["active"][index])
        owner = self._owner(joint, both)
        values = [shown_bits(int(words[row])) for words in (recorded, bits)]
        return ReplayDifference(cycle, time_s, _WHAT[name], joint, owner, *values)

    def _of_reference(
        self, index: int, wrong: NDArray[np.bool_], recorded: _Words, bits: _Words, active: int
    ) -> ReplayDifference:
        place = int(np.argmax(wrong))
        name = self._plan.references[place]
        lower, joint, interface = name.split("/")
        cycle, time_s = self._when(index)
        both = active | int(self._cycles["active"][index])
        uppers = (
            one.name
            for bit, one in enumerate(self._manager.plans)
            if both >> bit & 1 and lower in one.into and joint in one.joints and interface in one.command
        )
        values = [shown_bits(int(words[place])) for words in (recorded, bits)]
        return ReplayDifference(cycle, time_s, f"reference {name}", joint, next(uppers, None), *values)

    def _of_no_joint(
        self, index: int, name: str, wrong: NDArray[np.bool_], recorded: _Words, bits: _Words
    ) -> ReplayDifference:
        """Return the difference of a state that a controller provides, or of a command of a device."""
        layout, place = self._plan.layout, int(np.argmax(wrong))
        names = layout.source_states if name == "source_state" else layout.device_commands
        plans = self._manager.plans
        owner = next(
            (
                one.name
                for one in plans
                if names[place] in one.device_commands or names[place].partition("/")[0] == one.name
            ),
            None,
        )
        cycle, time_s = self._when(index)
        values = [shown_bits(int(words[place])) for words in (recorded, bits)]
        what = f"{_OF_NO_JOINT[name]} {names[place]}"
        return ReplayDifference(cycle, time_s, what, None, owner, *values)

    def cycle_at(self, t_ns: int) -> tuple[int, float]:
        """Return the cycle that woke at this time, -1: before the first one, and its time since the start."""
        index = int(np.searchsorted(self._cycles["woken_ns"], t_ns, side="right")) - 1
        return (int(self._cycles["cycle"][index]) if index >= 0 else -1), (t_ns - self._start_ns) * 1e-9

    def time_s(self, cycle: int) -> float:
        """Return when a cycle woke, since the start."""
        index = int(np.searchsorted(self._cycles["cycle"], cycle))
        return self._when(min(index, len(self._cycles) - 1))[1]

    def _when(self, index: int) -> tuple[int, float]:
        row = self._cycles[index]
        return int(row["cycle"]), (int(row["woken_ns"]) - self._start_ns) * 1e-9

    def _owner(self, joint: str, active: int) -> str | None:
        for bit, controller in enumerate(self._manager.plans):
            if active >> bit & 1 and controller.commands_servos and joint in controller.joints:
                return controller.name
        return None


def _values(record: CycleRecord) -> tuple[Floats, ...]:
    of_no_joint = record.sources.values, record.reference, record.device_command
    return *of_no_joint, *record.commands.values, *record.goals.values


def shown_bits(bits: int) -> str:
    """Return a float64 as text from which its bits can be read again; a bare `nan` would hide its payload."""
    value = float(np.uint64(bits).view(np.float64))
    return repr(value) if np.isfinite(value) else f"{value} (bits {bits:#018x})"
