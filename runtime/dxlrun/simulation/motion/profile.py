"""The trajectories that simulated servos follow: trapezoids of velocity, all of them in one step."""

from __future__ import annotations

import numpy as np

from dxlrun.simulation.motion.command import ROWS
from dxlrun.simulation.motion.plant import Floats

_ARRIVED = 1e-9
"""rad; nearer to the goal a trajectory is there."""


class Profiles:
    """Position and velocity that the servos' controllers want now.

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
        self.position: Floats = angle.copy()
        """rad"""
        self.velocity: Floats = np.zeros(size)
        """rad/s"""
        self.change: Floats = np.zeros(size)
        """rad/s that the velocity changed by in the last step"""
        self.arrived = False
        """True while no trajectory moves."""
        self._dt_s = dt_s
        # arrays, as numpy is slower with numbers
        self._dt, self._per_dt = np.full(size, dt_s), np.full(size, 1.0 / dt_s)
        self._ramp, self._back, self._half = np.zeros(size), np.zeros(size), np.zeros(size)
        self._per_braking, self._one, self._one_half = np.zeros(size), np.ones(size), np.full(size, 0.5)
        self._error, self._wanted, self._reach = np.zeros(size), np.zeros(size), np.zeros(size)
        self._turning = np.zeros(size, dtype=bool)
        self._turns = False
        self.commanded()

    def commanded(self) -> None:
        """Take note that commands were changed."""
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
        """Let the trajectories go on by one step."""
        if self.arrived:
            return
        error, wanted, reach = self._error, self._wanted, self._reach
        np.subtract(self._goal, self.position, out=error)
        np.abs(error, out=reach)
        # Braking by a dt in each of n steps from v on takes n v - n (n - 1) / 2 a dt in steps of dt: for the
        # rest of the way the least n with which it can end at rest, and the v that ends exactly there.
        np.multiply(reach, self._per_braking, out=wanted)
        np.add(wanted, self._one, out=wanted)
        np.sqrt(wanted, out=wanted)
        np.subtract(wanted, self._one, out=wanted)
        np.multiply(wanted, self._one_half, out=wanted)
        np.ceil(wanted, out=wanted)
        np.maximum(wanted, self._one, out=wanted)
        np.multiply(reach, self._per_dt, out=reach)
        np.divide(reach, wanted, out=reach)
        np.subtract(wanted, self._one, out=wanted)
        np.multiply(wanted, self._half, out=wanted)
        np.add(wanted, reach, out=wanted)
        np.minimum(wanted, self._speed, out=wanted)
        np.copysign(wanted, error, out=wanted)
        if self._turns:
            np.copyto(wanted, self._speed, where=self._turning)
        np.subtract(wanted, self.velocity, out=wanted)
        np.minimum(wanted, self._ramp, out=wanted)
        np.maximum(wanted, self._back, out=self.change)
        np.add(self.velocity, self.change, out=self.velocity)
        np.multiply(self.velocity, self._dt, out=wanted)
        np.add(self.position, wanted, out=self.position)

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
