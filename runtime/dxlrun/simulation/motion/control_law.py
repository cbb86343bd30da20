"""The controllers inside simulated servos: commands, the trajectories to their goals, and one control law.

All families share the law; each uses a part of it:

    duty = p * error beyond the margin + punch + i * its integral + d * its speed + feed-forward + bias

limited to `limit`; and where a current is controlled, the torque limited to `torque_limit`. A velocity
controller is the same law on the integrated speed: its I gain takes the place of P, its P gain that of D.
The motor gives `duty * stall torque - damping * velocity`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dxlrun.simulation.motion.plant import Floats

FREE = 1e6
"""A limit that nothing reaches: rad/s, rad/s^2, Nm. Finite, so that no step makes 0 * infinity."""

_ARRIVED = 1e-9  # rad; nearer to the goal a trajectory is there

_UNWOUND = 1e-6  # duty/s; an integral that changes the duty more slowly is as good as constant


class ServoCommand(NamedTuple):
    """The inside of one servo for the time until the next command; what is left out is switched off.

    `duty` is a part of the supply's voltage at the motor, -1 to 1. Angles are those of the shaft.
    """

    goal: float = 0.0  # rad; where the trajectory ends
    speed: float = FREE
    """rad/s, the most that the trajectory has; where it is `turning`: the speed with its sign"""
    acceleration: float = FREE  # rad/s^2 of the trajectory
    turning: float = 0.0  # 1: the trajectory continues for ever at `speed`
    p_ccw: float = 0.0
    """duty per rad of error, where the goal is counter-clockwise of the shaft"""
    p_cw: float = 0.0
    margin_ccw: float = 0.0  # rad of error that are left alone
    margin_cw: float = 0.0
    punch: float = 0.0  # duty at the edge of the margin
    i: float = 0.0  # duty per rad s
    d: float = 0.0  # duty per rad/s of the error's speed
    feed_velocity: float = 0.0  # duty per rad/s of the trajectory, beside `d`
    feed_acceleration: float = 0.0  # duty per rad/s^2 of the trajectory
    bias: float = 0.0  # duty, whatever the position
    limit: float = 0.0  # most duty; 0: the servo is limp
    torque_limit: float = FREE  # Nm, most torque where the motor's current is controlled


LIMP = ServoCommand()
"""No torque: the shaft follows what turns it, and the motor brakes it as with closed terminals [i]."""

ROWS = {name: row for row, name in enumerate(ServoCommand._fields)}
"""Row of each number in an array of all servos."""


class Profiles:
    """Position and velocity that the servos' controllers follow.

    At most the profile's speed, reached and left with the profile's acceleration (e-Manual, X series,
    Profile Velocity (112)). The manual's jerk control is not modelled. A new goal begins with the velocity
    that the trajectory has ("Velocity Override").
    """

    def __init__(self, commands: Floats, angle: Floats, dt_s: float) -> None:
        size = len(angle)
        self._commands = commands
        self._goal = commands[ROWS["goal"]]
        self._speed = commands[ROWS["speed"]]
        self._acceleration = commands[ROWS["acceleration"]]
        self.position: Floats = angle.copy()  # rad
        self.velocity: Floats = np.zeros(size)  # rad/s
        self.change: Floats = np.zeros(size)
        """rad/s that the velocity changed by in the last step"""
        self.arrived = False  # True while no trajectory moves
        self._dt_s = dt_s
        # arrays, as numpy is slower with numbers
        self._dt, self._per_dt = np.full(size, dt_s), np.full(size, 1.0 / dt_s)
        self._ramp, self._back, self._half = np.zeros(size), np.zeros(size), np.zeros(size)
        self._per_braking, self._one, self._one_half = np.zeros(size), np.ones(size), np.full(size, 0.5)
        self._error, self._next_speed, self._reach = np.zeros(size), np.zeros(size), np.zeros(size)
        self._turning = np.zeros(size, dtype=bool)
        self._turns = False
        self.commanded()

    def commanded(self) -> None:
        """Prepare for changed commands."""
        np.not_equal(self._commands[ROWS["turning"]], 0.0, out=self._turning)
        self._turns = bool(self._turning.any())
        for index, acceleration in enumerate(self._acceleration.tolist()):
            self._accelerate(index, acceleration)
        self.arrived = False

    def aim(self, index: int, goal: float, speed: float, acceleration: float) -> None:
        """Change one servo's goal, rad, the profile's speed, rad/s, and acceleration, rad/s^2."""
        self._goal[index], self._speed[index] = goal, speed
        if self._acceleration[index] != acceleration:
            self._acceleration[index] = acceleration
            self._accelerate(index, acceleration)
        self.arrived = False

    def at_goal(self, index: int) -> bool:
        """Return whether a servo's trajectory has come to its end."""
        if self._turning[index]:
            return bool(self.velocity[index] == self._speed[index])
        return bool(abs(self._goal[index] - self.position[index]) < _ARRIVED)

    def step(self) -> None:
        """Continue the trajectories by one step."""
        if self.arrived:
            return
        error, next_speed, reach = self._error, self._next_speed, self._reach
        np.subtract(self._goal, self.position, out=error)
        np.abs(error, out=reach)
        # Braking by a dt in each of n steps from v on takes n v - n (n - 1) / 2 a dt in steps of dt: for the
        # rest of the way the least n with which it can end at rest, and the v that ends exactly there.
        np.multiply(reach, self._per_braking, out=next_speed)
        np.add(next_speed, self._one, out=next_speed)
        np.sqrt(next_speed, out=next_speed)
        np.subtract(next_speed, self._one, out=next_speed)
        np.multiply(next_speed, self._one_half, out=next_speed)
        np.ceil(next_speed, out=next_speed)
        np.maximum(next_speed, self._one, out=next_speed)
        np.multiply(reach, self._per_dt, out=reach)
        np.divide(reach, next_speed, out=reach)
        np.subtract(next_speed, self._one, out=next_speed)
        np.multiply(next_speed, self._half, out=next_speed)
        np.add(next_speed, reach, out=next_speed)
        np.minimum(next_speed, self._speed, out=next_speed)
        np.copysign(next_speed, error, out=next_speed)
        if self._turns:
            np.copyto(next_speed, self._speed, where=self._turning)
        np.subtract(next_speed, self.velocity, out=next_speed)
        np.minimum(next_speed, self._ramp, out=next_speed)
        np.maximum(next_speed, self._back, out=self.change)
        np.add(self.velocity, self.change, out=self.velocity)
        np.multiply(self.velocity, self._dt, out=next_speed)
        np.add(self.position, next_speed, out=self.position)

    def look(self) -> None:
        """Find out whether all trajectories have come to their ends: then they are there exactly."""
        if self.arrived or self._turns:
            return
        left = np.abs(self._goal - self.position).max(initial=0.0)
        if left < _ARRIVED and np.abs(self.velocity).max(initial=0.0) < _ARRIVED / self._dt_s:
            np.copyto(self.position, self._goal)
            self.velocity.fill(0.0)
            self.change.fill(0.0)
            self.arrived = True

    def _accelerate(self, index: int, acceleration: float) -> None:
        ramp = acceleration * self._dt_s
        self._ramp[index], self._back[index], self._half[index] = ramp, -ramp, ramp / 2
        self._per_braking[index] = 8 / (ramp * self._dt_s)


class ControlLaw:
    """All servos' controllers and motors; `step` fills `drive` and `damping` for the plant."""

    def __init__(self, commands: Floats, motor_damping: Floats, dt_s: float) -> None:
        size = len(motor_damping)
        self._rows = {name: commands[row] for name, row in ROWS.items()}
        self._p, self._d, self._limit = self._rows["p_ccw"], self._rows["d"], self._rows["limit"]
        self._dt = dt_s
        self.stall: Floats = np.zeros(size)
        """Torque at standstill and full duty, at the supply's voltage, Nm; `commanded` when it changes."""
        self._motor_damping = motor_damping
        self.drive: Floats = np.zeros(size)  # Nm at standstill
        self.damping: Floats = motor_damping.copy()  # Nm s/rad
        self.torque: Floats = np.zeros(size)  # Nm of the motor at the speed of the last step
        self.duty: Floats = np.zeros(size)  # Part of the supply's voltage at the motor, signed
        self.integral: Floats = np.zeros(size)  # rad s
        self._error, self._work, self._gain = np.zeros(size), np.zeros(size), np.zeros(size)
        self._within = np.zeros(size, dtype=bool)
        self._outside = np.zeros(size, dtype=bool)
        self._nothing = np.zeros(size)
        self.commanded()

    @property
    def winding(self) -> bool:
        """True while an integral changes, which may yet move a shaft that friction holds."""
        if not self._integrates:
            return False
        return bool((np.abs(self._rows["i"] * self._error) * self._within > _UNWOUND).any())

    def commanded(self) -> None:
        """Prepare for changed commands: what no servo uses is not computed."""
        rows = self._rows
        self._feed = rows["d"] + rows["feed_velocity"]
        self._feeds, self._damps = bool(self._feed.any()), bool(self._d.any())
        self._biased, self._integrates = bool(rows["bias"].any()), bool(rows["i"].any())
        self._feeds_acceleration = bool(rows["feed_acceleration"].any())
        sides = ("margin_ccw", "margin_cw", "punch")
        self._one_sided = bool(
            (rows["p_ccw"] != rows["p_cw"]).any() or (rows["margin_ccw"] != rows["margin_cw"]).any()
        )
        self._compliant = self._one_sided or any(rows[name].any() for name in sides)
        self._current = bool((rows["torque_limit"] < FREE).any())
        self._turning = rows["turning"] != 0.0
        self._turns = bool(self._turning.any())
        self._least = -self._limit
        self._stall_d = self._d * self.stall
        # an integrated speed that would need more than the limit is held there: no windup
        held = self._turning & (self._p > 0.0)
        self._longest = np.where(held, self._limit / np.maximum(self._p, 1e-9), FREE)
        if not self._damps:
            np.copyto(self.damping, self._motor_damping)

    def step(self, profiles: Profiles, angle: Floats, velocity: Floats) -> None:
        """Work out drive and damping for shafts at some angles, rad, and velocities, rad/s."""
        error, work, gain = self._error, self._work, self._gain
        np.subtract(profiles.position, angle, out=error)
        if self._turns:
            np.minimum(error, self._longest, out=error)
            np.maximum(error, -self._longest, out=error)
            np.add(angle, error, out=work)
            np.copyto(profiles.position, work, where=self._turning)
        if self._compliant:
            self._comply()
        else:
            np.multiply(self._p, error, out=work)
        if self._feeds and not profiles.arrived:
            np.multiply(self._feed, profiles.velocity, out=gain)
            np.add(work, gain, out=work)
        if self._biased:
            np.add(work, self._rows["bias"], out=work)
        if self._feeds_acceleration:
            np.add(work, self._rows["feed_acceleration"] * profiles.change / self._dt, out=work)
        if self._integrates:
            np.add(work, self._rows["i"] * self.integral, out=work)
        self._drive_motor(velocity)

    def _comply(self) -> None:
        """Leave errors within the margin alone, and begin with the punch beyond it."""
        error, work, gain, rows = self._error, self._work, self._gain, self._rows
        p, margin = self._p, rows["margin_ccw"]
        if self._one_sided:
            ccw = error > 0.0
            p, margin = np.where(ccw, p, rows["p_cw"]), np.where(ccw, margin, rows["margin_cw"])
        np.abs(error, out=work)
        np.subtract(work, margin, out=work)
        np.greater(work, self._nothing, out=self._outside)
        np.maximum(work, self._nothing, out=work)
        np.multiply(work, p, out=work)
        np.multiply(rows["punch"], self._outside, out=gain)
        np.add(work, gain, out=work)
        np.copysign(work, error, out=work)

    def _drive_motor(self, velocity: Floats) -> None:
        work, duty, gain, within = self._work, self.duty, self._gain, self._within
        if not self._damps:
            np.minimum(work, self._limit, out=duty)
            np.maximum(duty, self._least, out=duty)
            np.multiply(duty, self.stall, out=self.drive)
            if self._current:
                np.copyto(self.damping, self._motor_damping)  # the step before may have taken it away
            if self._integrates:
                np.equal(work, duty, out=within)
        else:
            np.multiply(self._d, velocity, out=gain)
            np.subtract(work, gain, out=gain)
            np.minimum(gain, self._limit, out=duty)
            np.maximum(duty, self._least, out=duty)
            np.equal(gain, duty, out=within)
            # at the limit the controller's own damping does nothing; elsewhere it is the plant's to apply
            np.copyto(gain, duty)
            np.copyto(gain, work, where=within)
            np.multiply(gain, self.stall, out=self.drive)
            np.multiply(self._stall_d, within, out=gain)
            np.add(gain, self._motor_damping, out=self.damping)
        if self._integrates:
            np.add(self.integral, self._error * within * self._dt, out=self.integral)
        np.multiply(self.damping, velocity, out=gain)
        np.subtract(self.drive, gain, out=self.torque)
        if self._current:
            self._limit_current()

    def _limit_current(self) -> None:
        limit = self._rows["torque_limit"]
        over = np.abs(self.torque) > limit
        np.clip(self.torque, -limit, limit, out=self.torque)
        np.copyto(self.drive, self.torque, where=over)
        np.copyto(self.damping, 0.0, where=over)
