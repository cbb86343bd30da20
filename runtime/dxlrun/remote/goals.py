"""Goals as the gateway knows them: those that run, and the last that ended, from the loop's reports."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field

import msgspec

from dxlrun.control.controllers.controller import Outcome
from dxlrun.run.channels.answers import Code, Refusal
from dxlrun.run.channels.events import Event, EventCode, GoalReport

KEPT_GOALS = 100
"""So many of those that ended are kept for clients."""


class GoalStatus(msgspec.Struct):
    """One goal, for a client."""

    goal: int
    controller: str
    kind: str
    origin: str
    status: str = "running"
    """`running`, or how it ended: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """0..1, as its controller reported it last."""
    error: float | None = None
    """Largest distance from the desired state, SI units; at the end the worst joint's from the goal."""
    joint: str = ""
    text: str = ""
    accepted: float = 0.0
    """s of the run's clock"""
    ended: float | None = None


class _Feedback(msgspec.Struct):
    goal: int
    status: str
    progress: float = 0.0
    error: float | None = None


@dataclass(slots=True)
class GoalBook:
    """All goals that clients can ask for; one asyncio loop."""

    running: dict[int, GoalStatus] = field(default_factory=dict)
    ended: dict[int, GoalStatus] = field(default_factory=dict)
    _waiting: dict[int, asyncio.Event] = field(default_factory=dict)

    def take(self, event: Event) -> None:
        """Note what an event reports of a goal; raises ValueError when its data are none."""
        if event.code not in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
            return
        report = msgspec.json.decode(event.data, type=GoalReport)
        number, time_s = report.goal, event.t_ns * 1e-9
        status = self.running.get(number) or GoalStatus(
            number, report.controller, report.kind, report.origin, accepted=time_s
        )
        if event.code == EventCode.GOAL_ACCEPTED:
            self.running[number] = status
            return
        self.running.pop(number, None)
        status.status, status.text, status.joint = report.status, report.text, report.joint
        status.error, status.ended = report.error, time_s
        if report.status == Outcome.REACHED:
            status.progress = 1.0
        self.ended[number] = status
        if len(self.ended) > KEPT_GOALS:
            del self.ended[next(iter(self.ended))]
        if (waiting := self._waiting.pop(number, None)) is not None:
            waiting.set()

    def take_feedback(self, message: object) -> None:
        """Note the progress of a goal that runs, from a message of the topic /goals, as JSON has it."""
        with suppress(msgspec.ValidationError):
            found = msgspec.convert(message, _Feedback)
            status = self.running.get(found.goal)
            if status is not None and found.status == "running":
                status.progress, status.error = found.progress, found.error

    def status(self, number: int) -> GoalStatus | Refusal:
        """Return a goal, or why there is none of this number."""
        found = self.running.get(number) or self.ended.get(number)
        if found is not None:
            return found
        newest = max((*self.running, *self.ended), default=0)
        if 0 < number <= newest:
            return Refusal(Code.GOAL_ENDED, {"goal": number, "outcome": "long ago"})
        return Refusal(Code.UNKNOWN_GOAL, {"goal": number, "last": newest})

    async def wait(self, number: int, timeout_s: float) -> None:
        """Return when a goal that runs has ended, or after so long."""
        if number in self.running:
            ended = self._waiting.setdefault(number, asyncio.Event())
            try:
                await asyncio.wait_for(ended.wait(), timeout_s)
            except TimeoutError:
                return
