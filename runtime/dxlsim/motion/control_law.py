"""Control law: controllers inside simulated servos, with their commands and the trajectories to their goals.

All families share the law; each one uses some of its terms:

    duty = p * error beyond the margin + punch + i * its integral + d * its speed + feed-forward + bias

clamped to `limit`; with current control the torque is also clamped to `torque_limit`. A velocity controller
is the same law on the integrated speed: its I gain takes the place of P, its P gain that of D. The motor's
torque is `duty * stall torque - damping * velocity`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dxlsim.motion.plant import Floats

FREE = 1e6  # Unreachable limit: rad/s, rad/s^2, Nm. It is finite to avoid 0 * infinity.

_ARRIVED = 1e-9  # rad; distance to the goal at which a trajectory ends

_UNWOUND = 1e-6  # duty/s; an integral that changes the duty more slowly counts as constant


class ServoCommand(NamedTuple):
    """Parameters of one servo's controller, computed from its registers; every default switches its term off.

    `duty` is a fraction of the supply voltage at the motor, -1 to 1. Angles are those of the shaft."""

    goal: float = 0.0  # rad; end of the trajectory
    speed: float = FREE
    """Speed limit of the trajectory, rad/s; with `turning` the signed speed."""
    acceleration: float = FREE  # rad/s^2 of the trajectory
    turning: float = 0.0  # 1: the trajectory continues indefinitely at `speed`
    p_ccw: float = 0.0  # duty per rad of error, if the goal is counter-clockwise of the shaft
    p_cw: float = 0.0
    margin_ccw: float = 0.0  # rad of error without a reaction
    margin_cw: float = 0.0
    punch: float = 0.0  # duty at the edge of the margin
    i: float = 0.0  # duty per rad s
    d: float = 0.0  # duty per rad/s of the error's speed
    feed_velocity: float = 0.0  # duty per rad/s of the trajectory, in addition to `d`
    feed_acceleration: float = 0.0  # duty per rad/s^2 of the trajectory
    bias: float = 0.0  # duty, independent of the position
    limit: float = 0.0  # largest duty; 0: the servo is limp
    torque_limit: float = FREE  # Nm, torque limit if the motor's current is controlled


LIMP = ServoCommand()
"""Command without torque: the shaft moves freely, and the motor brakes it as with shorted terminals [i]."""

ROWS = {name: row for row, name in enumerate(ServoCommand._fields)}
"""Row of each field of `ServoCommand` in the array of all servos' commands."""


class Profiles:
    """Trajectories of the servos to their goals: position and velocity setpoints of their controllers in each
    step.

    The speed is limited by the profile's speed, and changes with the profile's acceleration (e-Manual, X
    series, Profile Velocity (112)). The manual's jerk control is not modelled. A new goal starts with the
    current velocity of the trajectory ("Velocity Override")."""

    def __init__(self, commands: Floats, angle: Floats, dt_s: float) -> None:
        self._goal, self._speed, self._acceleration, self._turn = (
            commands[ROWS[name]] for name in ("goal", "speed", "acceleration", "turning")
        )
        self.position: Floats = angle.copy()  # rad
        self.velocity: Floats = np.zeros(len(angle))  # rad/s
        self.change: Floats = np.zeros(len(angle))
        """Change of each trajectory's velocity in the last step, rad/s."""
        self.arrived = False  # True while no trajectory moves
        self._dt_s = dt_s
        self.commanded()

    def commanded(self) -> None:
        """Recompute values that depend on the array of commands; call it after a change of commands."""
        self._turning = self._turn != 0.0
        self._accelerate()
        self.arrived = False

    def aim(self, index: int, goal: float, speed: float, acceleration: float) -> None:
        """Change one servo's goal, rad, and the speed, rad/s, and acceleration, rad/s^2, of its
        trajectory."""
        self._goal[index], self._speed[index] = goal, speed
        if self._acceleration[index] != acceleration:
            self._acceleration[index] = acceleration
            self._accelerate()
        self.arrived = False

    def at_goal(self, index: int) -> bool:
        """Return True if a servo's trajectory has ended; with a speed command, if that speed is reached."""
        if self._turning[index]:
            return bool(self.velocity[index] == self._speed[index])
        return bool(abs(self._goal[index] - self.position[index]) < _ARRIVED)

    def advance_trajectories(self) -> None:
        """Advance all trajectories by one step of `dt_s`."""
        if self.arrived:
            return
        error = self._goal - self.position
        way = np.abs(error)
        # Braking by a dt in each of n steps from v takes n v - n (n - 1) / 2 a dt, in steps of dt. Choose the
        # least n with which the rest of the way can end at rest, and the v that ends exactly there.
        steps = np.maximum(np.ceil((np.sqrt(way * self._per_braking + 1.0) - 1.0) * 0.5), 1.0)
        speed = (steps - 1.0) * (self._ramp / 2) + way * (1.0 / self._dt_s) / steps
        speed = np.copysign(np.minimum(speed, self._speed), error)
        np.copyto(speed, self._speed, where=self._turning)
        self.change = np.maximum(np.minimum(speed - self.velocity, self._ramp), -self._ramp)
        self.velocity += self.change
        self.position += self.velocity * self._dt_s

    def check_arrival(self) -> None:
        """Check whether all trajectories have ended; if so, set them exactly to their goals and stop
        stepping them."""
        if self.arrived or self._turning.any():
            return
        left = np.abs(self._goal - self.position).max(initial=0.0)
        if left < _ARRIVED and np.abs(self.velocity).max(initial=0.0) < _ARRIVED / self._dt_s:
            np.copyto(self.position, self._goal)
            self.velocity.fill(0.0)
            self.change.fill(0.0)
            self.arrived = True

    def _accelerate(self) -> None:
        self._ramp = self._acceleration * self._dt_s
        self._per_braking = 8 / (self._ramp * self._dt_s)


class ControlLaw:
    """Controllers and motors of all servos; `compute_drive` computes their torques, as `drive` and `damping`,
    for the plant."""

    def __init__(self, commands: Floats, motor_damping: Floats, dt_s: float) -> None:
        size = len(motor_damping)
        self._rows = {name: commands[row] for name, row in ROWS.items()}
        self._dt_s = dt_s
        self.stall: Floats = np.zeros(size)
        """Torque of each servo at standstill and full duty, at its supply voltage, Nm. Call `commanded`
        after a change."""
        self._motor_damping = motor_damping
        self.drive: Floats = np.zeros(size)  # Nm at standstill
        self.damping: Floats = motor_damping  # Nm s/rad
        self.torque: Floats = np.zeros(size)  # Nm of the motor at the speed before the last step
        self.duty: Floats = np.zeros(size)  # Signed fraction of the supply voltage at the motor
        self.integral: Floats = np.zeros(size)  # rad s
        self._error: Floats = np.zeros(size)
        self._within = np.zeros(size, dtype=bool)
        self.commanded()

    @property
    def winding(self) -> bool:
        """True while a controller's integral changes, which may still move a shaft that friction holds."""
        if not self._integrates:
            return False
        return bool((np.abs(self._rows["i"] * self._error) * self._within > _UNWOUND).any())

    def commanded(self) -> None:
        """Recompute values that depend on the array of commands; call it after a change of commands."""
        rows = self._rows
        self._feed = rows["d"] + rows["feed_velocity"]
        self._integrates = bool(rows["i"].any())
        self._turning = rows["turning"] != 0.0
        # Anti-windup: the integrated speed error stops at the value that requires the full limit.
        held = self._turning & (rows["p_ccw"] > 0.0)
        self._longest = np.where(held, rows["limit"] / np.maximum(rows["p_ccw"], 1e-9), FREE)

    def compute_drive(self, profiles: Profiles, angle: Floats, velocity: Floats) -> None:
        """Compute `drive` and `damping` of all servos for their setpoints and the shafts' angles, rad, and
        velocities, rad/s."""
        rows = self._rows
        error = np.maximum(np.minimum(profiles.position - angle, self._longest), -self._longest)
        np.copyto(profiles.position, angle + error, where=self._turning)
        ccw = error > 0.0
        beyond = np.abs(error) - np.where(ccw, rows["margin_ccw"], rows["margin_cw"])
        duty = np.maximum(beyond, 0.0) * np.where(ccw, rows["p_ccw"], rows["p_cw"])
        duty = np.copysign(duty + rows["punch"] * (beyond > 0.0), error)
        duty = duty + self._feed * profiles.velocity + rows["bias"]
        duty = duty + rows["feed_acceleration"] * profiles.change / self._dt_s + rows["i"] * self.integral
        self._drive_motor(duty, error, velocity)

    def _drive_motor(self, undamped: Floats, error: Floats, velocity: Floats) -> None:
        d, limit, most = self._rows["d"], self._rows["limit"], self._rows["torque_limit"]
        wanted = undamped - d * velocity
        self.duty = duty = np.maximum(np.minimum(wanted, limit), -limit)
        self._error, self._within = error, wanted == duty
        # At the limit the controller's own damping has no effect. Elsewhere the plant applies it.
        drive = np.where(self._within, undamped, duty) * self.stall
        damping = d * self.stall * self._within + self._motor_damping
        if self._integrates:
            self.integral += error * self._within * self._dt_s
        torque = drive - damping * velocity
        over = np.abs(torque) > most  # Only for a motor whose current is controlled
        if over.any():
            self.torque = np.maximum(np.minimum(torque, most), -most)
            self.drive = np.where(over, self.torque, drive)
            self.damping = np.where(over, 0.0, damping)
        else:
            self.torque, self.drive, self.damping = torque, drive, damping
