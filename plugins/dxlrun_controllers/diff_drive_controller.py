"""diff_drive_controller: drive a base with left and right wheels by a twist, and compute its odometry.

Kinematics, limits, timeout and names follow ROS 2's diff_drive_controller (control.ros.org, user
documentation). The rims of a base that moves at v and turns at w have the speeds v -+ w * separation / 2.
There are two differences: the wheels keep the ratio of their speeds at their own limits, so the base slows
down on its curve instead of leaving it; and jerk limits are kept without overshoot.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    LIVE,
    AngularAcceleration,
    AngularJerk,
    AngularVelocity,
    CommandModel,
    Context,
    Controller,
    Duration,
    Interfaces,
    Length,
    LinearAcceleration,
    LinearJerk,
    LinearVelocity,
    ParametersModel,
)
from dxlrun.tooling.topics import messages
from dxlrun_controllers.joint_parameters import JointNames, or_number
from dxlrun_controllers.laws.odometry import BasePose, WheelAngles


class LinearLimits(ParametersModel):
    """Limits of the forward and backward motion. A limit that is not given is not applied."""

    velocity: Annotated[LinearVelocity, Field(gt=0)] | None = None
    """Highest speed, m/s."""
    acceleration: Annotated[LinearAcceleration, Field(gt=0)] | None = None
    """Highest acceleration, m/s^2."""
    deceleration: Annotated[LinearAcceleration, Field(gt=0)] | None = None
    """Highest deceleration, m/s^2; by default the same as `acceleration`."""
    jerk: Annotated[LinearJerk, Field(gt=0)] | None = None
    """Highest rate of change of the acceleration, m/s^3."""


class AngularLimits(ParametersModel):
    """Limits of the rotation to the left and to the right. A limit that is not given is not applied."""

    velocity: Annotated[AngularVelocity, Field(gt=0)] | None = None
    """Highest rate of turn, rad/s."""
    acceleration: Annotated[AngularAcceleration, Field(gt=0)] | None = None
    """Highest angular acceleration, rad/s^2."""
    deceleration: Annotated[AngularAcceleration, Field(gt=0)] | None = None
    """Highest angular deceleration, rad/s^2; by default the same as `acceleration`."""
    jerk: Annotated[AngularJerk, Field(gt=0)] | None = None
    """Highest rate of change of the angular acceleration, rad/s^3."""


_SAME = 1e-9
"""Tolerance of a comparison of speeds, m/s and rad/s, for the rounding errors of dividing by a wheel's
radius.
"""

Multiplier = Annotated[float, Field(gt=0)]


class DiffDriveParameters(ParametersModel):
    """Keys of a diff_drive_controller in the robot file."""

    left: JointNames = Field(examples=["[left_wheel]"])
    """Wheels on the left. Their positive velocities must drive the base forward."""
    right: JointNames = Field(examples=["[right_wheel]"])
    """Wheels on the right. Their positive velocities must drive the base forward."""
    separation: Annotated[Length, Field(gt=0)]
    """Distance between the ground contacts of the left and the right wheels, m."""
    radius: Annotated[Length, Field(gt=0)]
    """Radius of a wheel, m."""
    separation_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration factor of the separation."""
    left_radius_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration factor of the radius of the left wheels."""
    right_radius_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration factor of the radius of the right wheels."""
    linear: LinearLimits = LinearLimits()
    angular: AngularLimits = AngularLimits()
    timeout: Annotated[Duration, Field(gt=0)] = 500_000_000
    """Time without a new command after which the base decelerates to a standstill."""
    odometry: Literal["position", "velocity", "command"] = "position"
    """Source of the odometry: measured wheel positions, measured wheel velocities, or the commanded twist."""
    odometry_rate: Annotated[float, Field(gt=0)] = 50.0
    """Rate of the topic, Hz, but at most one message per update."""
    frame: str = "odom"
    """Frame of the pose."""
    child_frame: str = "base_link"
    """Frame of the base, in which the twist is expressed."""


class VelocityCommand(CommandModel):
    """Twist of the base in the plane. It is valid until the next command, at most for the timeout."""

    linear: Annotated[float, or_number(LinearVelocity)] = 0.0
    """Forward velocity, m/s"""
    angular: Annotated[float, or_number(AngularVelocity)] = 0.0
    """Rate of turn, rad/s, positive to the left"""


class Ramp:
    """Velocity ramp with limits of velocity, acceleration, deceleration and jerk (SI units).

    With a jerk limit the acceleration is the largest one from which n steps of `jerk` end exactly at the
    target: a = gap / (n dt) + (n - 1) / 2 * jerk * dt. This is the time-optimal law of a double integrator in
    discrete time of Han, From PID to Active Disturbance Rejection Control, IEEE Trans. Industrial
    Electronics 56 (2009), without the boundary layer.
    """

    def __init__(self, limits: LinearLimits | AngularLimits) -> None:
        self._top = math.inf if limits.velocity is None else limits.velocity
        self._rise = math.inf if limits.acceleration is None else limits.acceleration
        self._sink = self._rise if limits.deceleration is None else limits.deceleration
        self._jerk = math.inf if limits.jerk is None else limits.jerk
        self.velocity = self.acceleration = 0.0

    def within(self, target: float) -> float:
        """Return a target velocity clamped to the velocity limit."""
        return min(max(target, -self._top), self._top)

    def next(self, target: float, dt: float) -> float:
        """Return the velocity after `dt` s on the way to the velocity `target`; the state only changes by
        `set_velocity`.
        """
        gap = target - self.velocity
        falling = self.velocity * gap < 0
        if math.isinf(self._jerk):
            return self._by_acceleration(target, gap, falling, dt)
        reach = self._jerk * dt
        steps = math.ceil(math.sqrt(0.25 + 2.0 * abs(gap) / (reach * dt)) - 0.5 - 1e-9)
        most = abs(gap) / (steps * dt) + (steps - 1) / 2 * reach if steps else 0.0
        wanted = math.copysign(min(most, self._sink if falling else self._rise), gap)
        change = min(max(wanted - self.acceleration, -reach), reach)
        return self.velocity + (self.acceleration + change) * dt

    def _by_acceleration(self, target: float, gap: float, falling: bool, dt: float) -> float:
        # A reversal decelerates to zero first, and accelerates for the rest of the period.
        if falling and abs(gap) > abs(self.velocity):
            stop_s = abs(self.velocity) / self._sink
            if stop_s >= dt:
                return self.velocity + math.copysign(self._sink * dt, gap)
            return math.copysign(min(abs(target), self._rise * (dt - stop_s)), target)
        most = (self._sink if falling else self._rise) * dt
        return target if abs(gap) <= most else self.velocity + math.copysign(most, gap)

    def set_velocity(self, velocity: float, dt: float) -> None:
        """Set the present velocity, reached in the last `dt` s, and the acceleration that follows from it."""
        self.acceleration = (velocity - self.velocity) / dt
        self.velocity = velocity

    def stand_still(self) -> None:
        """Set velocity and acceleration to 0 at once."""
        self.velocity = self.acceleration = 0.0


class DiffDriveController(Controller[DiffDriveParameters]):
    """Controller of a base with differential drive: wheel velocities from a twist, pose from wheel angles.

    The pose starts at 0 with the run, and is kept while the controller is inactive. While a wheel is lost,
    the base is held and the pose is frozen. After a short gap in the replies, the next reply updates the pose
    by the travel in the gap. After a longer gap, in which a servo may have lost its turn count, the travel is
    discarded and an event reports that.
    """

    Parameters = DiffDriveParameters
    Commands: ClassVar = {"velocity": VelocityCommand}
    Topics: ClassVar = {"odometry": messages.Odometry}

    @classmethod
    def interfaces(cls, parameters: DiffDriveParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the velocity of all wheels, those on the left first."""
        return Interfaces((*parameters.left, *parameters.right), ("velocity",))

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs, and start the pose at 0."""
        super().on_configure(context)
        parameters, left = self.parameters, len(self.parameters.left)
        speeds = context.limits.velocity[np.isfinite(context.limits.velocity)]
        self._wheel_limit = float(speeds.min()) if speeds.size else math.inf
        self._angles = WheelAngles(len(context.joints), self._wheel_limit, context.period_ns)
        self._sides = slice(None, left), slice(left, None)
        self._linear, self._angular = Ramp(parameters.linear), Ramp(parameters.angular)
        self._pose = BasePose()
        self._message = messages.Odometry(
            header=messages.Header(frame_id=parameters.frame), child_frame_id=parameters.child_frame
        )
        self._twist = (0.0, 0.0)
        self._command = self._target = (0.0, 0.0)
        self._interval_ns = round(1e9 / parameters.odometry_rate)
        self._commanded_ns = self._publish_ns = 0
        self._holding = False
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Apply the calibration factors of separation and radii, which may have changed in the run."""
        parameters = self.parameters
        self._half = parameters.separation * parameters.separation_multiplier / 2
        self._radii = (
            parameters.radius * parameters.left_radius_multiplier,
            parameters.radius * parameters.right_radius_multiplier,
        )
        self._rim_limit = self._wheel_limit * min(self._radii)
        self._aim()

    def on_activate(self, time_ns: int) -> None:
        """Command a standstill until the first twist is received."""
        self._linear.stand_still()
        self._angular.stand_still()
        self._command = self._target = (0.0, 0.0)
        self._angles.restart_odometry()
        self._holding = False
        self.context.commands.velocity.fill(0.0)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Set a new twist, which is valid until `timeout`."""
        self._command = float(data[0]), float(data[1])
        self._commanded_ns = time_ns
        self._aim()

    def on_hold(self, time_ns: int) -> None:
        """Set the target to a standstill; the base decelerates within its limits."""
        self._command = self._target = (0.0, 0.0)

    def _aim(self) -> None:
        """Set the target twist to the command, scaled down on the same curve to the limits of base and
        wheels.
        """
        linear, angular = self._linear.within(self._command[0]), self._angular.within(self._command[1])
        rim = abs(linear) + abs(angular) * self._half
        share = self._rim_limit / rim if rim > self._rim_limit else 1.0
        self._target = linear * share, angular * share

    def update(self, time_ns: int, period_ns: int) -> None:
        """Ramp the twist towards the target, and command the wheels; after `timeout` the target is a
        standstill.
        """
        dt = period_ns * 1e-9
        linear, angular = self._linear, self._angular
        self._start_from_goals()
        self._follow(time_ns, dt)
        if time_ns - self._commanded_ns > self.parameters.timeout:
            self._command = self._target = (0.0, 0.0)
        forward, turn = self._within_wheels(
            linear.next(self._target[0], dt), angular.next(self._target[1], dt)
        )
        linear.set_velocity(forward, dt)
        angular.set_velocity(turn, dt)
        velocity, (left, right), across = self.context.commands.velocity, self._sides, turn * self._half
        velocity[left] = (forward - across) / self._radii[0]
        velocity[right] = (forward + across) / self._radii[1]

    def _start_from_goals(self) -> None:
        """Restart the ramps from the wheel velocities that were sent, if the loop reduced what was
        commanded.
        """
        forward, turn = self._rims(self.context.goals.velocity)
        if abs(forward - self._linear.velocity) > _SAME or abs(turn - self._angular.velocity) > _SAME:
            self._linear.stand_still()
            self._angular.stand_still()
            self._linear.velocity, self._angular.velocity = forward, turn

    def _within_wheels(self, forward: float, turn: float) -> tuple[float, float]:
        """Reduce the increase of the twist so that each wheel keeps its speed limit.

        Only the increase is reduced, so that neither ramp becomes steeper than its limits.
        """
        excess = abs(forward) + abs(turn) * self._half - self._rim_limit
        if excess > 0.0:
            less = min(excess, max(0.0, abs(forward) - abs(self._linear.velocity)))
            forward -= math.copysign(less, forward)
            grown = max(0.0, abs(turn) - abs(self._angular.velocity))
            turn -= math.copysign(min((excess - less) / self._half, grown), turn)
        return forward, turn

    def _rims(self, turned: NDArray[np.float64]) -> tuple[float, float]:
        """Convert wheel angles (rad) into distance (m) and turn (rad) of the base, or wheel velocities
        into its twist.
        """
        (left, right), (left_radius, right_radius) = self._sides, self._radii
        on_left = float(np.add.reduce(turned[left])) / len(self.parameters.left) * left_radius
        on_right = float(np.add.reduce(turned[right])) / len(self.parameters.right) * right_radius
        return (on_left + on_right) / 2, (on_right - on_left) / (2 * self._half)

    # Odometry

    def _follow(self, time_ns: int, dt: float) -> None:
        """Update the pose by the motion since the last update, and publish it at `odometry_rate`."""
        states = self.context.states
        if self.parameters.odometry == "command":
            self._twist = self._linear.velocity, self._angular.velocity
            self._pose.move_along_arc(self._twist[0] * dt, self._twist[1] * dt)
        elif np.count_nonzero(states.valid) == states.valid.size:
            self._measure(time_ns)
        else:
            self._hold(time_ns)
            if not states.has_lost:
                return
            self._twist = 0.0, 0.0  # the base is held
        if time_ns >= self._publish_ns:
            self._publish_ns = max(self._publish_ns + self._interval_ns, time_ns - self._interval_ns)
            self._publish()

    def _measure(self, time_ns: int) -> None:
        """Update the pose by the wheels' travel since the last cycle in which all wheels answered.

        The travel is discarded, and an event reports it, after a gap in which its number of turns is unknown.
        """
        states = self.context.states
        age_ns = self._angles.age_ns(time_ns)
        elapsed_ns = self._angles.add_sample(states, time_ns)
        self._twist = linear, angular = self._rims(states.velocity)
        if elapsed_ns is not None:
            by_position = self.parameters.odometry == "position"
            moved = linear * elapsed_ns * 1e-9, angular * elapsed_ns * 1e-9
            self._pose.move_along_arc(*(self._rims(self._angles.turned) if by_position else moved))
        elif age_ns >= 0:
            self.context.say(f"wheels did not reply for {age_ns * 1e-9:.2f} s; odometry omits this distance")
        self._holding = False

    def _hold(self, time_ns: int) -> None:
        """Report once that wheels have not answered for longer than the travel can be known."""
        if self._holding or self._angles.age_ns(time_ns) <= self._angles.longest_ns:
            return
        self._holding = True
        silent = [
            name
            for name, valid in zip(self.context.joints, self.context.states.valid, strict=True)
            if not valid
        ]
        self.context.say(f"odometry holds: no reply from {', '.join(silent)}")

    def _publish(self) -> None:
        pose, (linear, angular), message = self._pose, self._twist, self._message
        place, speed = message.pose.pose, message.twist.twist
        place.position.x, place.position.y = pose.x, pose.y
        place.orientation.z, place.orientation.w = math.sin(pose.heading / 2), math.cos(pose.heading / 2)
        speed.linear.x, speed.angular.z = linear, angular
        self.context.publish("odometry", message)
