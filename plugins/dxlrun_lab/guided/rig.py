"""Rig: what an experiment needs of a run, live or on virtual time; and what both know of a robot."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.events import Event, EventCode, GoalReport
from dxlrun.errors import DxlrunError, Refused
from dxlrun.plan.robot_plan import Plan

TORQUED = ("on", "doubt")
"""Torque of joints that can be moved, see channels/cycle.py."""
_LOOK_S = 0.1
_STOPPING_S = 3.0


class RunGone(DxlrunError):
    """The run ended, or cannot be steered any more, in the middle of an experiment."""


class RunningController(NamedTuple):
    """A controller of the run."""

    name: str
    type: str
    active: bool
    joints: tuple[str, ...]
    """Those that it commands; empty: none."""


class JointNow(NamedTuple):
    """A joint in the newest cycle; NaN: not known."""

    position: float
    goal_position: float
    temperature: float
    torque: str
    """Name of a Torque, in lower case."""


class GoalEnd(NamedTuple):
    """How a goal ended: an Outcome, or `lost`."""

    outcome: str
    text: str = ""


class Rig(ABC):
    """A run that an experiment works on, live or on virtual time. Everything raises Refused with the reason,
    and RunGone."""

    plan: Plan
    virtual: bool
    """True where nothing waits for the clock on the wall."""
    own: bool
    """True where the run belongs to the experiment: it may deactivate controllers."""
    log: Path | None
    """Of the run; None on virtual time without one."""
    tape: Tape

    @property
    @abstractmethod
    def now_s(self) -> float:
        """Time of the run, s."""

    @property
    @abstractmethod
    def rate(self) -> float:
        """Hz of the loop now."""

    @property
    @abstractmethod
    def paused(self) -> bool:
        """True where a client paused the run."""

    @abstractmethod
    def controllers(self) -> tuple[RunningController, ...]:
        """Return the controllers that are loaded."""

    @abstractmethod
    def joints(self) -> Mapping[str, JointNow]:
        """Return the joints as they are in the newest cycle."""

    @abstractmethod
    def load(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller, in a pause of its own."""

    @abstractmethod
    def unload(self, name: str) -> None:
        """Unload a controller, in a pause of its own."""

    @abstractmethod
    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> None:
        """Activate and deactivate controllers in one cycle; returns when they are."""

    @abstractmethod
    def change_rate(self, rate: float) -> None:
        """Run the loop at another rate, Hz."""

    @abstractmethod
    def send(self, controller: str, kind: str, command: Mapping[str, object]) -> int:
        """Send a command; return the number of its goal, 0 where it is none."""

    @abstractmethod
    def end_of(self, goal: int, timeout_s: float) -> GoalEnd | None:
        """Wait for the end of a goal, s of the run; None: it has not ended by then."""

    @abstractmethod
    def cancel(self, goal: int) -> None:
        """Cancel a goal; its joints come to rest."""

    def wait(self, goal: int, look: Callable[[], str | None], longest_s: float) -> GoalEnd:
        """Wait for the end of a goal; where `look`, called ten times a second of the run, returns a sentence,
        or after `longest_s`, cancel it."""
        until = self.now_s + longest_s
        while (end := self.end_of(goal, _LOOK_S)) is None:
            why = look()
            if why is None and self.now_s > until:
                why = f"the samples were not played within {longest_s:.0f} s"
            if why is not None:
                with suppress(Refused):  # it has ended already
                    self.cancel(goal)
                    self.end_of(goal, _STOPPING_S)  # a controller whose joint is lost may not end it
                return GoalEnd("cancelled", why)
        return end

    def recorded(self, goal: int) -> NDArray[np.void]:
        """Return the cycles of the goal that was sent last, as far as there are any."""
        return self.tape.of(goal)

    @abstractmethod
    def close(self) -> Sequence[str]:
        """Let go of the run, end it where it is the experiment's own; return what went wrong with it."""


class Tape:
    """Cycles and events of a run since a goal was sent, and where that began and ended."""

    __slots__ = ("_begun_ns", "_cycles", "_dtype", "_ended_ns", "_goal")

    def __init__(self, dtype: np.dtype[np.void]) -> None:
        self._dtype = dtype
        self._cycles: list[bytes] = []
        self._goal = 0
        self._begun_ns: dict[int, int] = {}
        self._ended_ns: dict[int, int] = {}

    def clear(self) -> None:
        """Forget what was recorded: a goal will be sent."""
        self._cycles.clear()
        self._begun_ns.clear()
        self._ended_ns.clear()

    def take_cycles(self, records: bytes) -> None:
        """Keep the records of cycles."""
        if records:
            self._cycles.append(records)

    def take_events(self, events: Sequence[Event]) -> None:
        """Note where goals began and ended."""
        for event in events:
            if event.code not in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
                continue
            report = msgspec.json.decode(event.data, type=GoalReport)
            began = event.code == EventCode.GOAL_ACCEPTED
            (self._begun_ns if began else self._ended_ns)[report.goal] = event.t_ns

    def whole(self, goal: int) -> bool:
        """Return whether the goal's end was recorded, and the cycle in which that was."""
        ended_ns = self._ended_ns.get(goal)
        return ended_ns is not None and bool(self._cycles) and self._last_ns() >= ended_ns

    def of(self, goal: int) -> NDArray[np.void]:
        """Return a goal's cycles: from the one that took it to the one in which it ended, or the last."""
        cycles: NDArray[np.void] = np.frombuffer(b"".join(self._cycles), dtype=self._dtype)
        if goal not in self._begun_ns:
            return cycles[:0]
        # an event of a cycle is left between its wake-up and its last write
        written = cycles["written_ns"]
        first = int(np.searchsorted(written, self._begun_ns[goal]))
        ended_ns = self._ended_ns.get(goal)
        end = len(cycles) if ended_ns is None else int(np.searchsorted(written, ended_ns)) + 1
        return cycles[first:end]

    def _last_ns(self) -> int:
        last = np.frombuffer(self._cycles[-1][-self._dtype.itemsize :], dtype=self._dtype)
        return int(last["written_ns"][0])


def now_of(state: Mapping[str, object]) -> JointNow:
    """Return a joint's state as it is in JSON: a number that is not known is none."""

    def number(name: str) -> float:
        value = state.get(name)
        return float(value) if isinstance(value, int | float) else float("nan")

    return JointNow(
        number("position"), number("goal_position"), number("temperature"), str(state.get("torque"))
    )
