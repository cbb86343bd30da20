"""cartesian_controller: move the tip of an arm to poses, or at twists, by inverse kinematics on the URDF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, auto, unique
from typing import Annotated, ClassVar, Final, Literal

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
from dxlrun.tooling.robots import FrameTree, Urdf, read_urdf
from dxlrun_space.chain import BASE, IDENTITY, Chain, Pose, Rotation, Vector, WrongChain, rotation_of
from dxlrun_space.path import (
    MotionLimits,
    NoPath,
    Path,
    Planning,
    Positions,
    plan_joints,
    plan_line,
    shifted,
)
from dxlrun_space.solver import FULL, Solution, Solver, distance, residual_of
from dxlrun_space.space_goals import (
    PoseCommand,
    PoseGoal,
    TwistCommand,
    flat_pose,
    flat_twist,
    in_axes,
    read_pose,
    read_twist,
)
from dxlrun_space.stream import TwistMotion, approach

ACCELERATION: Final = 20.0
"""Acceleration of joints without a limit, rad/s^2; an XM430 stops from its highest speed in 0.25 s."""
SPEED: Final = 4.0
"""Speed of joints without a limit, rad/s: less than the slowest arm servo's at 12 V."""
STEP_NS: Final = 500_000
"""Period that pays for one step of planning: a step takes 0.06 ms, so planning takes 12 % of a cycle."""
MOST_STEPS: Final = 50
"""Most steps of a cycle, 3 ms."""
FEEDBACK_NS: Final = 100_000_000
"""Time between two feedback messages of a goal, ns."""
LEASH_M: Final = 0.02
"""Longest distance of the pose that moves toward a leader from what is in reach, m: the way back is short."""
_LONGEST_STOP_S: Final = 2.0
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


class TranslationLimits(ParametersModel):
    """Limits of the tip's translation."""

    velocity: Annotated[LinearVelocity, Field(gt=0)] = 0.2
    """Highest speed of the tip, m/s."""
    acceleration: Annotated[LinearAcceleration, Field(gt=0)] = 0.5
    """Highest acceleration of the tip, m/s^2."""


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
    """Longest age of a twist, or of a leader's state. The tip brakes if it is older."""
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
    """Goal position of the tip in the base, m."""
    y: float
    z: float
    positions: Floats
    """Goal positions of the joints, rad; NaN without a motion."""
    duration: float
    """Shortest duration, s; NaN without a motion."""
    text: str
    """Reason for no motion, or the part of the pose that is not reached."""


@unique
class _Phase(Enum):
    RESTING = auto()
    PLANNING = auto()
    MOVING = auto()
    STOPPING = auto()
    """The tip brakes on its path, or from its twist; then a waiting goal begins."""
    STREAMING = auto()


class CartesianController(Controller[CartesianParameters]):
    """Controller that moves a link to poses in space, one goal at a time, or at the twists of a stream.

    A motion is planned as a whole before it begins, some steps in each cycle, so what is out of reach is
    refused while the joints are still at rest. A new goal first brakes the old motion on its path. A twist
    that leads to a limit of a joint, or to a singularity, becomes slower.
    """

    Parameters = CartesianParameters
    Commands: ClassVar = {"pose": PoseCommand, "twist": TwistCommand, "plan": PoseCommand}
    Goals = frozenset({"pose"})
    Topics: ClassVar = {"plan": PosePlan}

    @classmethod
    def interfaces(cls, parameters: CartesianParameters, joints: tuple[str, ...]) -> Interfaces:
        """Command positions; read the positions of all other joints, for frames that these move, or the
        positions and ages of the leader's joints.
        """
        if (leader := parameters.leader) is not None:
            reads = [f"{joint}/{state}" for state in ("position", "age") for joint in leader.joints]
            return Interfaces(parameters.joints, ("position",), reads=tuple(reads))
        others = tuple(f"{joint}/position" for joint in joints if joint not in parameters.joints)
        return Interfaces(parameters.joints, ("position",), reads=others)

    @classmethod
    def mismatches(cls, parameters: CartesianParameters, robot: RobotModel) -> Iterator[Mismatch]:
        """Yield a missing URDF, or a chain that the URDF does not have."""
        if robot.urdf is None:
            yield Mismatch("needs a URDF, but the robot file names none", "write `model: {urdf: NAME.urdf}`")
            return
        place = ""
        try:
            urdf = read_urdf(robot.urdf)
            Chain(urdf, parameters.base, parameters.tip, parameters.joints)
            if (leader := parameters.leader) is not None:
                place = "leader."
                Chain(urdf, leader.base, leader.tip, leader.joints)
            for name, unit in zip(robot.joints, robot.units, strict=True):
                joint = urdf.joint(name)
                if joint is not None and (joint.type == "prismatic") != (unit is LINEAR):
                    what = f"needs {name} to be the same in both files, but it is {joint.type} in the URDF"
                    yield Mismatch(what, "correct its type in the URDF", name)
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
            raise ValueError(f"the tip follows a leader; a {kind} is not accepted")
        if isinstance(command, PoseCommand):
            return flat_pose(command)
        if isinstance(command, TwistCommand):
            return flat_twist(command)
        return super().prepare(kind, command, parameters)

    def on_configure(self, context: Context) -> None:
        """Build the chain, and everything that the loop needs."""
        super().on_configure(context)
        parameters, limits = self.parameters, context.limits
        if context.urdf is None:
            raise ValueError("no URDF; write `model: {urdf: NAME.urdf}`")
        urdf = read_urdf(context.urdf)
        self._chain = Chain(urdf, parameters.base, parameters.tip, context.joints)
        self._frames = _frames(urdf, context)
        self._leader: Chain | None = None
        if (leader := parameters.leader) is not None:
            self._leader = Chain(urdf, leader.base, leader.tip, leader.joints)
            self._leader_position, self._leader_age = context.reads.reshape(2, -1)
        lower, upper = limits.lower.tolist(), limits.upper.tolist()
        self._limits = MotionLimits(
            tuple(np.where(np.isnan(limits.velocity), SPEED, limits.velocity).tolist()),
            tuple(np.where(np.isnan(limits.acceleration), ACCELERATION, limits.acceleration).tolist()),
            parameters.linear.velocity,
            parameters.linear.acceleration,
            parameters.angular.velocity,
            parameters.angular.acceleration,
        )
        posture = parameters.posture
        self._solver = Solver(self._chain, lower, upper, [posture.get(joint) for joint in context.joints])
        self._exact = parameters.orientation == "exact" or (
            parameters.orientation is None and len(context.joints) >= FULL
        )
        self._stream = TwistMotion(self._chain, lower, upper, self._limits, exact=self._exact)
        self._steps = min(MOST_STEPS, max(1, context.period_ns // STEP_NS))
        self._at: Positions = ()
        """Commanded positions, rad; empty while a joint has not answered yet."""
        self._forget()

    def _forget(self) -> None:
        self._phase = _Phase.RESTING
        self._goal: Goal | None = None
        self._is_trial = False
        """True while a motion is planned to be published, and not to be made."""
        self._waiting: PoseGoal | None = None
        self._ending: Outcome | None = None
        """Outcome of the goal once the tip rests; None: another goal begins then."""
        self._asked: PoseGoal | None = None
        self._target: Pose = BASE
        self._planning: Planning | None = None
        self._path: Path | None = None
        self._passed_s = self._rate = self._slope = 0.0
        self._stretch = 1.0
        self._start_ns = self._feedback_ns = self._commanded_ns = 0
        self._twist = _ZERO, _ZERO
        self._turns_with_tip = False
        self._said_held = False
        self._followed: Pose | None = None
        """Pose that moves toward the leader's, and that the tip has."""

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals."""
        self._forget()
        self._stream.drop_twist()
        self._hold_joints()
        self._write()

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime has ended."""
        self._goal = None

    def _hold_joints(self) -> None:
        """Hold the positions that were sent, or else the measured ones."""
        goals, states = self.context.goals.position, self.context.states.position
        held = np.where(np.isnan(goals), states, goals)
        self._at = () if np.isnan(held).any() else tuple(held.tolist())

    def _write(self) -> None:
        if self._at:
            self.context.commands.position[:] = self._at

    # Goals

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Plan a motion to the pose; a motion that is under way brakes first."""
        self._goal, self._start_ns, self._feedback_ns = goal, time_ns, time_ns + FEEDBACK_NS
        self._ending, self._is_trial = None, False
        if not self._at:
            self._hold_joints()
        if not self._at:
            unknown = np.isnan(self.context.states.position)
            joint = self.context.joints[int(unknown.argmax())]
            self._end(Outcome.ABORTED, f"joint {joint} has not answered yet")
            return
        self._waiting = read_pose(data)
        if self._phase in (_Phase.MOVING, _Phase.STREAMING):
            self._brake()
        elif self._phase is not _Phase.STOPPING:
            self._plan()

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Follow a twist; a pose that is under way ends as preempted. Or plan without moving."""
        if not self._at:
            self._hold_joints()
        if kind == "plan":
            self._try_plan(read_pose(data))
            return
        self._is_trial = False
        linear, angular, frame = read_twist(data)
        self._turns_with_tip = frame == self._chain.tip
        rotation: Rotation = IDENTITY
        if not self._turns_with_tip:
            found = self._pose_of(frame)
            if isinstance(found, str):
                self.context.warn(f"twist ignored: {found}")
                return
            rotation = found[0]
        self._twist = in_axes(rotation, linear, angular)
        self._commanded_ns = time_ns
        if self._goal is not None:
            self._end(Outcome.PREEMPTED, "replaced by a twist")
        self._waiting = self._planning = None
        if self._phase is _Phase.MOVING:
            self._ending = None
            self._brake()
        elif self._phase is not _Phase.STOPPING:
            self._phase = _Phase.STREAMING

    def _try_plan(self, asked: PoseGoal) -> None:
        """Plan a motion from rest to a pose, and publish it."""
        if self._phase is _Phase.RESTING or self._is_trial:
            self._is_trial, self._waiting = True, asked
            self._plan()
        else:
            self._publish("the arm moves; ask again when it rests")

    def _publish(self, text: str, path: Path | None = None) -> None:
        self._is_trial = False
        x, y, z = self._target[1]
        last = [math.nan] * len(self.context.joints) if path is None else path.last
        duration = math.nan if path is None else path.duration_s
        self.context.publish("plan", PosePlan(x, y, z, np.array(last), duration, text))

    def on_hold(self, time_ns: int) -> None:
        """Brake from the twist: the stream has ended."""
        self._twist = _ZERO, _ZERO
        self._write()

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Brake on the path; the goal ends when the tip rests."""
        self._waiting = self._planning = None
        self._ending = Outcome.CANCELLED
        if self._phase in (_Phase.MOVING, _Phase.STREAMING):
            self._brake()
        elif self._phase is not _Phase.STOPPING:
            self._come_to_rest()

    def _end(self, outcome: Outcome, text: str, joint: str = "") -> None:
        goal, self._goal = self._goal, None
        if goal is not None:
            goal.end(outcome, text, joint)
        elif self._is_trial:
            self._publish(text)

    def _plan(self) -> None:
        """Begin to plan a motion from rest to the waiting goal."""
        asked, self._waiting = self._waiting, None
        self._phase = _Phase.RESTING
        if asked is None:
            return
        frame = self._pose_of(asked.frame)
        if isinstance(frame, str):
            self._end(Outcome.ABORTED, frame)
            return
        self._asked, self._target = asked, asked.target(frame, self._chain.pose(self._at))
        plan = plan_line if asked.by_line else plan_joints
        exact = self._exact and asked.asks_orientation
        self._planning = plan(self._solver, self._at, self._target, self._limits, exact=exact)
        self._phase = _Phase.PLANNING

    def _pose_of(self, frame: str) -> Pose | str:
        """Return the pose of a frame in the base, or why it is not known."""
        if not frame:
            return BASE
        positions = dict(zip(self.context.joints, self._at, strict=False))
        for name, value in zip(self.context.read_names, self.context.reads.tolist(), strict=True):
            positions[name.removesuffix("/position")] = value
        try:
            pose = self._frames.pose(
                frame,
                self._chain.base,
                {name: value for name, value in positions.items() if name in self._frames.moved},
            )
        except LookupError as error:
            return str(error.args[0])
        except ValueError:
            return f"the pose of {frame} is not known; a joint has not answered yet"
        return rotation_of(pose.rotation), pose.translation

    # In a cycle

    def update(self, time_ns: int, period_ns: int) -> None:
        """Advance planning, path or twist by a period, and command the positions."""
        if not self._at:
            self._hold_joints()
        elif self.context.states.has_lost and (self._leader or self._phase is not _Phase.RESTING):
            self._abandon()
        elif self._leader is not None:
            self._follow_leader(self._leader, period_ns * 1e-9)
        elif self._phase is _Phase.PLANNING:
            self._advance_plan()
        elif self._phase is _Phase.STREAMING or (self._phase is _Phase.STOPPING and self._path is None):
            self._follow(time_ns, period_ns * 1e-9)
        elif self._phase in (_Phase.MOVING, _Phase.STOPPING):
            self._move(time_ns, period_ns * 1e-9)
        self._write()

    def _abandon(self) -> None:
        """End everything where the joints were sent: a joint is lost, and the runtime holds the others."""
        self._hold_joints()
        self._stream.drop_twist()
        text = ""
        if self._asked is not None and self._at:
            left = residual_of(self._chain.pose(self._at), self._target)
            text = f"held {left.position * 1e3:.0f} mm before the pose"
        self._end(Outcome.ABORTED, text)
        self._forget()

    def _advance_plan(self) -> None:
        planning, asked = self._planning, self._asked
        if planning is None or asked is None:
            self._phase = _Phase.RESTING
            return
        for _ in range(self._steps):
            try:
                next(planning)
            except StopIteration as done:
                self._begin(done.value, asked)
                return

    def _begin(self, found: Path | NoPath, asked: PoseGoal) -> None:
        """Begin the motion that was planned, or end the goal with the reason why there is none."""
        self._planning, self._phase = None, _Phase.RESTING
        if isinstance(found, NoPath):
            self._end(Outcome.ABORTED, found.text)
            return
        if asked.seconds < found.duration_s:
            needed = math.ceil(found.duration_s * 100) / 100
            self._end(
                Outcome.ABORTED,
                f"the motion takes {needed:.2f} s within its limits; ask for at least this time",
            )
            return
        if self._is_trial:
            self._publish(_remark(found, asked), found)
            return
        self._stretch = 1.0
        if found.duration_s > 0 and not math.isnan(asked.seconds):
            self._stretch = found.duration_s / asked.seconds
        self._path, self._passed_s, self._rate, self._slope = found, 0.0, 1.0, 0.0
        self._phase = _Phase.MOVING

    def _move(self, time_ns: int, period_s: float) -> None:
        """Advance on the path; its time passes more slowly while the tip brakes."""
        path = self._path
        if path is None:
            self._come_to_rest()
            return
        before, self._rate = self._rate, max(0.0, self._rate - self._slope * period_s)
        self._passed_s += (before + self._rate) / 2 * self._stretch * period_s
        self._at = path.sample(self._passed_s).positions
        if self._phase is _Phase.STOPPING:
            if self._rate == 0.0 or self._passed_s >= path.duration_s:
                self._come_to_rest()
        elif self._passed_s >= path.duration_s:
            self._arrive(path)
        elif time_ns >= self._feedback_ns and self._goal is not None:
            self._feedback_ns = time_ns + FEEDBACK_NS
            error = float(np.abs(self.context.states.position - self._at).max())
            self._goal.feedback(self._passed_s / path.duration_s, error)

    def _arrive(self, path: Path) -> None:
        """Let the runtime judge the goal by the joints at the end of the path."""
        self._path, self._phase = None, _Phase.RESTING
        goal, self._goal = self._goal, None
        if goal is None:
            return
        goal.judge(np.array(path.last), text="" if self._asked is None else _remark(path, self._asked))

    def _brake(self) -> None:
        """Slow down on the path, as fast as the joints may brake, or from the twist."""
        if self._phase is _Phase.MOVING and self._path is not None:
            speeds = self._path.sample(self._passed_s).velocities
            rates = [
                most / max(abs(speed) * self._stretch, 1e-9)
                for speed, most in zip(speeds, self._limits.acceleration, strict=True)
            ]
            # Half of the acceleration, because the path's own curvature needs the rest.
            self._slope = max(min(rates) / 2, 1 / _LONGEST_STOP_S)
        else:
            self._path, self._twist = None, (_ZERO, _ZERO)
        self._phase = _Phase.STOPPING

    def _come_to_rest(self) -> None:
        self._path, self._phase = None, _Phase.RESTING
        if self._ending is not None:
            outcome, self._ending = self._ending, None
            self._end(outcome, "")
        elif self._waiting is not None:
            self._plan()
        elif any(map(any, self._twist)):
            self._phase = _Phase.STREAMING

    def _follow(self, time_ns: int, period_s: float) -> None:
        """Move at the twist, or brake from it."""
        if time_ns - self._commanded_ns > self.parameters.timeout:
            self._twist = _ZERO, _ZERO
        linear, angular = self._twist
        if self._turns_with_tip:
            linear, angular = in_axes(self._chain.pose(self._at)[0], linear, angular)
        self._at = self._stream.advance_joints(self._at, linear, angular, period_s)
        held = self._stream.held_by
        if held >= 0 and not self._said_held:
            self.context.say(f"held: joint {self.context.joints[held]} is at its limit")
        self._said_held = held >= 0
        if self._stream.rests and not (any(linear) or any(angular)):
            self._come_to_rest()

    def _follow_leader(self, chain: Chain, period_s: float) -> None:
        """Move the followed pose toward that of the leader within the limits in space, and solve it."""
        begin = self._followed or self._chain.pose(self._at)
        linear = angular = _ZERO
        age_s = float(np.maximum.reduce(self._leader_age))  # NaN if one joint has not answered yet
        if (leader := self.parameters.leader) is not None and age_s <= self.parameters.timeout * 1e-9:
            rotation, place = chain.pose(self._leader_position.tolist())
            x, y, z = (leader.scale * a + b for a, b in zip(place, leader.offset, strict=True))
            way, turn = distance(begin, (rotation, (x, y, z)))
            linear = approach(way, self._limits.linear_acceleration, period_s)
            angular = approach(turn, self._limits.angular_acceleration, period_s)
            self._said_held = False
        elif not self._said_held:
            self._said_held = True
            worst = int(np.argmax(np.where(np.isnan(self._leader_age), np.inf, self._leader_age)))
            since = "yet" if math.isnan(age_s) else f"for {age_s:.2f} s"
            self.context.say(f"no reply from leader {chain.joints[worst]} {since}, holding")
        self._stream.change_twist(linear, angular, period_s)
        (a, b, c), (u, v, w) = self._stream.linear, self._stream.angular
        self._followed = shifted(
            begin, (a * period_s, b * period_s, c * period_s), (u * period_s, v * period_s, w * period_s)
        )
        search = self._solver.search_from(
            self._followed, self._at, exact=self._exact, steps=self._steps // 2 + 2
        )
        try:
            while True:
                next(search)
        except StopIteration as done:
            found: Solution = done.value
        if (left := found.residual.position) > LEASH_M:
            way, _ = distance(self._followed, self._chain.pose(found.positions))
            share = 1 - LEASH_M / left
            self._followed = shifted(self._followed, (way[0] * share, way[1] * share, way[2] * share), _ZERO)
        self._at = tuple(
            now + min(max(goal - now, -most * period_s), most * period_s)
            for goal, now, most in zip(found.positions, self._at, self._limits.velocity, strict=True)
        )


def _remark(path: Path, asked: PoseGoal) -> str:
    """Return what is not reached at the end of a path; empty if all is."""
    if not asked.asks_orientation or path.residual.is_close:
        return ""
    off = math.degrees(path.residual.orientation)
    return f"{off:.1f} deg from the orientation, which the arm cannot reach"


def _frames(urdf: Urdf, context: Context) -> FrameTree:
    """Return all frames of the robot, moved by its joints."""
    others = (name.removesuffix("/position") for name in context.read_names if name.endswith("/position"))
    return FrameTree(urdf, (*context.joints, *others))
