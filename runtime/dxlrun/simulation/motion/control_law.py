"""What the controllers inside simulated servos make of where they are and where they want to be.

One law for all families; each uses a part of it:

    duty = p * error beyond the margin + punch + i * its integral + d * its speed + feed-forward + bias

limited to `limit`; and where a current is controlled, the torque limited to `torque_limit`. A velocity
controller is the same law on the integrated speed: its I gain takes the place of P, its P gain that of D.
The motor gives `duty * stall torque - damping * velocity`.
"""

from __future__ import annotations

import numpy as np

from dxlrun.simulation.motion.command import FREE, ROWS
from dxlrun.simulation.motion.plant import Floats
from dxlrun.simulation.motion.profile import Profiles

_UNWOUND = 1e-6
"""duty/s; an integral that changes the duty more slowly is as good as constant."""


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
        self.drive: Floats = np.zeros(size)
        """Nm at standstill"""
        self.damping: Floats = motor_damping.copy()
        """Nm s/rad"""
        self.torque: Floats = np.zeros(size)
        """Nm of the motor at the speed of the last step"""
        self.duty: Floats = np.zeros(size)
        """Part of the supply's voltage at the motor, signed"""
        self.integral: Floats = np.zeros(size)
        """rad s"""
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
        """Take note that commands were changed: what nobody uses is not computed."""
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
        # an integrated speed that would ask for more than the limit is held there: no windup
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
        """Hold the motor's torque where its current is controlled."""
        limit = self._rows["torque_limit"]
        over = np.abs(self.torque) > limit
        np.clip(self.torque, -limit, limit, out=self.torque)
        np.copyto(self.drive, self.torque, where=over)
        np.copyto(self.damping, 0.0, where=over)
