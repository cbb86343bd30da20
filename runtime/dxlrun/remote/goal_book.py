"""Goals: the gateway's record of running and ended goals, built from the loop's events and messages."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from dxlrun.channels.answers import Code
from dxlrun.channels.event_records import Event, EventCode
from dxlrun.contract.controller import Outcome
from dxlrun.remote.preparation import refused
from dxlrun.remote.requests.replies import GoalState

KEPT_GOALS = 100
"""Number of ended goals that clients can query; older ones are dropped."""
LOST = "its result did not reach the gateway; the log has it"
"""Final text of a goal whose result was lost between loop and gateway, so its end is inferred."""


@dataclass(slots=True)
class GoalBook:
    """Record of the running goals and the last ended goals. Used from one asyncio loop only."""

    last: int = 0
    """Highest goal number so far."""
    running: dict[int, GoalState] = field(default_factory=dict)
    ended: dict[int, GoalState] = field(default_factory=dict)
    _waiting: dict[int, asyncio.Event] = field(default_factory=dict)

    def record_event(self, event: Event) -> None:
        """Record a goal's start or end from an event, ignore other events; raises ValueError for invalid
        data.
        """
        if event.code not in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
            return
        self._record_state(msgspec.json.decode(event.data, type=GoalState), event.t_ns * 1e-9)

    def take_message(self, message: object, time_s: float) -> None:
        """Record a message of the topic /goals: progress of a goal, or an end whose event was lost."""
        with suppress(msgspec.ValidationError):
            found = msgspec.convert(message, GoalState)
            found = found if found.error is None or math.isfinite(found.error) else replace(found, error=None)
            known = self.running.get(found.number)
            if found.status != "running":
                self._record_state(found, time_s)
            elif known is not None:
                self.running[found.number] = replace(known, progress=found.progress, error=found.error)

    def record_end(self, number: int, outcome: str, text: str, time_s: float) -> None:
        """Record the end of a running goal whose result was lost; ignore a goal that does not run."""
        if (known := self.running.get(number)) is not None:
            self._record_state(GoalState(number, known.controller, status=outcome, text=text), time_s)

    def _record_state(self, report: GoalState, time_s: float) -> None:
        number = report.number
        # A lower number belongs to a goal that is already recorded.
        if number > self.last:
            self.last = number
            for before in [
                one.number for one in self.running.values() if one.controller == report.controller
            ]:
                # A controller has one goal at a time, so the earlier goal has ended.
                self.record_end(before, Outcome.PREEMPTED, LOST, time_s)
            begun = GoalState(number, report.controller, report.kind, report.origin, accepted=time_s)
            self.running[number] = begun
        if number not in self.running or report.status == "accepted":
            return
        self.ended[number] = replace(
            known := self.running.pop(number),
            status=report.status,
            text=report.text,
            joint=report.joint,
            error=report.error,
            ended=time_s,
            progress=1.0 if report.status == Outcome.REACHED else known.progress,
        )
        if len(self.ended) > KEPT_GOALS:
            del self.ended[next(iter(self.ended))]
        if (waiting := self._waiting.pop(number, None)) is not None:
            waiting.set()

    def goal_state(self, number: int) -> GoalState:
        """Return the state of a goal; raises RefusedRequest for an unknown or no longer stored number."""
        found = self.running.get(number) or self.ended.get(number)
        if found is not None:
            return found
        if 0 < number <= self.last:
            raise refused(Code.GOAL_ENDED, {"goal": number, "outcome": "long ago"})
        raise refused(Code.UNKNOWN_GOAL, {"goal": number, "last": self.last})

    async def wait_for_end(self, number: int, timeout_s: float) -> None:
        """Wait until a running goal has ended, or until the timeout; return at once for any other goal."""
        if number in self.running:
            ended = self._waiting.setdefault(number, asyncio.Event())
            try:
                await asyncio.wait_for(ended.wait(), timeout_s)
            except TimeoutError:
                return
