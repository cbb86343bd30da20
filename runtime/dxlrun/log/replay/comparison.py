"""Comparison: what the loop wants in a replay against what it wanted then, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.loop_plan import ControllerPlan, LoopPlan
from dxlrun.errors import LogError
from dxlrun.interfaces import COMMAND_INTERFACES, Floats
from dxlrun.run.channels.cycle import CycleRecord

_COMMANDS = tuple(f"command_{interface}" for interface in COMMAND_INTERFACES)
_GOALS = tuple(f"goal_{interface}" for interface in COMMAND_INTERFACES)
_COMPARED = (*_COMMANDS, *_GOALS)
"""In the order in which they come to be: what differs first is the cause of the rest."""
_WHAT = {
    **{f"command_{interface}": f"command of the {interface}" for interface in COMMAND_INTERFACES},
    **{
        f"goal_{interface}": f"goal of the {interface}, after the last gate"
        for interface in COMMAND_INTERFACES
    },
}
_Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Difference:
    """One value that is not the same."""

    cycle: int
    time_s: float
    """Of the cycle's wake-up, since the loop's first deadline."""
    what: str
    """`command of the position`, `goal of the velocity ...`, `active`."""
    joint: str | None
    """None: a controller was active in one of the two and not in the other."""
    controller: str | None
    """Who claims the joint; None when nobody does."""
    recorded: str
    """The shortest number with these bits, and the bits where they are not a finite number's."""
    replayed: str


@dataclass(frozen=True, slots=True)
class JointDifferences:
    """In how many cycles one joint's values differ."""

    joint: str
    commands: int
    goals: int


class Comparison:
    """The sink of a replayed loop: compares each cycle as it comes; NaN and zero by their bits too."""

    def __init__(
        self,
        plan: LoopPlan,
        cycles: NDArray[np.void],
        start_ns: int,
        controllers: Callable[[], Sequence[ControllerPlan]],
    ) -> None:
        self.first: Difference | None = None
        self._plan = plan
        self._controllers = controllers
        """Those there are now, by their bits: some are loaded while the loop is paused."""
        self._cycles = cycles
        self._start_ns = start_ns
        self._recorded: dict[str, _Words] = {
            name: np.ascontiguousarray(cycles[name]).view("<u8") for name in _COMPARED
        }
        self._differs = {name: np.zeros(bits.shape, dtype=np.bool_) for name, bits in self._recorded.items()}
        self._activity = np.zeros(len(cycles), dtype=np.bool_)
        self._index = 0

    @property
    def compared(self) -> int:
        """How many cycles came."""
        return self._index

    @property
    def different(self) -> int:
        """In how many cycles anything differs."""
        any_of = self._activity.copy()
        for differs in self._differs.values():
            any_of |= differs.any(axis=1)
        return int(np.count_nonzero(any_of))

    def joints(self) -> tuple[JointDifferences, ...]:
        """Return the joints of which anything differs, in the order of rows."""
        differs = self._differs
        commands, goals = (
            np.logical_or.reduce([differs[name] for name in names]).sum(axis=0)
            for names in (_COMMANDS, _GOALS)
        )
        return tuple(
            JointDifferences(joint.name, int(command), int(goal))
            for joint, command, goal in zip(self._plan.joints, commands, goals, strict=True)
            if command or goal
        )

    def begin(self, record: CycleRecord) -> None:
        """Nothing was wanted yet."""

    def append(self, record: CycleRecord) -> None:
        """Compare one finished cycle. Raises LogError when its inputs are not the recorded ones."""
        index = self._index
        row = self._cycles[index]
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
        if active != int(row["active"]):
            self._activity[index] = True
            self.first = self.first or self._of_activity(index, active)
        for name, values in zip(_COMPARED, _values(record), strict=True):
            bits: _Words = values.view(np.uint64)
            np.not_equal(bits, self._recorded[name][index], out=self._differs[name][index])
            if self.first is None and self._differs[name][index].any():
                self.first = self._of_joint(index, name, bits, active)
        self._index += 1

    def _since_start(self, time_ns: int) -> str:
        return f"at {(time_ns - self._start_ns) * 1e-9:.6f} s"

    def _of_activity(self, index: int, active: int) -> Difference:
        recorded = int(self._cycles["active"][index])
        changed = recorded ^ active
        bit = (changed & -changed).bit_length() - 1
        states = [("active" if mask >> bit & 1 else "not active") for mask in (recorded, active)]
        cycle, time_s = self._when(index)
        plans = self._controllers()
        # one that the replay could not load has no name here
        name = plans[bit].name if bit < len(plans) else f"number {bit}, loaded in the run"
        return Difference(cycle, time_s, "active", None, name, *states)

    def _of_joint(self, index: int, name: str, bits: _Words, active: int) -> Difference:
        row = int(np.argmax(self._differs[name][index]))
        joint = self._plan.joints[row].name
        cycle, time_s = self._when(index)
        both = active | int(self._cycles["active"][index])
        owner = self._owner(joint, both)
        values = [_told(int(words[row])) for words in (self._recorded[name][index], bits)]
        return Difference(cycle, time_s, _WHAT[name], joint, owner, *values)

    def _when(self, index: int) -> tuple[int, float]:
        row = self._cycles[index]
        return int(row["cycle"]), (int(row["woken_ns"]) - self._start_ns) * 1e-9

    def _owner(self, joint: str, active: int) -> str | None:
        for bit, controller in enumerate(self._controllers()):
            if active >> bit & 1 and controller.command and joint in controller.joints:
                return controller.name
        return None


def _values(record: CycleRecord) -> tuple[Floats, ...]:
    return *record.commands.values, *record.goals.values


def _told(bits: int) -> str:
    """Return a number as text from which its bits can be read again; a bare `nan` would hide its payload."""
    value = float(np.uint64(bits).view(np.float64))
    return repr(value) if np.isfinite(value) else f"{value} (bits {bits:#018x})"
