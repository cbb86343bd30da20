"""diff_drive_controller: drives a base on a left and a right side of wheels by a twist, and keeps odometry.

Kinematics, limits, time-out and names follow ROS 2's diff_drive_controller (control.ros.org, its user
documentation): the rims of a base that moves at v and turns at w have the speeds v -+ w * separation / 2.
Other than there, the speeds of the wheels keep their ratio at the wheels' own limits, so that the base slows
down on its curve instead of leaving it; and jerk limits are kept without overshoot.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

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
from dxlrun.messages import Header, Odometry
from dxlrun_controllers.joints import JointNames, or_number
from dxlrun_controllers.laws.odometry import Pose, WheelAngles


class LinearLimits(ParametersModel):
    """Limits forward and backward; what is left out is not limited."""

    velocity: Annotated[LinearVelocity, Field(gt=0)] | None = None
    """Greatest speed."""
    acceleration: Annotated[LinearAcceleration, Field(gt=0)] | None = None
    """By how much the speed may grow."""
    deceleration: Annotated[LinearAcceleration, Field(gt=0)] | None = None
    """Toward a standstill; as `acceleration` where it is left out."""
    jerk: Annotated[LinearJerk, Field(gt=0)] | None = None
    """By how much the acceleration may change."""


class AngularLimits(ParametersModel):
    """Limits to the left and to the right; what is left out is not limited."""

    velocity: Annotated[AngularVelocity, Field(gt=0)] | None = None
    """Greatest rate of turn."""
    acceleration: Annotated[AngularAcceleration, Field(gt=0)] | None = None
    """By how much the rate may grow."""
    deceleration: Annotated[AngularAcceleration, Field(gt=0)] | None = None
    """Toward a standstill; as `acceleration` where it is left out."""
    jerk: Annotated[AngularJerk, Field(gt=0)] | None = None
    """By how much the acceleration may change."""


_SAME = 1e-9
"""m/s and rad/s: what dividing by a radius and multiplying by it again changes."""

Multiplier = Annotated[float, Field(gt=0)]


class DiffDriveParameters(ParametersModel):
    """Keys of a diff_drive_controller in the robot file."""

    left: JointNames
    """Wheels on the left: positive velocities drive the base forward."""
    right: JointNames
    """Wheels on the right, likewise."""
    separation: Annotated[Length, Field(gt=0)]
    """m, between the wheels of the two sides, where they touch the ground"""
    radius: Annotated[Length, Field(gt=0)]
    """m, of a wheel"""
    separation_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration: what the separation is multiplied by."""
    left_radius_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration: what the radius of the left wheels is multiplied by."""
    right_radius_multiplier: Annotated[Multiplier, LIVE] = 1.0
    """Calibration: what the radius of the right wheels is multiplied by."""
    linear: LinearLimits = LinearLimits()
    angular: AngularLimits = AngularLimits()
    timeout: Annotated[Duration, Field(gt=0)] = 500_000_000
    """ns; without a new command for so long the base decelerates to a standstill"""
    odometry: Literal["position", "velocity", "command"] = "position"
    """What it is made of: the angles of the wheels, their measured velocities, or what was commanded."""
    odometry_rate: Annotated[float, Field(gt=0)] = 50.0
    """Hz, of the topic; at most one message an update"""
    frame: str = "odom"
    """Name of the frame in which the pose is."""
    child_frame: str = "base_link"
    """Name of the frame of the base, in which the twist is."""


class VelocityCommand(CommandModel):
    """A twist of the base in the plane, until the next one, at most for the time-out."""

    linear: Annotated[float, or_number(TypeAdapter(LinearVelocity))] = 0.0
    """m/s, forward"""
    angular: Annotated[float, or_number(TypeAdapter(AngularVelocity))] = 0.0
    """rad/s, to the left"""


class Ramp:
    """A velocity that goes to its target within limits of acceleration, deceleration and jerk (SI units).

    With a jerk limit the acceleration is the largest one from which n steps of `jerk` end exactly at the
    target: a = gap / (n dt) + (n - 1) / 2 * jerk * dt. This is the time-optimal law of a double integrator in
    discrete time, as in Han, From PID to Active Disturbance Rejection Control, IEEE Trans. Industrial
    Electronics 56 (2009), without its boundary layer.
    """

    def __init__(self, limits: LinearLimits | AngularLimits) -> None:
        self._top = math.inf if limits.velocity is None else limits.velocity
        self._rise = math.inf if limits.acceleration is None else limits.acceleration
        self._sink = self._rise if limits.deceleration is None else limits.deceleration
        self._jerk = math.inf if limits.jerk is None else limits.jerk
        self.velocity = self.acceleration = 0.0

    def within(self, target: float) -> float:
        """Return a target within the limit of velocity."""
        return min(max(target, -self._top), self._top)

    def next(self, target: float, dt: float) -> float:
        """Return the velocity after `dt` s on the way to `target`; `set` makes it the present one."""
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
        if falling and abs(gap) > abs(self.velocity):  # to the other side: through zero
            stop_s = abs(self.velocity) / self._sink
            if stop_s >= dt:
                return self.velocity + math.copysign(self._sink * dt, gap)
            return math.copysign(min(abs(target), self._rise * (dt - stop_s)), target)
        most = (self._sink if falling else self._rise) * dt
        return target if abs(gap) <= most else self.velocity + math.copysign(most, gap)

    def set(self, velocity: float, dt: float) -> None:
        """Make a velocity, reached in `dt` s, the present one."""
        self.acceleration = (velocity - self.velocity) / dt
        self.velocity = velocity

    def stop(self) -> None:
        """Stand still."""
        self.velocity = self.acceleration = 0.0


class DiffDriveController(Controller[DiffDriveParameters]):
    """Turns a twist into velocities of wheels, within limits, and the wheels' angles into a pose.

    The pose begins at 0 with the run, and is kept while the controller is inactive. While a wheel is lost the
    base is held, and the pose stands still; the way of the wheels in a short silence is made up for with the
    next reply; that of a longer one, in which a servo may have lost its turns, is left out and reported.
    """

    Parameters = DiffDriveParameters
    Commands: ClassVar = {"velocity": VelocityCommand}
    Topics: ClassVar = {"odometry": Odometry}

    @classmethod
    def interfaces(cls, parameters: DiffDriveParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the velocity of all wheels: those on the left first."""
        return Interfaces((*parameters.left, *parameters.right), ("velocity",))

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        parameters, left = self.parameters, len(self.parameters.left)
        speeds = context.limits.velocity[np.isfinite(context.limits.velocity)]
        self._wheel_limit = float(speeds.min()) if speeds.size else math.inf
        self._angles = WheelAngles(len(context.joints), self._wheel_limit, context.period_ns)
        self._sides = slice(None, left), slice(left, None)
        self._linear, self._angular = Ramp(parameters.linear), Ramp(parameters.angular)
        self._pose = Pose()
        self._message = Odometry(
            header=Header(frame_id=parameters.frame), child_frame_id=parameters.child_frame
        )
        self._twist = (0.0, 0.0)
        self._command = self._target = (0.0, 0.0)
        self._interval_ns = round(1e9 / parameters.odometry_rate)
        self._commanded_ns = self._publish_ns = 0
        self._holding = False
        self.on_parameters(0)

    def on_parameters(self, time_ns: int) -> None:
        """Take over a changed calibration."""
        parameters = self.parameters
        self._half = parameters.separation * parameters.separation_multiplier / 2
        self._radii = (
            parameters.radius * parameters.left_radius_multiplier,
            parameters.radius * parameters.right_radius_multiplier,
        )
        self._rim_limit = self._wheel_limit * min(self._radii)
        self._aim()

    def on_activate(self, time_ns: int) -> None:
        """Stand still until the first command."""
        self._linear.stop()
        self._angular.stop()
        self._command = self._target = (0.0, 0.0)
        self._angles.begin()
        self._holding = False
        self.context.commands.velocity.fill(0.0)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take a new twist."""
        self._command = float(data[0]), float(data[1])
        self._commanded_ns = time_ns
        self._aim()

    def on_hold(self, time_ns: int) -> None:
        """Decelerate to a standstill."""
        self._command = self._target = (0.0, 0.0)

    def _aim(self) -> None:
        """Make the command the target, slowed down along its curve to what base and wheels may do."""
        linear, angular = self._linear.within(self._command[0]), self._angular.within(self._command[1])
        rim = abs(linear) + abs(angular) * self._half
        share = self._rim_limit / rim if rim > self._rim_limit else 1.0
        self._target = linear * share, angular * share

    def update(self, time_ns: int, period_ns: int) -> None:
        """Go on toward the target; a target without a new command for the time-out is a standstill."""
        dt = period_ns * 1e-9
        linear, angular = self._linear, self._angular
        self._start_from_goals()
        self._follow(time_ns, dt)
        if time_ns - self._commanded_ns > self.parameters.timeout:
            self._command = self._target = (0.0, 0.0)
        forward, turn = self._within_wheels(
            linear.next(self._target[0], dt), angular.next(self._target[1], dt)
        )
        linear.set(forward, dt)
        angular.set(turn, dt)
        velocity, (left, right), across = self.context.commands.velocity, self._sides, turn * self._half
        velocity[left] = (forward - across) / self._radii[0]
        velocity[right] = (forward + across) / self._radii[1]

    def _start_from_goals(self) -> None:
        """Go on from what was sent: the gate may have slowed the wheels down, or stopped them meanwhile."""
        forward, turn = self._rims(self.context.goals.velocity)
        if abs(forward - self._linear.velocity) > _SAME or abs(turn - self._angular.velocity) > _SAME:
            self._linear.stop()
            self._angular.stop()
            self._linear.velocity, self._angular.velocity = forward, turn

    def _within_wheels(self, forward: float, turn: float) -> tuple[float, float]:
        """Hold back what grows, so that no wheel is faster than its limit, and no ramp steeper."""
        excess = abs(forward) + abs(turn) * self._half - self._rim_limit
        if excess > 0.0:
            less = min(excess, max(0.0, abs(forward) - abs(self._linear.velocity)))
            forward -= math.copysign(less, forward)
            grown = max(0.0, abs(turn) - abs(self._angular.velocity))
            turn -= math.copysign(min((excess - less) / self._half, grown), turn)
        return forward, turn

    def _rims(self, turned: NDArray[np.float64]) -> tuple[float, float]:
        """Return the way and the angle of the base, or its twist, of angles or velocities of its wheels."""
        (left, right), (left_radius, right_radius) = self._sides, self._radii
        on_left = float(np.add.reduce(turned[left])) / len(self.parameters.left) * left_radius
        on_right = float(np.add.reduce(turned[right])) / len(self.parameters.right) * right_radius
        return (on_left + on_right) / 2, (on_right - on_left) / (2 * self._half)

    # Odometry

    def _follow(self, time_ns: int, dt: float) -> None:
        """Move the pose by what happened since the update before."""
        states = self.context.states
        if self.parameters.odometry == "command":
            self._twist = self._linear.velocity, self._angular.velocity
            self._pose.move(self._twist[0] * dt, self._twist[1] * dt)
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
        """Move the pose by the wheels' way since their last replies."""
        states = self.context.states
        age_ns = self._angles.age_ns(time_ns)
        elapsed_ns = self._angles.take(states, time_ns)
        self._twist = linear, angular = self._rims(states.velocity)
        if elapsed_ns is not None:
            by_position = self.parameters.odometry == "position"
            moved = linear * elapsed_ns * 1e-9, angular * elapsed_ns * 1e-9
            self._pose.move(*(self._rims(self._angles.turned) if by_position else moved))
        elif age_ns >= 0:
            self.context.say(f"odometry goes on without the way of {age_ns * 1e-9:.2f} s without all replies")
        self._holding = False

    def _hold(self, time_ns: int) -> None:
        """Report, once, that wheels are silent for so long that their way is lost."""
        if self._holding or self._angles.age_ns(time_ns) <= self._angles.longest_ns:
            return
        self._holding = True
        silent = [
            name
            for name, valid in zip(self.context.joints, self.context.states.valid, strict=True)
            if not valid
        ]
        self.context.say(f"odometry holds: no reply of {', '.join(silent)}")

    def _publish(self) -> None:
        pose, (linear, angular), message = self._pose, self._twist, self._message
        place, speed = message.pose.pose, message.twist.twist
        place.position.x, place.position.y = pose.x, pose.y
        place.orientation.z, place.orientation.w = math.sin(pose.heading / 2), math.cos(pose.heading / 2)
        speed.linear.x, speed.angular.z = linear, angular
        self.context.publish("odometry", message)
