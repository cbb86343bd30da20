"""Feed-forward: the torque and duty that a servo needs for a motion, from the model of its motor and its
load.

Inverse of the model that `dxlrun.MotorModel` documents, vectorised over joints. At the horn, in SI units:

    torque = J a + g sin(q - down) + s f(|w|) + viscous w,   plus the friction of the torque itself
    duty   = (torque R / k + k w) / U,   position offset = duty / (position gain * P gain)

with the speed w and acceleration a of the desired motion, the torque constant k, the winding's resistance R
and the supply's voltage U (M. Schwarz, S. Behnke, "Compliant Robot Behavior using Servo Actuator Models
identified by Iterative Learning Control", RoboCup 2013, sections 3 and 5). Friction has the direction
s = tanh(w / w0) instead of a sign: the desired speed passes through 0 without a jump of the torque.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dxlrun import Floats, MotorModel
from dxlrun_controllers.joint_parameters import clamped, finite_or

LEAST_SUPPLY = 0.5
"""Lowest plausible fraction of the nominal voltage. A servo does not run below it, so a lower reading is an
error of the measurement [i]."""
MOST_SUPPLY = 1.5
"""Highest plausible fraction of the nominal voltage; higher readings are clamped."""
NEEDED_FIGURES: Mapping[str, tuple[str, ...]] = {
    "position": ("resistance", "position_gain"),
    "effort": ("resistance", "torque_per_effort"),
    "pwm": ("resistance",),
}
"""Command interface -> figures of the motor files that it needs."""


class MotionAhead:
    """Prediction of the desired motion, extrapolated from its finite differences.

    `position` and `velocity`, shape (joints,), are predicted for `ahead_s` after the newest update.
    `acceleration` is the mean over the last period, clamped to `most`, rad/s^2. An unknown velocity (NaN) is
    replaced by the difference of the positions, clamped to `fastest`, rad/s.
    """

    def __init__(self, joints: int, fastest: float | Floats = np.inf, most: float | Floats = np.inf) -> None:
        self._fastest, self._most = np.full(joints, fastest), np.full(joints, most)
        self.position, self.velocity, self.acceleration = np.zeros((3, joints))
        self.ahead_s = np.zeros(joints)
        self._known, self._known_velocity = np.full((2, joints), np.nan)

    def reset(self) -> None:
        """Discard the past motion. The next update has no differences, so an unknown velocity counts as 0."""
        self._known.fill(np.nan)
        self._known_velocity.fill(np.nan)

    def update(self, position: Floats, velocity: Floats, period_s: float) -> None:
        """Add the desired position (rad) and velocity (rad/s, NaN if unknown), `period_s` after the last
        update.
        """
        slope = clamped((position - self._known) / period_s, -self._fastest, self._fastest)
        now = finite_or(finite_or(velocity, slope), 0.0)  # 0 after a reset, when no slope is known
        change = finite_or((now - self._known_velocity) / period_s, 0.0)
        np.copyto(self.acceleration, clamped(change, -self._most, self._most))
        gained = self.acceleration * self.ahead_s
        np.add((gained * 0.5 + now) * self.ahead_s, position, out=self.position)
        np.add(now, gained, out=self.velocity)
        np.copyto(self._known, position)
        self._known_velocity = now


def output_per_need(motors: Sequence[MotorModel], interface: str) -> Floats:
    """Return the command per unit of torque (`effort`) or of duty (`pwm`, `position`).

    For `position` it is the offset, rad, at which the servo's own control outputs a duty of 1.

    Raises:
        ValueError: A motor file lacks `position_gain` (for `position`) or `torque_per_effort` (for `effort`),
            or the P gain of a servo is declared as 0.
    """
    if interface == "position":
        per = [1.0 / (motor.stiffness or np.nan) for motor in motors]
    elif interface == "effort":
        per = [1.0 / (motor.torque_per_effort or np.nan) for motor in motors]
    else:
        per = [1.0] * len(motors)
    if not np.isfinite(per).all():
        raise ValueError(
            "a motor file lacks position_gain (for position) or torque_per_effort (for effort), or "
            "the P gain of a servo is declared as 0"
        )
    return np.array(per)


class Supply:
    """Filtered supply voltage of motors, and the duty that produces a torque at that voltage."""

    def __init__(self, motors: Sequence[MotorModel]) -> None:
        self.voltage = np.array([motor.voltage for motor in motors], dtype=np.float64)
        """Filtered supply voltage of each motor, V; at first that of the motor file."""
        self._least, self._most = self.voltage * LEAST_SUPPLY, self.voltage * MOST_SUPPLY
        self._backward = np.array([motor.torque_constant for motor in motors], dtype=np.float64)
        self._per_torque = np.array([motor.resistance / motor.torque_constant for motor in motors])

    def filter_voltage(self, measured: Floats, share: float) -> None:
        """Low-pass filter the measured voltages, V: add the fraction `share` (0..1) of the difference; NaN
        is ignored.
        """
        step = (measured - self.voltage) * share
        np.add(self.voltage, step, out=self.voltage, where=np.isfinite(step))
        np.copyto(self.voltage, clamped(self.voltage, self._least, self._most))

    def duty(self, torque: Floats, velocity: Floats | float) -> Floats:
        """Return the duty, fraction of the supply voltage, not clamped, for a torque (Nm) at a velocity
        (rad/s).
        """
        duty: Floats = (torque * self._per_torque + self._backward * velocity) / self.voltage
        return duty


class InverseServo:
    """Inverse model of servos: torque and duty for a desired motion. All arrays have the shape (joints,)."""

    def __init__(self, motors: Sequence[MotorModel], friction_speed: Floats) -> None:
        """Read the figures of the motors.

        Args:
            motors: One motor per joint.
            friction_speed: Desired speed at which 3/4 of the friction is compensated, rad/s.
        """

        def row(values: list[float]) -> Floats:
            return np.array(values, dtype=np.float64)

        count = len(motors)
        self.torque, self.duty = np.zeros((2, count))
        """Torque of the motor, Nm, and its duty, not clamped, as computed by the last update."""
        self.supply = Supply(motors)
        self._inertia = row([motor.inertia + motor.load.inertia for motor in motors])
        self._gravity = row([motor.load.gravity for motor in motors])
        self._down = row([motor.load.gravity_angle for motor in motors])
        self._coulomb = row([motor.friction for motor in motors])
        self._load_friction = row([motor.load_friction for motor in motors])
        self._viscous = row([motor.viscous_friction for motor in motors])
        parts = [motor.stribeck for motor in motors]
        self._has_stribeck = any(parts)
        self._stribeck = row([part.friction if part else 0.0 for part in parts])
        self._stribeck_speed = row([part.velocity if part else 1.0 for part in parts])
        self._stribeck_exponent = row([part.exponent if part else 1.0 for part in parts])
        self._forward = 1.0 / friction_speed

    def update(self, position: Floats, velocity: Floats, acceleration: Floats) -> None:
        """Compute `torque` and `duty` for a motion: rad, rad/s, rad/s^2, shape (joints,)."""
        hold = np.sin(position - self._down) * self._gravity
        friction = self._coulomb
        if self._has_stribeck:
            slowness = np.exp(-((np.abs(velocity) / self._stribeck_speed) ** self._stribeck_exponent))
            friction = friction + slowness * self._stribeck
        direction = np.tanh(velocity * self._forward)
        needed = acceleration * self._inertia + velocity * self._viscous + friction * direction
        # With the friction of the torque itself (l a Nm), torque + hold = (torque without it + 2 hold) /
        # (1 - l s sign): as l < 1, both sides have the same sign.
        needed = needed + hold + hold
        share = direction * self._load_friction
        np.subtract(needed / (1.0 - np.copysign(share, share * needed)), hold, out=self.torque)
        np.copyto(self.duty, self.supply.duty(self.torque, velocity))
