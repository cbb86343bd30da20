"""cartesian_controller: move the tip of an arm to poses, or at twists, by inverse kinematics on the URDF."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar, Final, Literal, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    LINEAR,
    Angle,
    AngularAcceleration,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Goal,
    InputError,
    Interfaces,
    Length,
    LinearAcceleration,
    LinearVelocity,
    Mismatch,
    Mistake,
    Outcome,
    ParametersModel,
    RobotModel,
)
from dxlrun.tooling.robots import FrameTree, Transform, read_urdf, rotated
from dxlrun_space.chain import BASE, Chain, WrongChain, shifted
from dxlrun_space.path import (
    MotionLimits,
    NoPath,
    Path,
    Planning,
    Positions,
    plan_joints,
    plan_line,
    plan_positions,
    remark_on,
)
from dxlrun_space.solver import FULL, Solver, distance, residual_of
from dxlrun_space.space_goals import PoseCommand, TipGoal, TipTwist, TwistCommand, packed, unpacked
from dxlrun_space.stream import TipMotion, Twist

ACCELERATION: Final = 20.0
"""Acceleration of joints without a limit, rad/s^2; an XM430 stops from its highest speed in 0.25 s."""
SPEED: Final = 4.0
"""Speed of joints without a limit, rad/s: less than the slowest arm servo's at 12 V."""
STEP_NS: Final = 300_000
"""Period that pays for one step of planning: a step takes 0.05 ms, so planning takes 17 % of a cycle."""
MOST_STEPS: Final = 50
"""Most steps of a cycle, 2.5 ms."""
_LONGEST_STOP_S: Final = 2.0
_MOVES: Final = "the arm moves; ask again when it rests"
NO_TWIST: Final[Twist] = (BASE.translation, BASE.translation)
Task: TypeAlias = "Generator[bool | None, None, None]"
"""Motion or planning that advances with each `next`; True if the cycle has no time for another step."""


class TranslationLimits(ParametersModel):
    """Limits of the tip's translation."""

    velocity: Annotated[LinearVelocity, Field(gt=0)] = 0.2
    """Highest speed of the tip, m/s; near a singularity a twist leaves its direction to keep it."""
    acceleration: Annotated[LinearAcceleration, Field(gt=0)] = 0.5
    """Highest acceleration of the tip, m/s^2; near a singularity joints and `velocity` may need more."""


class RotationLimits(ParametersModel):
    """Limits of the tip's rotation."""

    velocity: Annotated[AngularVelocity, Field(gt=0)] = 1.5
    """Highest angular velocity of the tip, rad/s."""
    acceleration: Annotated[AngularAcceleration, Field(gt=0)] = 6.0
    """Highest angular acceleration of the tip, rad/s^2."""


class LeaderParameters(ParametersModel):
    """Another arm, whose tip is followed."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """All joints that move its tip in its base."""
    tip: str
    """Link of the URDF that leads. Its axes are those of the tip that follows."""
    base: str = ""
    """Link of the URDF whose axes are those of the follower's base; empty: the root."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Factor on the position of the leader's tip."""
    offset: Annotated[tuple[Length, ...], Field(min_length=3, max_length=3)] = (0.0, 0.0, 0.0)
    """Offset added to the scaled position: x, y, z, m."""
    relative: bool = False
    """Follow the leader's motion from the poses of both tips at the activation; `offset` has no effect."""


class CartesianParameters(ParametersModel):
    """Keys of a cartesian_controller in the robot file."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """All joints that move the tip in the base."""
    tip: str
    """Link of the URDF that is moved."""
    base: str = ""
    """Link of the URDF in whose axes poses are; empty: the root."""
    linear: TranslationLimits = TranslationLimits()
    angular: RotationLimits = RotationLimits()
    orientation: Literal["exact", "nearest"] | None = None
    """`exact` refuses a pose whose orientation cannot be reached; `nearest` reaches the position first. By
    default `exact` with six joints or more."""
    posture: Mapping[str, Angle] = {}
    """Positions by joint to which the arm tends where a pose leaves a choice. By default it turns little."""
    timeout: Annotated[Duration, Field(gt=0)] = 200_000_000
    """Longest age of a twist, or of the state of a joint that leads or moves a `frame`. The tip brakes if a
    twist or a leader's state is older."""
    leader: LeaderParameters | None = None
    """Arm whose tip is followed. Poses and twists are refused then."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield joints that lead and follow, and names in `posture` that are not joints of the controller."""
        yield from super().mistakes()
        for name in self.posture:
            if name not in self.joints:
                known = ", ".join(self.joints)
                yield ("posture", name), f"{name} is not one of its joints; they are {known}"
        for name in () if self.leader is None else self.leader.joints:
            if name in self.joints:
                yield ("leader", "joints"), f"{name} is leader and follower; remove one of the two"


@dataclass(frozen=True, slots=True)
class PosePlan:
    """Message of the topic `plan`: the motion that the command `plan` asked for, and that is not made."""

    x: float
    """Goal position of the tip in the base, m; NaN if the place of the pose is not known."""
    y: float
    z: float
    positions: Floats
    """Goal positions of the joints, rad; NaN without a motion."""
    duration: float
    """Shortest duration, s; NaN without a motion."""
    text: str
    """Reason for no motion, or the part of the pose that is not reached."""


class CartesianController(Controller[CartesianParameters]):
    """Controller that moves a link to poses in space, one goal at a time, or at the twists of a stream.

    A motion is planned as a whole before it begins, some steps in each cycle, so what is out of reach is
    refused while the joints are still at rest. A new goal first brakes the old motion on its path. A twist
    moves a pose that the tip follows, and that stays near what is in reach.
    """

    Parameters = CartesianParameters
    Commands: ClassVar = {"pose": PoseCommand, "twist": TwistCommand, "plan": PoseCommand}
    Goals = frozenset({"pose"})
    plans = Goals
    Topics: ClassVar = {"plan": PosePlan}

    @classmethod
    def interfaces(cls, parameters: CartesianParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command positions; read positions and ages of the leader's joints, or of all other joints, for the
        frames that these move.
        """
        leader = parameters.leader
        others = leader.joints if leader else [joint for joint in joints if joint not in parameters.joints]
        reads = tuple(f"{joint}/{state}" for state in ("position", "age") for joint in others)
        return Interfaces(parameters.joints, ("position",), reads=reads, optional=() if leader else reads)

    @classmethod
    def mismatches(cls, parameters: CartesianParameters, robot: RobotModel) -> Iterator[Mismatch]:
        """Yield a missing URDF, a chain that the URDF does not have, or poses that are always refused."""
        if robot.urdf is None:
            yield Mismatch("needs a URDF, but the robot file names none", "write `model: {urdf: NAME.urdf}`")
            return
        place, own = "", (*robot.joints, *robot.others)
        try:
            urdf = read_urdf(robot.urdf)
            for place, one in (("", parameters), ("leader.", parameters.leader)):
                if one is None:
                    continue
                moving = Chain(urdf, one.base, one.tip).joints
                if lacking := next((joint for joint in moving if joint not in own), ""):
                    what = f"needs joint {lacking}, which is omitted or has no servo, to move {one.tip}"
                    yield Mismatch(what, f"remove the controller, or run with {lacking}", f"{place}tip")
                    return
                Chain(urdf, one.base, one.tip, one.joints)
            for name, unit in zip(robot.joints, robot.units, strict=True):
                joint = urdf.joint(name)
                if joint is not None and (joint.type == "prismatic") != (unit is LINEAR):
                    what = f"needs {name} to be the same in both files, but it is {joint.type} in the URDF"
                    yield Mismatch(what, "correct its type in the URDF", name)
            for name, pose in robot.poses.items() if _is_exact(parameters) else ():
                if pose.remark and pose.positions.keys() == set(robot.joints):
                    what = f"refuses pose {name}: it is {pose.remark}"
                    fix = "give the pose another orientation, or write `orientation: nearest`"
                    yield Mismatch(what, fix, "orientation")
        except WrongChain as wrong:
            yield Mismatch(f"cannot move the tip: {wrong.what}", wrong.fix, place + wrong.key)
        except InputError as error:
            yield Mismatch(f"cannot use the URDF: {' '.join(str(error).split())}", "correct the URDF")

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: CartesianParameters
    ) -> NDArray[np.float64]:
        """Return a pose or a twist as one flat array. Raises ValueError if the tip follows a leader."""
        if parameters.leader is not None:
            fix = "send it to a cartesian_controller without `leader`"
            raise ValueError(f"the tip follows a leader, so a {kind} is not accepted; {fix}")
        goal = cast("PoseCommand | TwistCommand", command).prepared(parameters.joints)
        if isinstance(goal, TipGoal) and goal.remark and _is_exact(parameters):
            raise ValueError(f"the pose is {goal.remark}; name another pose, or write `orientation: nearest`")
        return packed(goal)

    @classmethod
    def check_command(
        cls, kind: str, command: CommandModel, parameters: CartesianParameters, robot: RobotModel
    ) -> None:
        """Raise ValueError for a frame that the robot does not have, or that an omitted joint moves."""
        if isinstance(command, PoseCommand | TwistCommand) and command.frame and robot.urdf:
            try:
                _frames(robot.urdf, (*robot.joints, *robot.others)).movers(command.frame, parameters.base)
            except LookupError as error:
                raise ValueError(error.args[0]) from None

    def on_configure(self, context: Context) -> None:
        """Build the chain, and everything that the loop needs."""
        super().on_configure(context)
        parameters, limits, joints = self.parameters, context.limits, context.joints
        urdf, leader = read_urdf(context.urdf or ""), parameters.leader
        self._chain = Chain(urdf, parameters.base, parameters.tip, joints)
        self._leader = None if leader is None else Chain(urdf, leader.base, leader.tip, leader.joints)
        self._others = [name.partition("/")[0] for name in context.read_names[: len(context.reads) // 2]]
        self._position, self._age = context.reads.reshape(2, -1)
        """Positions and ages of the leader's joints, or of the others."""
        self._frames = FrameTree(urdf, (*joints, *self._others))
        linear, angular = parameters.linear, parameters.angular
        speeds = np.nan_to_num(limits.velocity, nan=SPEED).tolist()
        rates = np.nan_to_num(limits.acceleration, nan=ACCELERATION).tolist()
        self._limits = MotionLimits(
            (linear.velocity, angular.velocity, *speeds), (linear.acceleration, angular.acceleration, *rates)
        )
        posture = [parameters.posture.get(joint) for joint in joints]
        self._solver = Solver(self._chain, limits.lower.tolist(), limits.upper.tolist(), posture)
        self._exact = _is_exact(parameters)
        self._steps = min(MOST_STEPS, max(1, context.period_ns // STEP_NS))
        self._motion = TipMotion(self._solver, self._limits, exact=self._exact, steps=self._steps // 2 + 2)
        self._at: Positions = ()
        """Commanded positions, rad; empty while a joint has not answered yet."""
        self._now_ns, self._period_s, self._commanded_ns = 0, context.period_ns * 1e-9, 0
        self._turns_with_tip = self._is_ignoring = False
        self._forget()

    def _forget(self) -> None:
        self._task = self._work()
        self._moves = self._brakes = self._is_held = False
        self._tried: tuple[TipGoal, Transform] | None = None
        """Request of `plan` with its goal pose, until the answer."""
        self._goal: Goal | None = None
        self._waiting: TipGoal | None = None
        self._target: Transform | None = None
        self._twist = NO_TWIST

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals."""
        self._drop_plan("the controller was activated again; ask again")
        self._forget()
        self._hold_joints()
        self._write()

    def on_deactivate(self, time_ns: int) -> None:
        """Answer a request for a plan that is not finished."""
        self._drop_plan("the controller was deactivated; ask again when it is active")

    def _hold_joints(self) -> str:
        """Hold the positions that were sent, or else the measured ones; return a joint that has neither."""
        goals, states = self.context.goals.position, self.context.states.position
        held = np.where(np.isnan(goals), states, goals)
        lacking = np.isnan(held)
        self._at = () if lacking.any() else tuple(held.tolist())
        return "" if self._at else self.context.joints[int(lacking.argmax())]

    def _write(self) -> None:
        if self._at:
            self.context.commands.position[:] = self._at

    # Goals

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Plan a motion to the pose; a motion that is under way brakes first."""
        self._goal, self._target = goal, None
        self._pass_to(unpacked(data, TipGoal))

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Follow a twist; a pose that is under way ends as preempted. Or plan without moving."""
        if kind == "plan":
            self._begin_plan(unpacked(data, TipGoal))
        elif self._at or not self._hold_joints():
            self._follow_twist(unpacked(data, TipTwist), time_ns)

    def _begin_plan(self, asked: TipGoal) -> None:
        self._drop_plan("replaced by a newer request")
        try:
            self._tried = asked, self._goal_pose(asked)
        except (LookupError, ValueError) as error:
            self._publish(None, str(error))
            return
        if self._moves or self._goal is not None:
            self._drop_plan(_MOVES)
        else:
            self._task = self._work()

    def _follow_twist(self, twist: TipTwist, time_ns: int) -> None:
        self._turns_with_tip = twist.frame == self._chain.tip
        try:
            rotation = (BASE if self._turns_with_tip else self._pose_of(twist.frame)).rotation
        except (LookupError, ValueError) as error:
            if not self._is_ignoring:
                self.context.warn(f"twist ignored: {error}")
            self._is_ignoring, self._twist = True, NO_TWIST
            return
        self._is_ignoring, self._commanded_ns = False, time_ns
        if self._goal is not None:
            self._end(Outcome.PREEMPTED, "replaced by a twist")
        self._pass_to(twist=(rotated(rotation, twist.linear), rotated(rotation, twist.angular)))

    def on_hold(self, time_ns: int) -> None:
        """Brake from the twist: the stream has ended."""
        self._twist = NO_TWIST
        self._write()

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Brake on the path; the goal ends when the tip rests."""
        self._pass_to()
        if not self._moves:
            self._end(Outcome.CANCELLED)

    def _pass_to(self, pose: TipGoal | None = None, twist: Twist = NO_TWIST) -> None:
        """Brake on the path, then pursue a pose or a twist; at once if the tip rests."""
        self._waiting, self._twist, self._brakes = pose, twist, True
        # A twist of 0 does not replace a plan.
        if not self._moves and (self._tried is None or pose is not None or any(map(any, twist))):
            self._drop_plan(_MOVES)
            self._task = self._work()

    def _end(self, outcome: Outcome, text: str = "") -> None:
        goal, self._goal = self._goal, None
        if goal is not None:
            goal.end(outcome, text)

    def _fail(self, text: str) -> None:
        """Abort the goal because of a joint."""
        if self._goal is not None and (self._waiting is not None or not self._moves):
            self._goal.feedback(0.0)  # otherwise the end before the motion is a refusal of the request
        self._end(Outcome.ABORTED, text)

    def _goal_pose(self, asked: TipGoal) -> Transform:
        """Return the goal pose of the tip in the base. Raises as `_pose_of`, and for a joint."""
        if joint := "" if self._at else self._hold_joints():
            raise ValueError(f"joint {joint} has not answered yet")
        if asked.positions:
            return self._chain.pose(asked.positions)
        return asked.target(self._pose_of(asked.frame), self._chain.pose(self._at))

    def _pose_of(self, frame: str) -> Transform:
        """Return the pose of a frame in the base. Raises LookupError or ValueError with what prevents it."""
        if not frame:
            return BASE
        movers = self._frames.movers(frame, self._chain.base)
        for index, joint in enumerate(self._others):
            if joint in movers and (silence := self._silence(index)):
                raise ValueError(f"no reply from {joint} {silence}, which moves frame {frame}")
        joints, at = (*self.context.joints, *self._others), (*self._at, *self._position.tolist())
        known = {joint: each for joint, each in zip(joints, at, strict=True) if joint in movers}
        return self._frames.pose(frame, self._chain.base, known)

    def _silence(self, index: int) -> str:
        """Return for how long a joint that is read has not answered; empty if it answers."""
        age_s = float(self._age[index])
        if age_s <= self.parameters.timeout * 1e-9:
            return ""
        return "yet" if math.isnan(age_s) else f"for {age_s:.2f} s"

    # In a cycle

    def update(self, time_ns: int, period_ns: int) -> None:
        """Advance planning, path or twist by a period, and command the positions."""
        self._now_ns, self._period_s = time_ns, period_ns * 1e-9
        if not self._at:
            self._hold_joints()
        if self.context.states.has_lost:
            self._abandon()
        else:
            for _ in range(self._steps):
                if next(self._task):
                    break
        self._write()

    def _work(self) -> Task:
        """Follow the leader, or do what was asked for last whenever the tip rests."""
        while True:
            self._brakes = False
            if self._leader is not None and self._at:
                yield from self._follow_leader(self._leader)
            elif self._waiting is not None:
                asked, self._waiting = self._waiting, None
                yield from self._pursue(asked)
            elif self._tried is not None:
                yield from self._try(*self._tried)
            elif any(map(any, self._twist)):
                yield from self._stream_twists()
            self._moves = False
            if self._waiting is None:  # then a goal that has not ended was cancelled
                self._end(Outcome.CANCELLED)
            yield True

    def _abandon(self) -> None:
        """Hold the goals that were sent: a joint is lost, and the runtime holds the others."""
        self._drop_plan("a joint is lost; ask again when it answers")
        if self._moves:
            self._hold_joints()
        text = ""
        if self._target is not None and self._at:
            left = residual_of(self._chain.pose(self._at), self._target)
            text = f"held {left.position * 1e3:.0f} mm before the pose"
        self._fail(text)
        self._forget()

    def _planned(self, asked: TipGoal, target: Transform) -> Planning:
        """Plan a motion from rest."""
        solver, exact = self._solver, self._exact and asked.rotation is not None
        at, limits = self._at, self._limits
        if asked.positions:
            planning = plan_positions(solver, at, asked.positions, target, limits)
        else:
            plan = plan_line if asked.path == "line" else plan_joints
            planning = plan(solver, at, target, limits, exact=exact)
        path = yield from planning
        if asked.seconds is not None and asked.seconds < path.duration_s:
            needed = math.ceil(path.duration_s * 100) / 100
            raise NoPath(f"the motion takes {needed:.2f} s within its limits; ask for at least this time")
        return path

    def _try(self, asked: TipGoal, goal: Transform) -> Task:
        """Plan a motion from rest to a pose, and publish it."""
        try:
            path = yield from self._planned(asked, goal)
        except NoPath as refusal:
            self._publish(goal, str(refusal))
        else:
            self._publish(goal, _remark(path, asked), path.last, path.duration_s)
        self._tried = None

    def _drop_plan(self, reason: str) -> None:
        """Answer a request for a plan that is not finished with the reason why it never will be."""
        if self._tried is not None:
            (_, goal), self._tried = self._tried, None
            self._publish(goal, reason)

    def _publish(
        self, goal: Transform | None, text: str, positions: Positions = (), seconds: float = math.nan
    ) -> None:
        x, y, z = (math.nan,) * 3 if goal is None else goal.translation
        last = np.array(positions or (math.nan,) * len(self.context.joints))
        self.context.publish("plan", PosePlan(x, y, z, last, seconds, text))

    def _pursue(self, asked: TipGoal) -> Task:
        """Plan a motion to a pose, make it, and let the runtime judge the goal at the end of the path.

        The time of the path passes more slowly while the tip brakes.
        """
        try:
            self._target = self._goal_pose(asked)
        except (LookupError, ValueError) as error:
            self._fail(str(error))
            return
        try:
            path = yield from self._planned(asked, self._target)
        except NoPath as refusal:
            self._end(Outcome.ABORTED, str(refusal))
            return
        self._moves = True
        yield True
        stretch, passed_s, rate, slope = 1.0, 0.0, 1.0, 0.0
        if path.duration_s > 0 and asked.seconds is not None:
            stretch = path.duration_s / asked.seconds
        while True:
            if self._brakes and not slope:
                slope = self._braking(path.sample(passed_s)[1], stretch)
            before, rate = rate, max(0.0, rate - slope * self._period_s)
            passed_s += (before + rate) / 2 * stretch * self._period_s
            self._at, _ = path.sample(passed_s)
            if rate == 0.0 or passed_s >= path.duration_s:
                break
            if self._goal is not None and not slope:
                off = float(np.abs(self.context.states.position - self._at).max())
                self._goal.feedback(passed_s / path.duration_s, off)
            yield True
        goal = self._goal
        if goal is not None and not slope:
            self._goal = None
            goal.judge(np.array(path.last), text=_remark(path, asked))

    def _braking(self, velocities: Positions, stretch: float) -> float:
        """Return the change of the path's rate with which the joints brake as fast as they may, 1/s."""
        rates = [
            most / max(abs(speed) * stretch, 1e-9)
            for speed, most in zip(velocities, self._limits.acceleration[2:], strict=True)
        ]
        # Half of the acceleration, because the path's own curvature needs the rest.
        return max(min(rates) / 2, 1 / _LONGEST_STOP_S)

    def _stream_twists(self) -> Task:
        """Move at the twist until it is 0 and the tip rests."""
        motion, self._moves = self._motion, True
        motion.begin_motion(self._at)
        while True:
            if self._now_ns - self._commanded_ns > self.parameters.timeout:
                self._twist = NO_TWIST
            linear, angular = self._twist
            if self._turns_with_tip:
                turn = motion.pose.rotation
                linear, angular = rotated(turn, linear), rotated(turn, angular)
            self._at = motion.advance_joints(linear, angular, self._period_s)
            held = motion.held_by
            self._report_hold("" if held < 0 else f"held: joint {self.context.joints[held]} is at its limit")
            if motion.rests and not (any(linear) or any(angular)):
                return
            yield True

    def _report_hold(self, text: str) -> None:
        """Report once why the tip is held; an empty text means that it moves."""
        if text and not self._is_held:
            self.context.say(text)
        self._is_held = bool(text)

    def _follow_leader(self, chain: Chain) -> Task:
        """Move the tip toward the pose of the leader while the leader answers."""
        leader, motion, self._moves = self.parameters.leader, self._motion, True
        motion.begin_motion(self._at)
        anchor: tuple[Transform, Transform] | None = None
        while leader is not None:
            twist, oldest = NO_TWIST, int(self._age.argmax())  # NaN, of no answer yet, counts as the oldest.
            silence = self._silence(oldest)
            if silence:
                anchor = None
            else:
                lead = chain.pose(self._position.tolist())
                x, y, z = (leader.scale * a + b for a, b in zip(lead.translation, leader.offset, strict=True))
                goal = Transform((x, y, z), lead.rotation)
                if leader.relative:
                    # The motion since the activation, in the axes of the base.
                    anchor = anchor or (goal, motion.pose)
                    way, turn = distance(anchor[0], goal)
                    goal = shifted(anchor[1], way, turn)
                twist = motion.twist_to(goal, self._period_s)
            self._report_hold(silence and f"no reply from leader {chain.joints[oldest]} {silence}, holding")
            self._at = motion.advance_joints(*twist, self._period_s)
            yield True


def _is_exact(parameters: CartesianParameters) -> bool:
    by_default = "exact" if len(parameters.joints) >= FULL else "nearest"
    return (parameters.orientation or by_default) == "exact"


def _remark(path: Path, asked: TipGoal) -> str:
    """Return what is not reached at the end of a path; empty if all is."""
    return asked.remark if asked.rotation is None else remark_on(path.residual)


@lru_cache(maxsize=8)
def _frames(urdf: str, joints: tuple[str, ...]) -> FrameTree:
    return FrameTree(read_urdf(urdf), joints)
