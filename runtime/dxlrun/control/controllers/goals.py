"""Goals: what controllers work on, one at a time each; numbered from 1.

Events report when a goal is accepted and how it ends; the topic /goals has its progress beside them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.cycle import LOST_CYCLES, CycleRecord
from dxlrun.channels.events import EventCode, EventSink, GoalReport, Severity
from dxlrun.contract.controller import Outcome
from dxlrun.control.controllers.topics import Publisher, TopicLog
from dxlrun.messages import Header

FEEDBACK_NS = 100_000_000
"""Between two reports of one goal's progress, ns of the run's clock: 10 Hz."""
GOALS_TOPIC = "/goals"
KEPT = 256
"""Of so many goals that ended it is known how."""
_LONGEST_TEXT = 500
_JUDGED = (Outcome.REACHED, Outcome.MISSED)
_WARNED = (Outcome.MISSED, Outcome.ABORTED)
CERTAIN_NS = 500_000_000
"""How long `reached` waits for replies and torque that are in doubt; at least LOST_CYCLES periods. [i]"""


@dataclass(slots=True)
class GoalStatus:
    """Message of the topic /goals: a goal is accepted, goes on, or has ended."""

    header: Header = field(default_factory=Header)
    goal: int = 0
    controller: str = ""
    kind: str = ""
    origin: str = ""
    status: str = ""
    """`accepted`, `running`, or how it ended: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """0..1"""
    error: float = math.nan
    """Largest distance from the desired state, at the end the worst joint's from the goal; SI units."""
    joint: str = ""
    text: str = ""


class PlayedPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one controller is given of a motion: commands by time; one that is a goal stands alone."""

    controller: str
    kind: str
    at_ns: tuple[int, ...]
    """When each command is handed over, since the motion was taken; they do not decrease."""
    sizes: tuple[int, ...]
    """How many numbers each command has."""
    end_ns: int = 0
    """When the part is over."""


class PlayedMotion(msgspec.Struct):
    """Commands that the runtime hands to a controller by time: a goal that no controller sees."""

    goal: RunningGoal
    part: PlayedPart
    commands: tuple[NDArray[np.float64], ...]
    begun_ns: int
    """Time of the controllers."""
    next: int = 0

    def due(self, time_ns: int) -> NDArray[np.float64] | None:
        """Return the next command whose time has come."""
        if self.next < len(self.commands) and self.begun_ns + self.part.at_ns[self.next] <= time_ns:
            self.next += 1
            return self.commands[self.next - 1]
        return None

    def report(self, time_ns: int) -> None:
        """Report its progress, and its end."""
        passed_ns, end_ns = time_ns - self.begun_ns, self.part.end_ns
        if self.next == len(self.commands) and passed_ns >= end_ns:
            self.goal.end(Outcome.REACHED, "all commands were given")
        else:
            self.goal.feedback(min(1.0, passed_ns / end_ns) if end_ns > 0 else 0.0)


class Result(NamedTuple):
    """What `Goal.end` was given, and until when `reached` may become certain."""

    text: str
    joint: str
    error: float
    joints: Sequence[str] | None
    """By which the goal is judged; None: those that its controller commands."""
    certain_by_ns: int = 0


class RunningGoal:
    """One goal, as its controller sees it (see `controller.Goal`); after its end nothing changes it."""

    def __init__(self, goals: Goals, number: int, controller: str, kind: str, origin: str) -> None:
        self.number = number
        self.controller = controller
        self.kind = kind
        self.origin = origin
        self.cancelling = False
        """True from its cancel on."""
        self.outcome: Outcome | None = None
        """None while it runs."""
        self.progress, self.error, self.joint, self.text = 0.0, math.nan, "", ""
        """As reported last."""
        self.result: Result | None = None
        """Of a goal that counts as reached when its joints are certain."""
        self._goals = goals
        self._reported_ns = -FEEDBACK_NS

    def feedback(self, progress: float, error: float = math.nan) -> None:
        """Report progress, 0..1, and the largest distance from the desired state, SI units."""
        if self.outcome is not None or self.result is not None:
            return
        self.progress, self.error = float(progress), float(error)
        now_ns = self._goals.now_ns
        if now_ns - self._reported_ns >= FEEDBACK_NS:
            self._reported_ns = now_ns
            self._goals.publish(self, "running")

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = math.nan,
        joints: Sequence[str] | None = None,
    ) -> None:
        """Report the result; that of a goal that has ended already is ignored.

        Reached and missed are judged by the joints' states, see `controller.Goal.end`.
        """
        if self.outcome is None:
            self._goals.judge(self, Outcome(outcome), Result(text, joint, float(error), joints))


class Goals:
    """All goals of a run. Numbers follow from the commands alone, so a replay gives the same ones."""

    def __init__(
        self,
        record: CycleRecord,
        events: EventSink,
        joints: Sequence[str] = (),
        commanded: Callable[[str], Sequence[str]] = lambda controller: (),
    ) -> None:
        """`joints` are the robot's, `commanded` returns those of a controller by its name."""
        self._rows = {joint: row for row, joint in enumerate(joints)}
        self._commanded = commanded
        self.last = 0
        """Number of the newest one."""
        self.running: dict[int, RunningGoal] = {}
        """By number; at most one of each controller."""
        self._record = record
        self._events = events
        self._ended: list[tuple[int, str, Outcome] | None] = [None] * KEPT
        self._publisher: Publisher | None = None
        self._status = GoalStatus()

    def open(self, topics: TopicLog) -> None:
        """Announce the topic /goals, once: the first controller that takes goals is there. Allocates."""
        if self._publisher is None:
            self._publisher = topics.open(GOALS_TOPIC, GoalStatus)

    @property
    def now_ns(self) -> int:
        """When this cycle woke, ns of the run's clock."""
        return self._record.woken_ns

    def accept(self, controller: str, kind: str, origin: str) -> RunningGoal:
        """Return a new goal, and report it; the one before of its controller has ended."""
        self.last += 1
        goal = self.running[self.last] = RunningGoal(self, self.last, controller, kind, origin)
        text = f"goal {goal.number}: {kind} from {origin}"
        self._report(goal, EventCode.GOAL_ACCEPTED, Severity.INFO, "accepted", text)
        return goal

    def found(self, number: int) -> RunningGoal | Refusal:
        """Return a goal that runs, or why there is none of this number."""
        goal = self.running.get(number)
        if goal is not None:
            return goal
        if not 0 < number <= self.last:
            return Refusal(Code.UNKNOWN_GOAL, {"goal": number, "last": self.last})
        ended = self._ended[number % KEPT]
        if ended is None or ended[0] != number:
            return Refusal(Code.GOAL_ENDED, {"goal": number, "outcome": "long ago"})
        return Refusal(Code.GOAL_ENDED, {"goal": number, "controller": ended[1], "outcome": ended[2].value})

    def judge(self, goal: RunningGoal, outcome: Outcome, result: Result) -> None:
        """End a goal, but let `reached` wait until its joints are certain.

        One that is reached or missed is aborted instead when a joint goes nowhere, and that joint named.
        """
        text, joint, error, joints, _ = result
        names = self._commanded(goal.controller) if joints is None else joints
        if outcome in _JUDGED and names:
            states, rows = self._record.states, [self._rows[name] for name in names]
            found = states.unable(rows)
            if found is None and outcome is Outcome.REACHED and (found := states.doubtful(rows)):
                now_ns = self.now_ns
                if goal.result is None:
                    wait_ns = max(CERTAIN_NS, LOST_CYCLES * self._record.period_ns)
                    goal.result = Result(text, joint, error, tuple(names), now_ns + wait_ns)
                if now_ns < goal.result.certain_by_ns:
                    return
            if found is not None:
                at, why = found
                error = error if names[rows.index(at)] == joint else math.nan
                outcome, joint = Outcome.ABORTED, names[rows.index(at)]
                text = f"joint {joint} {why}{'; ' * bool(text)}{text}"
        goal.outcome, goal.result = outcome, None
        goal.error, goal.joint, goal.text = error, _writable(joint), _writable(text)
        if not goal.text and goal.joint and math.isfinite(error):
            goal.text = f"{goal.joint} is {error:.4g} off"
        if outcome is Outcome.REACHED:
            goal.progress = 1.0
        del self.running[goal.number]
        self._ended[goal.number % KEPT] = (goal.number, goal.controller, outcome)
        sentence = f"goal {goal.number} {outcome}{f': {goal.text}' if goal.text else ''}"
        severity = Severity.WARNING if outcome in _WARNED else Severity.INFO
        self._report(goal, EventCode.GOAL_ENDED, severity, outcome.value, sentence)

    def settle(self) -> None:
        """Judge again the goals whose results wait for their joints' replies and torque."""
        for goal in tuple(self.running.values()):
            if goal.result is not None:
                self.judge(goal, Outcome.REACHED, goal.result)

    def _report(
        self, goal: RunningGoal, code: EventCode, severity: Severity, status: str, sentence: str
    ) -> None:
        error = goal.error if math.isfinite(goal.error) else None
        about = goal.number, goal.controller, goal.kind, goal.origin
        report = GoalReport(*about, status, goal.text, goal.joint, error)
        self._events.emit(code, severity, goal.controller, sentence, msgspec.json.encode(report))
        self.publish(goal, status)

    def publish(self, goal: RunningGoal, status: str) -> None:
        """Publish how a goal stands on the topic /goals."""
        if self._publisher is None:
            return
        message = self._status
        message.goal, message.controller, message.kind = goal.number, goal.controller, goal.kind
        message.origin, message.status, message.progress = goal.origin, status, goal.progress
        message.error, message.joint, message.text = goal.error, goal.joint, goal.text
        self._publisher.publish(message)


def _writable(text: object) -> str:
    """Return a controller's text with escapes for what no UTF-8 has, as long as reports may have it."""
    return str(text)[:_LONGEST_TEXT].encode(errors="backslashreplace").decode()
