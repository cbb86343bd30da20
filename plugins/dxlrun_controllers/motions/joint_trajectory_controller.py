"""joint_trajectory_controller: move joints along a trajectory, whose desired state depends on the time."""

import math
from collections.abc import Iterator
from enum import Enum, auto, unique
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from dxlrun import (
    LIVE,
    AngularAcceleration,
    CommandModel,
    Context,
    Controller,
    Duration,
    Goal,
    GoalTolerances,
    Interfaces,
    Mistake,
    Outcome,
    ParametersModel,
    SpeedPeak,
    Tolerance,
)
from dxlrun_controllers.joint_parameters import (
    JointsParameters,
    PerJoint,
    commanded_by,
    ends_unheard,
    finite_or,
    hold_joints,
    row_of,
    take_where_heard,
)
from dxlrun_controllers.laws.pid import feed_velocities_forward
from dxlrun_controllers.laws.spline import (
    DECELERATION,
    START_IN,
    SplineLimits,
    SplineSample,
    Trajectory,
    flat_size,
    whole_turns,
)
from dxlrun_controllers.laws.tracking_law import CLOSING_SPEED, Tracking, TrackingGains
from dxlrun_controllers.laws.tracks import Track, Tracks
from dxlrun_controllers.motions.trajectory_command import (
    SPLICED,
    ChunkCommand,
    ChunkHead,
    GoalLimits,
    TrajectoryCommand,
    flat_chunk,
    flat_trajectory,
    trajectory_speed_peaks,
)

SPEED_SLOPE: Final = 2.0
"""Rate of change of the speed factor, 1/s: from 1 to 0 in 0.5 s, so that no velocity jumps."""
FEEDBACK_NS: Final = 100_000_000
"""Time between two feedback messages of a goal, ns."""
_STILL: Final = 1e-3
"""Speed factor below which the time of a trajectory counts as stopped."""


class Tolerances(ParametersModel):
    """Tolerances of joint positions, each one distance for all joints or a mapping by joint.

    A goal can override them.
    """

    path: PerJoint[Tolerance] | None = None
    """Tolerance on the way. Beyond it the goal is aborted, and the joints come to rest. By default the path
    is not checked."""
    goal: PerJoint[Tolerance] | None = None
    """Tolerance at the end: the goal is reached when each joint is closer. The default is the joint's own."""
    goal_time: Duration | None = None
    """Time after the end in which the goal may still be reached. The default is the joints' own."""


class TrajectoryParameters(JointsParameters):
    """Keys of a joint_trajectory_controller in the robot file."""

    command_interface: Literal["position", "posvel", "velocity", "effort"] = "position"
    """`posvel` also commands the desired velocity: its magnitude to servos, and with its sign to another
    controller. `velocity` and `effort` track the trajectory by a PID law with feed-forward."""
    tolerances: Tolerances = Tolerances()
    gains: TrackingGains | None = None
    """Gains of `velocity` and `effort`."""
    derivative_filter: Duration = 0
    """Time constant of the low-pass filter on the rate of the error."""
    deceleration: PerJoint[Annotated[AngularAcceleration, Field(gt=0)]] | None = None
    """Deceleration after a cancel or an abort, rad/s^2; at most the joint's own acceleration limit."""
    wrap: tuple[str, ...] = ()
    """Continuous joints that take the shorter way, because whole turns do not matter. The default is all
    joints with `wrap: true`."""
    speed: Annotated[float, LIVE, Field(ge=0, le=10)] = 1.0
    """Speed factor of trajectories: 0.5 is half as fast, 0 pauses."""

    _own_velocity = model_validator(mode="before")(feed_velocities_forward)

    def mistakes(self) -> Iterator[Mistake]:
        """Yield missing gains of `velocity` and `effort`, and gains that the command interface does not
        use.
        """
        yield from super().mistakes()
        tracks = self.command_interface in ("velocity", "effort")
        if tracks and self.gains is None:
            yield (), f"{self.command_interface} needs gains; add `gains: {{p: ..., d: ...}}`"
        if self.gains is not None and not tracks:
            yield ("gains",), "gains count only for velocity and effort; remove them"


@unique
class _TrajectoryPhase(Enum):
    RESTING = auto()
    MOVING = auto()
    STOPPING = auto()


class JointTrajectoryController(Controller[TrajectoryParameters]):
    """Controller that plays trajectories, one goal at a time.

    A new goal starts from the present desired state, without a jump. Joints that it does not name continue
    their motion. The desired state depends on time and not on the number of updates, so late cycles do not
    change the motion. Goals, tolerances and partial goals are those of joint_trajectory_controller of
    ros2_controllers (control.ros.org).
    """

    Parameters = TrajectoryParameters
    Commands: ClassVar = {"trajectory": TrajectoryCommand, "chunk": ChunkCommand}
    Goals = frozenset({"trajectory"})

    @classmethod
    def interfaces(cls, parameters: TrajectoryParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the interfaces of `command_interface` on the joints."""
        return Interfaces(parameters.joints, commanded_by(parameters.command_interface))

    @classmethod
    def prepare(
        cls, kind: str, command: CommandModel, parameters: TrajectoryParameters
    ) -> NDArray[np.float64]:
        """Return the splines of the trajectory, its timeout, tolerances and joints as one flat array.

        Raises:
            ValueError: The number of values is wrong, a joint is unknown, or the times do not increase.
        """
        if isinstance(command, ChunkCommand):
            return flat_chunk(command, parameters.joints, parameters.wrap)
        if isinstance(command, TrajectoryCommand):
            return flat_trajectory(command, parameters.joints, parameters.wrap)
        return super().prepare(kind, command, parameters)

    @classmethod
    def speed_peaks(
        cls, kind: str, data: NDArray[np.float64], parameters: TrajectoryParameters
    ) -> Iterator[SpeedPeak]:
        """Yield the peak speed of each joint between the points, at the controller's speed factor."""
        return trajectory_speed_peaks(kind, data, parameters.joints, parameters.speed)

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        joints, limits, parameters = context.joints, context.limits, self.parameters
        count = len(joints)
        self._tracks = Tracks(count)
        self._still = self._tracks.still
        self._desired, self._path = self._tracks.desired, SplineSample(count)
        self._trajectory = self._tracks.free().trajectory
        """Trajectory that was started last."""
        self._error = np.zeros(count)
        self._moved, self._unmoved = np.ones(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        """True for each joint of the trajectory that was started last, and for each of the others."""
        self._spliced: NDArray[np.float64] | None = None
        """Flat trajectory that waits for its start while another one is played; None without one."""
        self._anchor_ns: int | None = None
        """Time at which the sender's clock of a stream of chunks was 0, ns; None without a stream."""
        self._moves = self._unknown = False
        self._phase = _TrajectoryPhase.RESTING
        self._goal: Goal | None = None
        self._start_ns = self._base_ns = self._stop_ns = self._feedback_ns = 0
        self._timeout_ns = np.inf
        self._base_s = self._splice_s = 0.0
        self._speed = self._rate = parameters.speed
        self._slope = 0.0
        """Rate of change of the present speed factor `_rate` towards the requested one `_speed`, 1/s."""
        tolerances = parameters.tolerances
        self._own = GoalLimits(
            path=row_of(tolerances.path, joints),
            path_velocity=np.full(count, np.inf),
            position=row_of(tolerances.goal, joints, np.nan),
            velocity=np.full(count, np.nan),
            settle_s=np.nan if tolerances.goal_time is None else tolerances.goal_time * 1e-9,
        )
        self._set_tolerances(self._own)
        self._lower, self._upper = limits.lower, limits.upper
        self._wrap = np.array([joint in parameters.wrap for joint in joints])
        self._turns = np.isinf(limits.upper) & np.isinf(limits.lower) & ~self._wrap
        """True for each continuous joint that counts whole turns."""
        own = row_of(parameters.deceleration, joints, np.nan)
        deceleration = finite_or(np.fmin(own, limits.acceleration), DECELERATION)
        speed = self._speed_limit = finite_or(limits.velocity, np.inf)
        self._limits = SplineLimits(speed, deceleration, limits.lower, limits.upper)
        self._closing = np.minimum(speed, CLOSING_SPEED)
        self._interface = parameters.command_interface
        self._tracking: Tracking | None = None
        self._tracked = SplineSample(count)
        """State that is tracked by efforts or velocities: the desired one, or at rest while a joint is
        lost.
        """
        if parameters.gains is not None:
            tracked: Literal["velocity", "effort"] = "velocity" if self._interface == "velocity" else "effort"
            self._tracking = Tracking(context, tracked, parameters.derivative_filter * 1e-9)
            self._tracking.set_gains(parameters.gains, joints)
        self._to_servos = not context.into

    def on_parameters(self, time_ns: int) -> None:
        """Set the gains and the requested speed factor, which is approached with SPEED_SLOPE."""
        if self._tracks.playing:
            self._base_s, self._base_ns = self._warped(time_ns), time_ns
        self._speed = self.parameters.speed
        if self._tracking is not None and self.parameters.gains is not None:
            self._tracking.set_gains(self.parameters.gains, self.context.joints)

    def on_activate(self, time_ns: int) -> None:
        """Hold the joints at their last goals, or where they are when a law tracks them."""
        commands, states = self.context.commands, self.context.states
        self._phase, self._goal, self._spliced, self._anchor_ns = _TrajectoryPhase.RESTING, None, None, None
        self._tracks.end_tracks()
        if self._tracking is None:
            hold_joints(self.context)
            self._desired.rest_at(commands.position)
            if not self._to_servos:
                commands.velocity.fill(0.0)
        else:
            self._desired.rest_at(states.position)
            self._tracked.rest_at(states.position)
            self._tracking.start_tracking(self._desired)
        self._unknown = True

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime has ended."""
        self._goal = None

    # Goals

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Start the goal's trajectory from the desired state, or let it wait as a splice into the active
        one.
        """
        self._goal = self._spliced = None
        self._know_begin(time_ns)
        self._anchor_ns = None
        if ends_unheard(goal, self._desired.position, self.context.joints):
            return
        self._goal, self._start_ns, self._feedback_ns = goal, time_ns, time_ns + FEEDBACK_NS
        self._phase = _TrajectoryPhase.MOVING
        self._timeout_ns = float(data[flat_size(data)]) * 1e9
        if self._tracks.playing and (data[-len(self._moved) :] == SPLICED).any():
            self._spliced, self._splice_s = data, self._warped(time_ns) + float(data[START_IN])
        else:
            self._begin_trajectory(data, time_ns, self._warped(time_ns))

    def _begin_trajectory(
        self, data: NDArray[np.float64], time_ns: int, clock_s: float, *, waited_s: float = 0.0
    ) -> None:
        """Start a prepared trajectory on its joints; abort its goal if it is too fast.

        Args:
            data: Prepared trajectory.
            time_ns: Time of the cycle, ns.
            clock_s: Start, in the time of the trajectory before, s.
            waited_s: Part of its `start_in` that has already passed, s.
        """
        since_s, more = self._warped(time_ns) - clock_s, data[flat_size(data) :]
        count = len(self._moved)
        track, moved = self._tracks.free(), more[-count:] != 0
        begin = self._path_of(moved)
        track.trajectory.load(whole_turns(data, begin.position, self._wrap & moved), begin, waited_s)
        self._warn_of_turns(track.trajectory, begin, np.flatnonzero(self._turns & moved))
        self._set_tolerances(self._own.replaced_by(more[1:], count))
        self._set_track(track, moved)
        if self._refused_for_haste():
            self._brake(time_ns)
        else:
            self._tracks.start_track(track, moved, clock_s)
            self._base_ns, self._base_s = time_ns, since_s

    def _warn_of_turns(self, trajectory: Trajectory, begin: SplineSample, rows: NDArray[np.intp]) -> None:
        """Warn of steps between points in which a joint of `rows` (indices) turns by more than half a
        turn.
        """
        if not rows.size:  # skip: the steps of thousands of points would take milliseconds of the cycle
            return
        for row, step in zip(rows.tolist(), trajectory.longest_steps(begin, rows).tolist(), strict=True):
            if step > np.pi * (1 + 1e-9):
                self.context.warn(
                    f"joint {self.context.joints[row]} turns by {math.degrees(step):.4g} deg "
                    "from one point to the next; write wrap: true for the joint to take the shorter way"
                )

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Blend into a chunk of positions.

        The chunk is ignored if all of its points are in the past, or while a joint has not answered yet.
        """
        self._know_begin(time_ns)
        if np.isnan(self._desired.position).any():
            return
        head = ChunkHead(*data[: len(ChunkHead._fields)].tolist())
        sent_ns = time_ns - round(head.now * 1e9)
        self._anchor_ns = sent_ns if self._anchor_ns is None else min(self._anchor_ns, sent_ns)
        late_s, blend_s = (sent_ns - self._anchor_ns) * 1e-9, max(head.blend, self.context.period_ns * 1e-9)
        track, moved = self._tracks.free(), data[-len(self._moved) :] != 0
        begin = self._path_of(moved)
        points = whole_turns(data[len(head) :], begin.position, self._wrap & moved)
        if track.trajectory.join(points, begin, late_s, blend_s, self._limits):
            self._end_goal(Outcome.PREEMPTED, time_ns, "replaced by a chunk of positions")
            self._tracks.start_track(track, moved, self._warped(time_ns))
            self._set_track(track, moved)
            self._base_ns, self._base_s = time_ns, 0.0
            self._spliced, self._phase = None, _TrajectoryPhase.MOVING

    def _set_tolerances(self, tolerances: GoalLimits) -> None:
        """Set the tolerances of the active goal."""
        self._within, self._checks_path = tolerances, tolerances.checks_path

    def _set_track(self, track: Track, moved: NDArray[np.bool_]) -> None:
        self._trajectory, self._moved, self._unmoved = track.trajectory, moved, ~moved

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Stop all joints from their desired velocity. The goal ends when they are at rest."""
        self._stop_from(time_ns)

    def on_hold(self, time_ns: int) -> None:
        """Stop all joints from their desired velocity, and hold them."""
        self._anchor_ns, self._moves = None, True
        if not self._tracks.all_still:
            self._stop_from(time_ns)

    @property
    def _moving(self) -> bool:
        """True while a trajectory is played, not during a stop."""
        return self._phase is _TrajectoryPhase.MOVING

    def _know_begin(self, time_ns: int) -> None:
        """Update the speed factor and the desired state from which a new trajectory starts now."""
        if not self._tracks.playing:
            self._rate = 1.0 if not self._tracks.all_still and self._speed <= _STILL else self._speed
            self._slope = 0.0 if self._rate == self._speed else -SPEED_SLOPE
            self._base_ns, self._base_s = time_ns, 0.0
        self._know_where(time_ns)

    def _leave_stream(self) -> None:
        """End the stream of chunks at once, because a servo is lost.

        The runtime holds the joints at their goals.
        """
        self._anchor_ns, self._phase = None, _TrajectoryPhase.RESTING
        self._tracks.end_tracks()
        held = self.context.goals if self._tracking is None else self.context.states
        self._desired.rest_at(finite_or(held.position, self._desired.position))

    def _know_where(self, time_ns: int) -> None:
        """Update the desired state to this cycle; joints without one take their measured position."""
        if self._unknown:
            self._unknown = take_where_heard(self._desired.position, self.context.states)
        if not self._tracks.all_still:
            self._sample(time_ns)

    def _path_of(self, moved: NDArray[np.bool_]) -> SplineSample:
        """Return the desired state with derivatives by the trajectory's own time, without the speed factor.

        The derivatives are 0 for joints that are not moved.
        """
        desired, path = self._desired, self._path
        path.rest_at(desired.position)
        if self._rate > _STILL:
            np.divide(desired.velocity, self._rate, out=path.velocity)
            slowing = path.velocity * self._slope
            np.divide(desired.acceleration - slowing, self._rate**2, out=path.acceleration)
        path.rows *= moved
        return path

    def _refused_for_haste(self) -> bool:
        """Abort the goal if its first point is too far away for its time; return True if it was aborted.

        The check needs the present position, so it is only possible when the goal starts. A first point at
        time 0 must be reachable within one period. The goal has no error, as its joints never left a path.
        """
        trajectory, period_s = self._trajectory, self.context.period_ns * 1e-9
        way = np.abs(trajectory.first_way(self._path)) * self._moved * self._speed
        time_s = max(trajectory.bridge_s, period_s)
        speeds = way / period_s
        if trajectory.bridge_s > 0:
            speeds = trajectory.bridge_speeds() * self._moved * self._speed
        if not (speeds > self._speed_limit * (1 + 1e-9)).any():
            return False
        row = int((speeds / self._speed_limit).argmax())
        joint, unit, limit = self.context.joints[row], self.context.units[row], self._speed_limit[row]
        needed_s = math.ceil(1e3 * time_s * speeds[row] / limit - 1e-6) * 1e-3
        text = (
            f"{joint} needs {speeds[row]:.4g} {unit.speed} to the first point ({way[row]:.4g} {unit.si} "
            f"in {time_s:.4g} s), above its limit of {limit:.4g} {unit.speed}; set the point's time or "
            f"start_in to {needed_s:.4g} s or more"
        )
        goal, self._goal = self._goal, None
        if goal is not None:
            goal.end(Outcome.ABORTED, text, joint)
        return True

    def _end_goal(self, outcome: Outcome, time_ns: int, text: str = "", row: int = -1) -> None:
        """End the active goal with the error of a joint: that of index `row`, or the largest one if it is
        -1.
        """
        goal, self._goal = self._goal, None
        if goal is None:
            return
        if row < 0:
            self._measure()
            row = int(self._error.argmax())
        after = f"after {(time_ns - self._start_ns) * 1e-9:.3f} s{', ' * bool(text)}{text}"
        joints = self._names_of(self._moved)
        goal.end(outcome, after, self.context.joints[row], float(self._error[row]), joints)

    def _names_of(self, moved: NDArray[np.bool_]) -> list[str]:
        joints = self.context.joints
        return [joints[each] for each in np.flatnonzero(moved).tolist()]

    # In a cycle

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the desired state at `time_ns`, check the goal, and hold without a trajectory."""
        if self._anchor_ns is not None and self.context.states.has_lost:
            self._leave_stream()
        if self._spliced is not None:
            self._splice(self._spliced, time_ns)
        elapsed = 0.0 if self._tracks.all_still else self._sample(time_ns)
        if self._phase is _TrajectoryPhase.MOVING:
            self._move(time_ns, elapsed)
        elif self._phase is _TrajectoryPhase.STOPPING:
            self._come_to_rest(time_ns)
        elif self._unknown:
            self._unknown = take_where_heard(self._desired.position, self.context.states)
        self._write_commands(period_ns)

    def _splice(self, data: NDArray[np.float64], time_ns: int) -> None:
        """Start the waiting trajectory once its start time has come, from the desired state of that time."""
        if self._warped(time_ns) >= self._splice_s:
            self._spliced = None
            self._sample_at(self._splice_s, time_ns)
            self._begin_trajectory(data, time_ns, self._splice_s, waited_s=float(data[START_IN]))

    def _move(self, time_ns: int, elapsed: float) -> None:
        if self._spliced is None and elapsed >= self._trajectory.duration_s:
            self._phase = _TrajectoryPhase.RESTING
            self._hand_over(time_ns)
        elif self._goal is None:
            return
        elif self._checks_path and (row := self._find_off_path()) >= 0:
            self._end_goal(Outcome.ABORTED, time_ns, f"{self._off_path_text(row)}, stopping", row)
            self._stop_from(time_ns)
        elif time_ns - self._start_ns > self._timeout_ns:
            self._time_out(time_ns)
            self._stop_from(time_ns)
        elif time_ns >= self._feedback_ns and self._spliced is None:
            self._feedback_ns = time_ns + FEEDBACK_NS
            self._measure()
            self._goal.feedback(elapsed / self._trajectory.duration_s, float(self._error.max()))

    def _sample(self, time_ns: int) -> float:
        """Update the desired state to a time of the run, ns; return the time of the newest trajectory, s."""
        elapsed = self._warped(time_ns) if self._tracks.playing else self._base_s
        self._sample_at(elapsed, time_ns)
        return elapsed

    def _sample_at(self, elapsed: float, time_ns: int) -> None:
        self._tracks.sample(elapsed, self._rate, self._slope, (time_ns - self._stop_ns) * 1e-9)
        self._moves = True

    def _warped(self, time_ns: int) -> float:
        """Return the time of the newest trajectory, s, which passes at the speed factor; updates that
        factor.
        """
        since_s, wanted = (time_ns - self._base_ns) * 1e-9, self._speed
        if self._rate == wanted:
            self._slope = 0.0
            return self._base_s + self._rate * since_s
        self._slope = math.copysign(SPEED_SLOPE, wanted - self._rate)
        changing_s = min(since_s, (wanted - self._rate) / self._slope)
        reached = self._rate + self._slope * changing_s
        self._base_s += (self._rate + reached) / 2 * changing_s
        if changing_s < since_s:
            self._base_s += wanted * (since_s - changing_s)
            reached, self._slope = wanted, 0.0
        self._base_ns, self._rate = time_ns, reached
        return self._base_s

    def _hand_over(self, time_ns: int, text: str = "") -> None:
        """Pass the active goal to the runtime, which judges it by the trajectory's last point and its
        tolerances.
        """
        goal, self._goal = self._goal, None
        if goal is None:
            return
        left_ns = self._timeout_ns - (time_ns - self._start_ns)
        tolerances = GoalTolerances(
            self._within.position,
            self._within.velocity,
            None if math.isnan(self._within.settle_s) else round(self._within.settle_s * 1e9),
            round(max(0.0, left_ns)) if math.isfinite(left_ns) else None,
        )
        joints = self._names_of(self._moved)
        goal.judge(self._trajectory.end_position, joints=joints, tolerances=tolerances, text=text)

    def _time_out(self, time_ns: int) -> None:
        text = f"timeout after {(time_ns - self._start_ns) * 1e-9:.3f} s"
        if self._spliced is not None and self._goal is not None:
            # The active trajectory is still the previous one, so its end must not decide this goal.
            joints = self._names_of(self._spliced[-len(self._moved) :] != 0)
            self._goal.end(Outcome.MISSED, f"{text}, before its start", joints=joints)
            self._goal = None
        self._hand_over(time_ns, text)

    def _stop_from(self, time_ns: int) -> None:
        """Start to stop all joints from their desired velocity in this cycle."""
        self._know_where(time_ns)
        self._brake(time_ns)
        self._sample(time_ns)
        self._come_to_rest(time_ns)

    def _brake(self, time_ns: int) -> None:
        self._spliced = None
        self._tracks.come_to_rest(self._limits)
        self._phase, self._stop_ns = _TrajectoryPhase.STOPPING, time_ns

    def _come_to_rest(self, time_ns: int) -> None:
        if self._tracks.all_still:
            self._phase = _TrajectoryPhase.RESTING
            self._end_goal(Outcome.CANCELLED, time_ns)  # other outcomes end the goal before the stop

    # Commands

    def _write_commands(self, period_ns: int) -> None:
        commands, desired = self.context.commands, self._desired
        if self._tracking is not None:
            self._tracked.rows[1:] = 0.0
            # While a joint is lost, the last position is tracked at rest, so that efforts carry the joints.
            if not self.context.states.has_lost:
                np.copyto(self._tracked.rows, desired.rows)
            self._tracking.update(self._tracked, period_ns * 1e-9)
            return
        np.copyto(commands.position, desired.position)
        if self._interface != "posvel":
            return
        if not self._to_servos:
            np.copyto(commands.velocity, desired.velocity)
        elif self._moves:
            np.abs(desired.velocity, out=commands.velocity)
            np.copyto(commands.velocity, self._closing, where=self._still)
        self._moves = False

    # How far off

    def _measure(self) -> None:
        """Update the position errors of the goal's joints, rad or m; those of joints without a reply are
        0.
        """
        states = self.context.states
        self._error = np.where(states.valid, np.abs(states.position - self._desired.position), 0.0)
        np.copyto(self._error, 0.0, where=self._unmoved)

    def _find_off_path(self) -> int:
        """Return the index of the joint with the largest error among those beyond a path tolerance, or -1."""
        self._measure()
        states, within = self.context.states, self._within
        slip = np.abs(states.velocity - self._desired.velocity)
        beyond = self._error > within.path
        beyond |= (slip > within.path_velocity) & states.valid & self._moved
        return int(np.where(beyond, self._error, -1.0).argmax()) if beyond.any() else -1

    def _off_path_text(self, row: int) -> str:
        joint, unit = self.context.joints[row], self.context.units[row]
        if self._error[row] > self._within.path[row]:
            return f"joint {joint} is {unit.text(float(self._error[row]))} off its path"
        speeds = (self.context.states.velocity, self._desired.velocity, self._within.path_velocity)
        actual, desired, allowed = (unit.speed_text(float(of[row])) for of in speeds)
        return f"joint {joint} moves at {actual} instead of {desired} (tolerance {allowed})"
