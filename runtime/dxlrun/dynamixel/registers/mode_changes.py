"""Mode changes of one bus while it runs: who is on the way into which mode, in the gaps between cycles."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.exchange.gaps import Gaps, Urgency
from dxlrun.dynamixel.exchange.goal_arrays import GoalArrays
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.registers import modes
from dxlrun.dynamixel.registers.inspection import persist, who
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.mode import Mode
from dxlrun.run.channels.events import EventCode, EventSink, Severity


class ModeChanges:
    """Brings servos into modes, one program a servo; meanwhile `mode` shows UNKNOWN and no goal is sent.

    Where a servo refuses or does not answer, its mode is read again; one that cannot be read stays UNKNOWN
    until it is taken back (`entered`).
    """

    __slots__ = ("_events", "_gaps", "_goals", "_mode", "_plan", "_queued", "_rows", "_wanted", "doubtful")

    def __init__(
        self, plan: BusPlan, gaps: Gaps, goals: GoalArrays, mode: NDArray[np.uint8], events: EventSink
    ) -> None:
        """`mode` is the robot's array of the modes in which the joints are."""
        self._plan = plan
        self._gaps = gaps
        self._goals = goals
        self._mode = mode
        self._events = events
        self._rows = [servo.row for servo in plan.servos]
        self._wanted = [servo.start_mode for servo in plan.servos]
        self._queued = [False] * len(plan.servos)
        self.doubtful: list[int] = []
        """Who may be without torque after a change: no goal until that was read. Whoever minds clears it."""

    def wanted(self, index: int) -> Mode:
        """Return the mode in which a servo is, or shall be as soon as it can."""
        return self._wanted[index]

    def entered(self, index: int, mode: Mode) -> None:
        """Take note that a servo was brought into a mode: at the start, or when it came back."""
        self._wanted[index] = mode
        self._goals.set_mode(index, mode)
        self._mode[self._rows[index]] = mode

    def returned(self, index: int, mode: Mode) -> None:
        """Take note that a servo came back in a mode; another one that was wanted meanwhile follows."""
        if self._queued[index]:
            return  # its change is next, and takes note of what is there then
        if mode == self._wanted[index]:
            self.entered(index, mode)
        else:
            self._queue(index)

    def want(self, wanted: NDArray[np.uint8]) -> None:
        """Let servos change into modes, shape (joints,), UNKNOWN: none; a later wish replaces this one."""
        for index, row in enumerate(self._rows):
            mode = Mode(int(wanted[row]))
            if mode is Mode.UNKNOWN:
                continue
            self._wanted[index] = mode
            if not self._queued[index] and mode != self._mode[row]:
                self._queue(index)

    def _queue(self, index: int) -> None:
        servo = self._plan.servos[index]
        self._queued[index] = True
        self._goals.set_mode(index, Mode.UNKNOWN)
        self._mode[self._rows[index]] = Mode.UNKNOWN
        self._gaps.add(
            self._change(index),
            partial(self._changed, index),
            Urgency.MODE,
            f"the mode of {who(self._plan, servo)}",
            index,
        )

    def _change(self, index: int) -> Program[tuple[Mode, str]]:
        """Change into the newest mode that is wanted; return the mode that is there, and what failed."""
        servo, wanted = self._plan.servos[index], self._wanted[index]
        try:
            problem = yield from modes.enter(self._plan, servo, wanted, inward=True)
        except LookupError as error:
            problem = f"cannot follow: {error}"
        if not problem:
            torque = yield from persist(self._plan.torque_reads[index])
            if not (torque.answered and torque.parameters[0] == 1):
                self.doubtful.append(index)  # it lost its torque unnoticed, and a goal may switch it on
            return wanted, ""
        return (yield from modes.mode_now(self._plan, servo)), problem

    def _changed(self, index: int, outcome: tuple[Mode, str]) -> None:
        mode, problem = outcome
        servo, wanted = self._plan.servos[index], self._wanted[index]
        self._queued[index] = False
        if problem:
            text = f"{who(self._plan, servo)} {problem}; it is in {_said(mode)}"
            self._events.emit(EventCode.MODE, Severity.ERROR, servo.joint, text)
            self._goals.set_mode(index, mode)
            self._mode[self._rows[index]] = mode
            self._wanted[index] = mode or wanted
            self.doubtful.append(index)
            return
        if wanted != mode:  # another wish came meanwhile
            self._queue(index)
            return
        self.entered(index, mode)
        text = f"{who(self._plan, servo)} is in {_said(mode)}"
        self._events.emit(EventCode.MODE, Severity.INFO, servo.joint, text)


def _said(mode: Mode) -> str:
    if mode is Mode.UNKNOWN:
        return "a mode that is not known"
    return f"{mode.name.lower().replace('_', '-')} mode"
