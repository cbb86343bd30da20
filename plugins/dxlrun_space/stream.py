"""Stream: joint positions, cycle by cycle, for a pose that moves at a twist or toward another pose."""

from __future__ import annotations

import math
from typing import Final

from dxlrun.tooling.robots import Transform
from dxlrun_space.chain import BASE, Vector, scaled, shifted
from dxlrun_space.path import MotionLimits, Positions
from dxlrun_space.solver import Solver, distance, finish_search

LEASH_M: Final = 0.02
"""Longest distance of the moving pose from what is in reach, m: the way back is short."""
LEASH_RAD: Final = 0.1
"""The same of its orientation, rad."""
_BRAKING: Final = 0.8
"""Part of the acceleration for a planned stop. The rest makes up for the length of a period."""
_STILL: Final = 1e-6
"""Speed below which a joint rests, rad/s or m/s."""
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


class TipMotion:
    """Motion of a tip by a velocity that changes at any time, within the limits of the tip and of the joints.

    The limits of the tip are those of a pose, whose solution the joints approach within their own limits:
    near a singularity they need longer.

    Args:
        solver: Solver with the chain and the limits of its joints.
        limits: Limits of joints and tip.
        exact: The orientation counts as much as the position.
        steps: Most steps of a search for the joints of the pose.
    """

    def __init__(self, solver: Solver, limits: MotionLimits, *, exact: bool, steps: int) -> None:
        self._solver, self._limits, self._exact, self._steps = solver, limits, exact, steps
        self.begin_motion(())

    def begin_motion(self, positions: Positions) -> None:
        """Begin at rest at joint positions."""
        self._linear = self._angular = _ZERO
        self._at = self._sought = positions
        self._speeds = (0.0,) * len(positions)
        self.pose = self._solver.chain.pose(positions) if positions else BASE
        """Pose that moves."""
        self.held_by = -1
        """Index of a joint that is at its limit while the pose is out of reach, or -1."""

    @property
    def rests(self) -> bool:
        """True if neither the pose nor a joint moves."""
        return not any((*self._linear, *self._angular)) and max(map(abs, self._speeds)) < _STILL

    def twist_to(self, goal: Transform, period_s: float) -> tuple[Vector, Vector]:
        """Return the twist toward a pose, from which the motion can stop there."""
        (way, turn), limits = distance(self.pose, goal), self._limits
        far, off = math.hypot(*way), math.hypot(*turn)
        linear = approach(far, limits.linear_acceleration, period_s) / max(far, 1e-12)
        angular = approach(off, limits.angular_acceleration, period_s) / max(off, 1e-12)
        return scaled(way, linear), scaled(turn, angular)

    def advance_joints(self, linear: Vector, angular: Vector, period_s: float) -> Positions:
        """Return the joint positions after a period in which the velocity approaches a twist, m/s, rad/s."""
        limits = self._limits
        linear = _toward(_ZERO, linear, limits.linear_velocity)
        angular = _toward(_ZERO, angular, limits.angular_velocity)
        self._linear = _toward(self._linear, linear, limits.linear_acceleration * period_s)
        self._angular = _toward(self._angular, angular, limits.angular_acceleration * period_s)
        self.pose = shifted(self.pose, scaled(self._linear, period_s), scaled(self._angular, period_s))
        before, solver = self._sought, self._solver
        search = solver.search_from(self.pose, before, exact=self._exact, steps=self._steps)
        found = finish_search(search)
        self._sought, self.held_by = found.positions, -1
        if found.residual.position > LEASH_M or found.residual.orientation > LEASH_RAD:
            reached = solver.chain.pose(self._sought)
            way, turn = distance(reached, self.pose)
            self.pose = shifted(reached, _toward(_ZERO, way, LEASH_M), _toward(_ZERO, turn, LEASH_RAD))
            ends = zip(self._sought, solver.lower, solver.upper, strict=True)
            self.held_by = next((index for index, (at, *limit) in enumerate(ends) if at in limit), -1)
        self._turn_joints(before, period_s)
        return self._at

    def _turn_joints(self, before: Positions, period_s: float) -> None:
        """Turn the joints toward the sought positions, and keep up with these."""
        limits, solver = self._limits, self._solver
        share, speeds = 1.0, list[float]()
        for index, (now, then, goal) in enumerate(zip(self._at, before, self._sought, strict=True)):
            most, rate = limits.velocity[index], limits.acceleration[index]
            closing = math.copysign(approach(abs(then - now), rate, period_s), then - now)
            speed = (goal - then) / period_s + closing
            left = max(0.0, solver.upper[index] - now if speed > 0 else now - solver.lower[index])
            # The speed at which the joint still stops at its limit.
            most = min(most, math.sqrt(rate * left), left / period_s)
            share = min(share, most / max(abs(speed), 1e-12))
            speeds.append(speed)
        # Near a singularity the speeds change at once. The tip leaves its direction while the joints follow.
        self._speeds = tuple(
            min(max(speed * share, last - rate * period_s), last + rate * period_s)
            for speed, last, rate in zip(speeds, self._speeds, limits.acceleration, strict=True)
        )
        self._at = tuple(now + speed * period_s for now, speed in zip(self._at, self._speeds, strict=True))


def approach(way: float, acceleration: float, period_s: float) -> float:
    """Return the speed toward a point that is `way` off, from which a motion can stop there."""
    brake = _BRAKING * acceleration
    # Near the point the speed is proportional to the way, because a period is too long for more.
    near = brake * (2 * period_s) ** 2
    return way / (2 * period_s) if way < near else math.sqrt(2 * brake * (way - near / 2))


def _toward(now: Vector, goal: Vector, most: float) -> Vector:
    """Return the point that is nearest to the goal, at most this far from the present one."""
    (x, y, z), (u, v, w) = now, goal
    length = math.hypot(u - x, v - y, w - z)
    if length <= most:
        return goal
    scale = most / length
    return x + (u - x) * scale, y + (v - y) * scale, z + (w - z) * scale
