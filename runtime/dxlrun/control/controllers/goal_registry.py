"""Goals: client goals that a controller pursues until an outcome, one at a time, numbered from 1.

Events report that a goal was accepted and its outcome. The topic /goals has its progress too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.cycle import LOST_CYCLES, Commands, CycleRecord, Floats, Torque
from dxlrun.channels.event_records import RUN_ENDED, EventBody, EventSink, GoalReport
from dxlrun.contract.controller import GoalTolerances, Outcome
from dxlrun.control import texts
from dxlrun.control.controllers.published_topics import Publisher, TopicLog
from dxlrun.messages import Header
from dxlrun.plan.loop_plan import UNLIMITED, JointPlan
from dxlwire.joint_unit import ROTARY

FEEDBACK_NS = 100_000_000
"""Shortest time between two progress messages of a goal on /goals, ns of the run's clock: 10 Hz."""
GOALS_TOPIC = "/goals"
KEPT = 256
"""Number of most recently ended goals whose outcome is remembered for answers to clients."""
_LONGEST_TEXT = 500  # characters; a GoalReport must fit LONGEST_DATA of an event
_UNREACHED = (Outcome.MISSED, Outcome.ABORTED)
CERTAIN_NS = 500_000_000
"""Longest wait, at the end of a motion, for missing replies and uncertain torque before the goal is aborted;
at least LOST_CYCLES periods. [i]
"""


@dataclass(slots=True)
class GoalStatus:
    """Message of the topic /goals: a goal was accepted, is running, or has ended."""

    header: Header = field(default_factory=Header)
    goal: int = 0
    controller: str = ""
    kind: str = ""
    origin: str = ""
    status: str = ""
    """`accepted`, `running`, or the outcome: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """Completed share of the goal, 0..1."""
    error: float = math.nan
    """While running, the largest distance from the desired state; after the end, the worst joint's distance
    from the goal. SI units; NaN if unknown.
    """
    joint: str = ""
    text: str = ""


class PlayedPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Part of a motion for one controller: timed commands of one kind, or a single goal command."""

    controller: str
    kind: str
    at_ns: tuple[int, ...]
    """Time of each command since the start of the motion; not decreasing."""
    sizes: tuple[int, ...]
    """Number of float64 values in each command."""
    end_ns: int = 0
    """Time at which the motion of this part ends, ns since the start of the motion."""
    positions: tuple[float | None, ...] = ()
    """Final position of each joint of the controller, rad or m, None for joints without one. Empty: the part
    has no positions."""


class PlayedMotion(msgspec.Struct):
    """Timed commands that the runtime sends to a controller, and the goal that it pursues by them."""

    goal: RunningGoal
    part: PlayedPart
    commands: tuple[NDArray[np.float64], ...]
    begun_ns: int
    """Start of the motion, ns of the controllers' time."""
    next: int = 0

    def due(self, time_ns: int) -> NDArray[np.float64] | None:
        """Return the next command and advance, if it is due at this controllers' time, ns; else None."""
        if self.next < len(self.commands) and self.begun_ns + self.part.at_ns[self.next] <= time_ns:
            self.next += 1
            return self.commands[self.next - 1]
        return None

    def report_progress(self, time_ns: int) -> None:
        """Report the motion's progress to its goal.

        After the last command, start to judge the joints' states.
        """
        passed_ns, end_ns = time_ns - self.begun_ns, self.part.end_ns
        if self.goal.is_judged:
            return
        if self.next == len(self.commands) and passed_ns >= end_ns:
            given = self.part.positions
            positions = np.array([np.nan if one is None else one for one in given]) if given else None
            self.goal.judge(positions, text="all commands were sent")
        else:
            self.goal.feedback(min(1.0, passed_ns / end_ns) if end_ns > 0 else 0.0)


class CurrentCommands(NamedTuple):
    """Joints that a controller commands, with its current commands before any limit."""

    joints: tuple[str, ...] = ()
    positions: Floats | None = None
    """Commanded positions, rad or m, before any limit; None: no position commands."""
    velocities: Floats | None = None
    """Commanded velocities, rad/s or m/s; None: no velocity commands, or they are the speeds of position
    commands.
    """

    @classmethod
    def by_interfaces(cls, joints: tuple[str, ...], interfaces: Sequence[str], commands: Commands) -> Self:
        """Return the commanded positions if `interfaces` has them, else the velocities if it has those."""
        if not interfaces:
            return cls()
        if "position" in interfaces:
            return cls(joints, positions=commands.position)
        return cls(joints, velocities=commands.velocity if "velocity" in interfaces else None)


class _Target(NamedTuple):
    """Position that one joint must reach for a goal, with its tolerances."""

    joint: JointPlan
    column: int
    """Index of the joint among the controller's joints."""
    row: int
    position: float
    """Required position before any limit, rad or m; NaN: any position."""
    tolerance: float
    """Permitted distance from the position, rad or m."""
    rest_speed: float
    """Speed below which the joint counts as at rest, rad/s or m/s."""


class _Judgement(NamedTuple):
    """Targets and deadlines by which the runtime decides the outcome of a goal whose motion has ended."""

    targets: tuple[_Target, ...]
    text: str
    settle_ns: int
    """Time that joints have after the motion to come within their tolerances."""
    back_ns: int
    """Deadline for a lost joint to respond again, ns of the controllers' time. Its settling time starts
    then."""
    settled_ns: int
    """Deadline for joints to come within their tolerances, ns of the controllers' time."""
    certain_ns: int
    """Deadline for missing replies and uncertain torque, ns of the controllers' time. The goal is aborted
    then."""


class RunningGoal:
    """One goal of a controller; implements `controller.Goal`. Nothing changes it after its end."""

    def __init__(self, goals: GoalRegistry, number: int, controller: str, kind: str, origin: str) -> None:
        self.number = number
        self.controller = controller
        self.kind = kind
        self.origin = origin
        self.cancelling = False
        """True after a client asked to cancel the goal."""
        self.has_begun = False
        """True once the controller can no longer refuse the goal: it has planned it, or was deactivated."""
        self.outcome: Outcome | None = None
        """Outcome of the goal; None while it is running."""
        self.progress, self.error, self.joint, self.text = 0.0, math.nan, "", ""
        """Values of the last report."""
        self.judgement: _Judgement | None = None
        """Criteria for the outcome; None until the motion has ended."""
        self.accepted_ns = goals.time_ns
        """Time at which the goal was accepted, ns of the controllers' time."""
        self._goals = goals
        self._reported_ns = -FEEDBACK_NS

    @property
    def refusal(self) -> Refusal | None:
        """Refusal of the goal's command if the controller aborted the goal before it began; else None."""
        if self.outcome is not Outcome.ABORTED or self.has_begun:
            return None
        fields = {"controller": self.controller, "kind": self.kind, "problem": self.text}
        return Refusal(Code.GOAL_REFUSED, {**fields, "goal": self.number})

    @property
    def is_judged(self) -> bool:
        """True from the end of the motion to the end of the goal, while the runtime decides the outcome."""
        return self.judgement is not None

    def feedback(self, progress: float, error: float = math.nan) -> None:
        """Set progress, 0..1, and the largest distance from the desired state, SI units.

        Publish them at 10 Hz at most.
        """
        if self.outcome is not None or self.is_judged:
            return
        self.has_begun = True
        self.progress, self.error = float(progress), float(error)
        now_ns = self._goals.now_ns
        if now_ns - self._reported_ns >= FEEDBACK_NS:
            self._reported_ns = now_ns
            self._goals.publish(self, "running")

    def judge(
        self,
        positions: Floats | None = None,
        *,
        joints: Sequence[str] | None = None,
        tolerances: GoalTolerances | None = None,
        text: str = "",
    ) -> None:
        """End the motion: from now on, the joints' states decide the outcome; see `controller.Goal.judge`."""
        if self.outcome is None and not self.is_judged:
            self.has_begun = True
            self._goals.begin_judging(self, positions, joints, tolerances, text)

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = math.nan,
        joints: Sequence[str] | None = None,
    ) -> None:
        """End the goal with an outcome. Ignored if the goal has already ended.

        `REACHED` is verified by the joints' states, see `controller.Goal.end`.
        """
        if self.outcome is not None:
            return
        outcome = Outcome(outcome)
        if outcome is Outcome.REACHED:
            self.judge(self._goals.commanded_positions(self.controller), joints=joints, text=text)
        else:
            self._goals.end_goal(self, outcome, text=text, joint=joint, error=float(error), joints=joints)


class GoalRegistry:
    """All goals of a run. Their numbers depend on the commands only, so a replay assigns the same ones."""

    def __init__(
        self,
        record: CycleRecord,
        events: EventSink,
        joints: Sequence[JointPlan] = (),
        commanded: Callable[[str], CurrentCommands] = lambda controller: CurrentCommands(),
    ) -> None:
        """Create the goals of a run.

        Args:
            record: The cycle's record.
            events: Log of events.
            joints: All joints of the robot, in row order.
            commanded: Returns the current commands of a controller by its name.
        """
        self.time_ns = 0
        """Controllers' time of this cycle, ns. It excludes pauses, which must not shorten a settling time."""
        self._joints = {joint.name: (row, joint) for row, joint in enumerate(joints)}
        self._commanded = commanded
        self.last = 0
        """Number of the newest goal; 0: there was none."""
        self.running: dict[int, RunningGoal] = {}
        """Goals that have not ended, by number; at most one for each controller."""
        self._record = record
        self._events = events
        self._ended: list[tuple[int, str, Outcome] | None] = [None] * KEPT
        self._publisher: Publisher | None = None
        self._status = GoalStatus()

    def open_topic(self, topics: TopicLog) -> None:
        """Announce the topic /goals, once a run, for the first controller that accepts goals. Allocates."""
        if self._publisher is None:
            self._publisher = topics.open(GOALS_TOPIC, GoalStatus)

    @property
    def now_ns(self) -> int:
        """Wake-up time of this cycle, ns of the run's clock."""
        return self._record.woken_ns

    def accept_goal(self, controller: str, kind: str, origin: str) -> RunningGoal:
        """Create the next goal of a controller and report it. Its previous goal must have ended."""
        self.last += 1
        goal = self.running[self.last] = RunningGoal(self, self.last, controller, kind, origin)
        self._report_goal(goal, texts.goal_accepted(goal.number, kind, origin), "accepted")
        return goal

    def found(self, number: int) -> RunningGoal | Refusal:
        """Return the running goal with this number, or a refusal if it has ended or never existed."""
        goal = self.running.get(number)
        if goal is not None:
            return goal
        if not 0 < number <= self.last:
            return Refusal(Code.UNKNOWN_GOAL, {"goal": number, "last": self.last})
        ended = self._ended[number % KEPT]
        if ended is None or ended[0] != number:
            return Refusal(Code.GOAL_ENDED, {"goal": number, "outcome": "long ago"})
        return Refusal(Code.GOAL_ENDED, {"goal": number, "controller": ended[1], "outcome": ended[2].value})

    def commanded_positions(self, controller: str) -> Floats | None:
        """Return a copy of a controller's current position commands, rad or m; None if it commands none."""
        positions = self._commanded(controller).positions
        return None if positions is None else positions.copy()

    def begin_judging(
        self,
        goal: RunningGoal,
        positions: Floats | None,
        joints: Sequence[str] | None,
        tolerances: GoalTolerances | None,
        text: str,
    ) -> None:
        """Start to judge a goal whose motion has ended, with tolerances from the robot's joints by default.

        See `controller.Goal.judge` for the arguments.
        """
        names = self._commanded(goal.controller).joints
        settle_ns = None if tolerances is None else tolerances.settle_ns
        targets, longest_ns = [], 0
        for index, name in enumerate(names):
            if joints is not None and name not in joints:
                continue
            row, plan = self._joints[name]
            longest_ns = max(longest_ns, plan.settle_ns)
            position, near, slow = math.nan, math.nan, math.nan
            if positions is not None:
                position = float(positions[index])
            if tolerances is not None:
                near, slow = float(tolerances.position[index]), float(tolerances.velocity[index])
            near = plan.goal_tolerance if math.isnan(near) else near
            slow = plan.highest_rest_speed if math.isnan(slow) else slow
            if positions is None:
                slow = UNLIMITED
            targets.append(_Target(plan, index, row, position, near, slow))
        settle_ns = longest_ns if settle_ns is None else settle_ns
        if tolerances is not None and tolerances.left_ns is not None:
            settle_ns = min(settle_ns, tolerances.left_ns)
        settled_ns, certain_ns = self._settling(settle_ns)
        goal.judgement = _Judgement(tuple(targets), text, settle_ns, certain_ns, settled_ns, certain_ns)
        self._judge(goal, goal.judgement)

    def _settling(self, settle_ns: int) -> tuple[int, int]:
        """Return two deadlines, counted from now, ns of the controllers' time; the second is never earlier.

        The first is for joints to come within their tolerances. The second is for missing replies to arrive
        and for torque to be confirmed.
        """
        settled_ns = self.time_ns + settle_ns
        return settled_ns, max(
            settled_ns, self.time_ns + max(CERTAIN_NS, LOST_CYCLES * self._record.period_ns)
        )

    def _judge(self, goal: RunningGoal, judgement: _Judgement) -> None:
        """End a goal if its joints' states decide the outcome: reached, missed or aborted.

        Otherwise wait for more cycles.
        """
        states, targets, text, now_ns = self._record.states, judgement.targets, judgement.text, self.time_ns
        rows = [target.row for target in targets]
        lost = [row for row in rows if states.torque.item(row) == Torque.LOST]
        unable = states.unable([row for row in rows if row not in lost])
        if lost and unable is None and now_ns < judgement.back_ns:
            settled_ns, certain_ns = self._settling(judgement.settle_ns)
            goal.judgement = judgement._replace(settled_ns=settled_ns, certain_ns=certain_ns)
            return
        unable = unable or states.unable(lost)
        doubtful = None if unable is not None else states.doubtful(rows)
        if doubtful is not None and now_ns < judgement.certain_ns:
            return
        found = unable or doubtful
        outcome, joint, error = Outcome.REACHED, "", math.nan
        if found is not None:
            outcome, target = Outcome.ABORTED, targets[rows.index(found[0])]
            joint = target.joint.name
            error, reason = self._describe_unable(judgement, joint, found[1])
        else:
            joint, error, reason = self._find_worst(targets, self._commanded(goal.controller).velocities)
            if reason and now_ns < judgement.settled_ns:
                return
            outcome = Outcome.MISSED if reason else Outcome.REACHED
        if text:
            text = f"{reason}; {text}" if reason else text
        else:
            text = f"after {(now_ns - goal.accepted_ns) * 1e-9:.3f} s{', ' * bool(reason)}{reason}"
        self._close(goal, outcome, text, joint, error)

    def _find_worst(self, targets: Sequence[_Target], velocities: Floats | None) -> tuple[str, float, str]:
        """Return the worst joint's name, distance from its target and problem.

        No problem: the goal is reached.

        Joints outside of their tolerances rank first, moving joints second. A joint whose commanded velocity
        is not 0 counts as moving, even if it is slow.
        """
        states = self._record.states
        worst: tuple[int, float, str, float, str] = (0, -1.0, "", math.nan, "")
        for target in targets:
            plan = target.joint
            error = abs(plan.way(states.position.item(target.row), target.position))
            speed = abs(states.velocity.item(target.row))
            commanded = 0.0
            if velocities is not None and math.isnan(target.position):  # else they hold the position
                commanded = abs(velocities.item(target.column))
            rank, off, reason = 0, 0.0 if math.isnan(error) else error, ""
            if error > target.tolerance:
                rank, reason = 2, f"joint {plan.name} is {plan.unit.text(error)} off"
            elif speed > target.rest_speed:
                rank, off = 1, speed
                reason = f"joint {plan.name} still moves at {plan.unit.speed_text(speed)}"
            elif commanded > 0 and target.rest_speed < UNLIMITED:
                rank, off = 1, commanded
                shown = plan.unit.speed_text(commanded)
                reason = f"joint {plan.name} ends with a commanded velocity of {shown}"
            if (rank, off) > worst[:2]:
                name = "" if math.isnan(error) and not reason else plan.name
                worst = rank, off, name, error, reason
        return worst[2:]

    def end_goal(
        self,
        goal: RunningGoal,
        outcome: Outcome,
        *,
        text: str,
        joint: str,
        error: float,
        joints: Sequence[str] | None,
    ) -> None:
        """End a goal with the outcome that its controller reports.

        A missed goal becomes aborted if a joint is lost or limp. The report of an aborted goal names that
        joint.
        """
        names = self._commanded(goal.controller).joints if joints is None else joints
        if outcome in _UNREACHED and names:
            rows = [self._joints[name][0] for name in names]
            if (found := self._record.states.unable(rows)) is not None:
                unable, why = names[rows.index(found[0])], found[1]
                known = error if unable == joint else math.nan
                error, named = self._describe_unable(goal.judgement, unable, why)
                error = known if math.isnan(error) else error
                outcome, joint, given = Outcome.ABORTED, unable, f"joint {unable} {why}"
                text = text.replace(given, named) if given in text else f"{named}{'; ' * bool(text)}{text}"
        self._close(goal, outcome, text, joint, error)

    def _describe_unable(self, judgement: _Judgement | None, joint: str, why: str) -> tuple[float, str]:
        """Return how far a lost or limp joint is from its target, and the problem as text.

        The distance is in rad or m, and NaN before the motion has ended.
        """
        row, plan = self._joints[joint]
        targets = () if judgement is None else judgement.targets
        position = next((target.position for target in targets if target.row == row), math.nan)
        error = abs(plan.way(self._record.states.position.item(row), position))
        off = "" if math.isnan(error) else f"; it is {plan.unit.text(error)} off"
        return error, f"joint {plan.label} {why}{off}"

    def _close(self, goal: RunningGoal, outcome: Outcome, text: str, joint: str, error: float) -> None:
        goal.outcome, goal.judgement = outcome, None
        goal.error, goal.joint, goal.text = error, _writable(joint), _writable(text)
        if not goal.text and goal.joint and math.isfinite(error):
            unit = self._joints[goal.joint][1].unit if goal.joint in self._joints else ROTARY
            goal.text = f"joint {goal.joint} is {unit.text(error)} off"
        if outcome is Outcome.REACHED:
            goal.progress = 1.0
        del self.running[goal.number]
        self._ended[goal.number % KEPT] = (goal.number, goal.controller, outcome)
        ended = texts.goal_failed if outcome in _UNREACHED else texts.goal_ended
        self._report_goal(goal, ended(goal.number, outcome, goal.text), outcome.value)

    def judge_running(self) -> None:
        """Check all goals whose motions have ended, and end those whose outcome is clear.

        Called once a cycle.
        """
        for goal in tuple(self.running.values()):
            if goal.judgement is not None:
                self._judge(goal, goal.judgement)

    @property
    def are_settling(self) -> bool:
        """True while any goal's motion has ended but its outcome is still open."""
        return any(goal.is_judged for goal in self.running.values())

    def _report_goal(self, goal: RunningGoal, event: EventBody, status: str) -> None:
        error = goal.error if math.isfinite(goal.error) else None
        about = goal.number, goal.controller, goal.kind, goal.origin
        refused = goal.refusal is not None and goal.text != RUN_ENDED
        report = GoalReport(*about, status, goal.text, goal.joint, error, refused)
        self._events.emit_event(goal.controller, event, msgspec.json.encode(report))
        self.publish(goal, status)

    def publish(self, goal: RunningGoal, status: str) -> None:
        """Publish a goal's number, progress and status on the topic /goals."""
        if self._publisher is None:
            return
        message = self._status
        message.goal, message.controller, message.kind = goal.number, goal.controller, goal.kind
        message.origin, message.status, message.progress = goal.origin, status, goal.progress
        message.error, message.joint, message.text = goal.error, goal.joint, goal.text
        self._publisher.publish(message)


def _writable(text: object) -> str:
    """Return a controller's text, cut to the longest report and with escapes for lone surrogates."""
    return str(text)[:_LONGEST_TEXT].encode(errors="backslashreplace").decode()
