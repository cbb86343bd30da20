"""Stream: joint velocities for a twist of the tip, cycle by cycle, within all limits.

Damped least squares (C. W. Wampler, "Manipulator inverse kinematic solutions based on vector formulations and
damped least-squares methods", 1986): near a singularity joints become slower instead of faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from dxlrun_space.chain import Vector
from dxlrun_space.path import MotionLimits
from dxlrun_space.solver import EXACT, Solver, normal_matrix, pulls, solve

_ORIENTATION: Final = 0.03
"""Lever of the orientation for arms that cannot keep all its turns, as a fraction of the length."""
_DAMPING: Final = 0.01
"""Damping, as a fraction of the length: 1 % of a joint's lever slows a motion by one part in ten thousand."""
_STUCK: Final = 0.02
"""Fraction of the velocity below which a motion counts as held."""

_BRAKING: Final = 0.8
"""Part of the acceleration for a planned stop. The rest makes up for the length of a period."""


class TwistMotion:
    """Motion of a chain by twists.

    Args:
        solver: Solver with the chain and the limits of its joints.
        limits: Limits of joints and tip.
        exact: The arm can keep the orientation, so it counts as much as the position.
    """

    def __init__(self, solver: Solver, limits: MotionLimits, *, exact: bool) -> None:
        self._solver, self._chain, self._limits = solver, solver.chain, limits
        self._lever = (EXACT if exact else _ORIENTATION) * self._chain.length
        self._damping = (_DAMPING * self._chain.length) ** 2
        self.linear: Vector = (0.0, 0.0, 0.0)
        """Present velocity of the tip, m/s, within its acceleration limit."""
        self.angular: Vector = (0.0, 0.0, 0.0)
        self._speeds = (0.0,) * len(self._chain.joints)
        self.held_by = -1
        """Index of the joint that holds the tip at its limit, or -1."""

    @property
    def rests(self) -> bool:
        """True if neither the tip nor a joint is moved."""
        return not any((*self.linear, *self.angular, *self._speeds))

    def drop_twist(self) -> None:
        """Set the velocity to 0 at once."""
        self.linear = self.angular = (0.0, 0.0, 0.0)
        self._speeds = (0.0,) * len(self._speeds)

    def change_twist(self, linear: Vector, angular: Vector, period_s: float) -> None:
        """Bring the present velocity closer to a twist, within the limits of the tip."""
        limits, rest = self._limits, (0.0, 0.0, 0.0)
        linear, angular = (
            _toward(rest, linear, limits.linear_velocity),
            _toward(rest, angular, limits.angular_velocity),
        )
        self.linear = _toward(self.linear, linear, limits.linear_acceleration * period_s)
        self.angular = _toward(self.angular, angular, limits.angular_acceleration * period_s)

    def advance_joints(
        self, positions: Sequence[float], linear: Vector, angular: Vector, period_s: float
    ) -> tuple[float, ...]:
        """Return the joint positions after a period at the twist, which the present velocity approaches."""
        self.change_twist(linear, angular, period_s)
        self.held_by = -1
        if self.rests:
            return tuple(positions)
        self._chain.pose(positions)
        columns = self._chain.jacobian(self._lever)
        right = pulls(columns, self.linear, self.angular, self._lever)
        speeds = solve(normal_matrix(columns, self._damping), right)
        return self.turn_joints(positions, speeds, period_s)

    def turn_joints(
        self, positions: Sequence[float], speeds: Sequence[float], period_s: float
    ) -> tuple[float, ...]:
        """Return the joint positions after a period at speeds that are limited, rad/s or m/s."""
        self.held_by, scale = -1, 1.0
        for index, (speed, now) in enumerate(zip(speeds, positions, strict=True)):
            share = self._highest(index, now, speed, period_s) / max(abs(speed), 1e-12)
            if share < scale:
                scale = share
                self.held_by = index if share < _STUCK else -1
        # Near a singularity the speeds change at once. The tip leaves its direction while the joints follow.
        self._speeds = tuple(
            min(max(speed * scale, before - rate * period_s), before + rate * period_s)
            for speed, before, rate in zip(speeds, self._speeds, self._limits.acceleration, strict=True)
        )
        return tuple(now + speed * period_s for now, speed in zip(positions, self._speeds, strict=True))

    def _highest(self, index: int, now: float, speed: float, period_s: float) -> float:
        """Return the speed at which a joint still stops at its limit, at most its own limit."""
        left = self._solver.upper[index] - now if speed > 0 else now - self._solver.lower[index]
        if left <= 0:
            return 0.0
        brake = self._limits.acceleration[index] / 2
        return min(self._limits.velocity[index], math.sqrt(2 * brake * left), left / period_s)


def approach(way: Vector, acceleration: float, period_s: float) -> Vector:
    """Return the velocity toward a point that is `way` off, from which a motion can stop there."""
    brake, length = _BRAKING * acceleration, math.hypot(*way)
    # Near the point the velocity is proportional to the way, because a period is too long for more.
    near = brake * (2 * period_s) ** 2
    speed = length / (2 * period_s) if length < near else math.sqrt(2 * brake * (length - near / 2))
    x, y, z = way
    scale = speed / max(length, 1e-12)
    return x * scale, y * scale, z * scale


def _toward(now: Vector, goal: Vector, most: float) -> Vector:
    """Return the point that is nearest to the goal, at most this far from the present one."""
    (x, y, z), (u, v, w) = now, goal
    length = math.hypot(u - x, v - y, w - z)
    if length <= most:
        return goal
    scale = most / length
    return x + (u - x) * scale, y + (v - y) * scale, z + (w - z) * scale
