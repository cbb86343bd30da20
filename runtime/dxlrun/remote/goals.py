"""Goals as the gateway knows them: those that run, and the last that ended, from the loop's reports."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field

import msgspec

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.events import Event, EventCode, GoalReport
from dxlrun.contract.controller import Outcome

KEPT_GOALS = 100
"""So many of those that ended are kept for clients."""
LOST = "its result did not reach the gateway; the log has it"
"""Text of a goal that is known to have ended by what came after it."""


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


class _Message(msgspec.Struct):
    """Of the topic /goals, see `control.controllers.goals.GoalStatus`."""

    goal: int
    status: str
    controller: str = ""
    kind: str = ""
    origin: str = ""
    progress: float = 0.0
    error: float | None = None
    joint: str = ""
    text: str = ""


@dataclass(slots=True)
class GoalBook:
    """All goals that clients can ask for; one asyncio loop."""

    last: int = 0
    """Number of the newest one."""
    running: dict[int, GoalStatus] = field(default_factory=dict)
    ended: dict[int, GoalStatus] = field(default_factory=dict)
    _waiting: dict[int, asyncio.Event] = field(default_factory=dict)

    def take(self, event: Event) -> None:
        """Note what an event reports of a goal; raises ValueError when its data are none."""
        if event.code not in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
            return
        self._take(msgspec.json.decode(event.data, type=GoalReport), event.t_ns * 1e-9)

    def take_message(self, message: object, time_s: float) -> None:
        """Note a message of the topic /goals, as JSON has it: progress, or what a lost event had."""
        with suppress(msgspec.ValidationError):
            found = msgspec.convert(message, _Message)
            status = self.running.get(found.goal)
            if found.status != "running":
                self._take(found, time_s)
            elif status is not None:
                status.progress, status.error = found.progress, found.error

    def end(self, number: int, outcome: str, text: str, time_s: float) -> None:
        """Note the end of a goal whose report was lost; nothing where it has one."""
        status = self.running.get(number)
        if status is not None:
            self._take(_Message(number, outcome, status.controller, text=text), time_s)

    def _take(self, report: GoalReport | _Message, time_s: float) -> None:
        number = report.goal
        if number > self.last:  # else its beginning, or all of it, is known already
            self.last = number
            for before in [one.goal for one in self.running.values() if one.controller == report.controller]:
                self.end(before, Outcome.PREEMPTED, LOST, time_s)  # a controller has one at a time
            self.running[number] = GoalStatus(
                number, report.controller, report.kind, report.origin, accepted=time_s
            )
        status = self.running.get(number)
        if status is None or report.status == "accepted":
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

    def status(self, number: int) -> GoalStatus | Refusal:
        """Return a goal, or why there is none of this number."""
        found = self.running.get(number) or self.ended.get(number)
        if found is not None:
            return found
        if 0 < number <= self.last:
            return Refusal(Code.GOAL_ENDED, {"goal": number, "outcome": "long ago"})
        return Refusal(Code.UNKNOWN_GOAL, {"goal": number, "last": self.last})

    async def wait(self, number: int, timeout_s: float) -> None:
        """Return when a goal that runs has ended, or after so long."""
        if number in self.running:
            ended = self._waiting.setdefault(number, asyncio.Event())
            try:
                await asyncio.wait_for(ended.wait(), timeout_s)
            except TimeoutError:
                return
