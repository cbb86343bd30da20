"""Stream: joint positions, cycle by cycle, for a pose that moves at a twist or toward another pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul, sub
from typing import Final, TypeAlias

import msgspec
import numpy as np

from dxlrun.tooling.robots import Transform
from dxlrun_space.chain import Column, Vector, scaled, shifted
from dxlrun_space.path import MotionLimits, Positions
from dxlrun_space.solver import Solver, distance, finish_search

LEASH_M: Final = 0.02
"""Longest distance of the moving pose from the tip, m: the tip soon rests when a twist ends."""
LEASH_RAD: Final = 0.1
"""The same of its orientation, rad."""
_AHEAD: Final = 0.95
"""Part of the tip's limits within which the pose moves. The rest is for the tip to catch up with the pose."""
_BRAKING: Final = 0.8
"""Part of the acceleration for a planned stop. The rest makes up for the length of a period."""
_TRIES: Final = 6
"""Most tries to find the largest share of the planned speeds that keeps the limits; the rest is braking."""
_STILL: Final = 1e-6
"""Speed below which a joint rests, rad/s or m/s."""
_LEAST: Final = 1e-12
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)
Twist: TypeAlias = "tuple[Vector, Vector]"
"""Linear velocity, m/s, and angular velocity, rad/s."""


class _State(msgspec.Struct, frozen=True):
    """Joints and tip at the end of a period."""

    positions: Positions
    speeds: Positions
    tip: Transform
    columns: list[Column]
    """Jacobian at the positions."""
    velocity: Twist = (_ZERO, _ZERO)
    """Mean velocity of the tip in the period."""

    def twist_at(self, speeds: Sequence[float]) -> Twist:
        """Return the velocity of the tip at speeds of the joints."""
        x, y, z, u, v, w = (math.fsum(map(mul, row, speeds)) for row in zip(*self.columns, strict=True))
        return (x, y, z), (u, v, w)

    def sizes(self, speeds: Sequence[float]) -> list[float]:
        """Return the sizes of all speeds, in the order of `MotionLimits`."""
        return [*map(_length, self.twist_at(speeds)), *map(abs, speeds)]


class TipMotion:
    """Motion of a tip by a velocity that changes at any time, within the limits of the tip and of the joints.

    A pose moves within the limits of the tip. The joints approach its solution, and are slower where the tip
    or a joint would exceed a limit. Each speed is such that the joints could brake, all in the same time,
    while the tip keeps its limits of velocity. Near a singularity the tip therefore leaves its direction.

    Args:
        solver: Solver with the chain and the limits of its joints.
        limits: Limits of joints and tip.
        exact: The orientation counts as much as the position.
        steps: Most steps of a search for the joints of the pose.
    """

    def __init__(self, solver: Solver, limits: MotionLimits, *, exact: bool, steps: int) -> None:
        self._solver, self._exact, self._steps = solver, exact, steps
        self._velocity, self._acceleration = limits.velocity, limits.acceleration
        reach, self._reaches = 0.0, list[tuple[int, bool, float]]()
        for index, slides, length in reversed(solver.chain.links):
            ends = np.clip((solver.lower[index], solver.upper[index]), -math.pi, math.pi)
            reach += length + slides * float(np.abs(ends).max())
            self._reaches.insert(0, (index, slides, reach))
        self.begin_motion((0.0,) * len(solver.lower))

    def begin_motion(self, positions: Positions) -> None:
        """Begin at rest at joint positions."""
        self._linear = self._angular = _ZERO
        self._sought = positions
        self.pose, still = self._solver.chain.pose(positions), (0.0,) * len(positions)
        """Pose that moves."""
        self._now = _State(positions, still, self.pose, self._solver.chain.jacobian())
        self.held_by = -1
        """Index of a joint that is at its limit while the pose is out of reach, or -1."""

    @property
    def rests(self) -> bool:
        """True if neither the pose nor a joint moves."""
        return not any((*self._linear, *self._angular)) and max(map(abs, self._now.speeds)) < _STILL

    def twist_to(self, goal: Transform, period_s: float) -> Twist:
        """Return the twist toward a pose, from which the motion can stop there."""
        ways, rates = distance(self.pose, goal), self._acceleration
        linear, angular = (
            scaled(way, approach(_length(way), rate, period_s) / max(_length(way), _LEAST))
            for way, rate in zip(ways, rates, strict=False)
        )
        return linear, angular

    def advance_joints(self, linear: Vector, angular: Vector, period_s: float) -> Positions:
        """Return the joint positions after a period in which the velocity approaches a twist, m/s, rad/s."""
        (speed, turning, *_), (rate, turn_rate, *_) = self._velocity, self._acceleration
        linear, angular = _toward(_ZERO, linear, _AHEAD * speed), _toward(_ZERO, angular, _AHEAD * turning)
        self._linear = _toward(self._linear, linear, _AHEAD * rate * period_s)
        self._angular = _toward(self._angular, angular, _AHEAD * turn_rate * period_s)
        self.pose = shifted(self.pose, scaled(self._linear, period_s), scaled(self._angular, period_s))
        before, solver = self._sought, self._solver
        search = solver.search_from(self.pose, before, exact=self._exact, steps=self._steps)
        found = finish_search(search)
        self._sought, self.held_by = found.positions, -1
        if found.residual.position > LEASH_M or found.residual.orientation > LEASH_RAD:
            ends = zip(self._sought, solver.lower, solver.upper, strict=True)
            self.held_by = next((index for index, (at, *limit) in enumerate(ends) if at in limit), -1)
        self._now = self._turned(before, period_s)
        way, turn = distance(self._now.tip, self.pose)
        if _length(way) > LEASH_M or _length(turn) > LEASH_RAD:
            way, turn = _toward(_ZERO, way, LEASH_M), _toward(_ZERO, turn, LEASH_RAD)
            self.pose = shifted(self._now.tip, way, turn)
        return self._now.positions

    def _turned(self, before: Positions, period_s: float) -> _State:
        """Return the joints after a period in which they approach the sought positions."""
        last = self._now.speeds
        planned = self._planned(before, period_s)
        braking = max(0.0, 1 - period_s / max(self._stop_s(last), _LEAST))
        best, low, high, share = None, 0.0, 1.0, 1.0
        for _ in range(_TRIES):
            speeds = [share * a + (1 - share) * braking * b for a, b in zip(planned, last, strict=True)]
            after = self._moved(speeds, period_s)
            if self._can_brake(after):
                best, low = after, share
            else:
                high = share
            if low == high:
                break
            share = (low + high) / 2
        return best or self._moved([braking * speed for speed in last], period_s)

    def _planned(self, before: Positions, period_s: float) -> list[float]:
        """Return the speeds of the joints toward the sought positions, and to keep up with these."""
        now, last, rates = self._now, self._now.speeds, self._acceleration
        lag = [*map(sub, before, now.positions)]
        # A joint that is not behind, with a way of 0, does not hold the others back.
        ways = ((max(way, _LEAST), rate) for way, rate in zip(now.sizes(lag), rates, strict=True))
        closing = min(approach(way, rate, period_s) / way for way, rate in ways)
        pairs = zip(before, self._sought, lag, strict=True)
        speeds = [(goal - then) / period_s + closing * way for then, goal, way in pairs]
        sizes = now.sizes(speeds)
        # Times until limits at these speeds, and the rate at which all of them may decrease.
        left = zip(self._left(now.positions, speeds), speeds, strict=True)
        left_s = min((way / abs(speed) for way, speed in left if abs(speed) > _STILL), default=math.inf)
        rate = min(most / max(size, _LEAST) for most, size in zip(rates, sizes, strict=True))
        tops = (most / max(size, _LEAST) for most, size in zip(self._velocity, sizes, strict=True))
        share = min(1.0, approach(left_s, rate, period_s), *tops)
        # Near a singularity the speeds change at once. The tip leaves its direction while the joints follow.
        change = [share * speed - then for speed, then in zip(speeds, last, strict=True)]
        step = min(
            rate * period_s / max(abs(each), _LEAST) for each, rate in zip(change, rates[2:], strict=True)
        )
        tips = zip(now.twist_at(last), now.velocity, now.twist_at(change), rates, strict=False)
        for kept, was, changed, most in tips:
            step = min(step, _furthest([*map(sub, kept, was)], changed, most * period_s))
        return [then + min(1.0, step) * each for then, each in zip(last, change, strict=True)]

    def _moved(self, speeds: Sequence[float], period_s: float) -> _State:
        """Return the joints after a period at speeds, and not beyond their limits."""
        now, solver = self._now, self._solver
        ends = self._left(now.positions, speeds)
        positions = tuple(
            at + math.copysign(min(abs(speed) * period_s, left), speed)
            for at, speed, left in zip(now.positions, speeds, ends, strict=True)
        )
        tip = solver.chain.pose(positions)
        way, turn = distance(now.tip, tip)
        velocity = scaled(way, 1 / period_s), scaled(turn, 1 / period_s)
        return _State(positions, tuple(speeds), tip, solver.chain.jacobian(), velocity)

    def _can_brake(self, after: _State) -> bool:
        """Return True if the tip kept its limits of velocity, and does so if all joints now brake evenly.

        Their speeds have a factor u then, which falls from 1 to 0. The speed of the tip is at most
        `u (speed + gain (1 - u^2) / 2)`, because the Jacobian changes with the way of the joints.
        """
        stop_s = self._stop_s(after.speeds)
        tips = zip(after.velocity, after.twist_at(after.speeds), self._bends(after.speeds), strict=True)
        for (moved, twist, bend), most in zip(tips, self._velocity, strict=False):
            speed, gain = _length(twist), bend * stop_s
            if speed < gain:
                speed = math.sqrt((gain + 2 * speed) / (3 * gain)) * (2 * speed + gain) / 3
            if max(_length(moved), speed) > most:
                return False
        ways = zip(after.speeds, self._left(after.positions, after.speeds), strict=True)
        return all(abs(speed) * stop_s / 2 <= left for speed, left in ways if speed)

    def _stop_s(self, speeds: Sequence[float]) -> float:
        return max(abs(speed) / rate for speed, rate in zip(speeds, self._acceleration[2:], strict=True))

    def _left(self, positions: Positions, speeds: Sequence[float]) -> list[float]:
        """Return the way of each joint to its limit in the direction in which it moves, rad or m."""
        ends = zip(positions, speeds, self._solver.lower, self._solver.upper, strict=True)
        return [max(0.0, upper - at if speed > 0 else at - lower) for at, speed, lower, upper in ends]

    def _bends(self, speeds: Sequence[float]) -> tuple[float, float]:
        """Return the largest linear and angular acceleration of the tip at constant speeds of the joints.

        They are bounds for all positions: the tip is at most the sum of all links away from a joint.
        """
        linear = angular = turning = 0.0
        for index, slides, reach in self._reaches:
            speed = abs(speeds[index])
            if slides:
                linear += 2 * speed * turning
            else:
                linear += speed * (speed + 2 * turning) * reach
                angular += speed * turning
                turning += speed
        return linear, angular


def approach(way: float, acceleration: float, period_s: float) -> float:
    """Return the speed toward a point that is `way` off, from which a motion can stop there."""
    brake = _BRAKING * acceleration
    # Near the point the speed is proportional to the way, because a period is too long for more.
    near = brake * (2 * period_s) ** 2
    return way / (2 * period_s) if way < near else math.sqrt(2 * brake * (way - near / 2))


def _furthest(begin: Sequence[float], way: Sequence[float], most: float) -> float:
    """Return the largest part of a way after which the length is at most `most`, or else the shortest."""
    square, slope = math.fsum(map(mul, way, way)), math.fsum(map(mul, begin, way))
    excess = math.fsum(map(mul, begin, begin)) - most * most
    return max(0.0, math.sqrt(max(0.0, slope * slope - square * excess)) - slope) / max(square, _LEAST**2)


def _toward(now: Vector, goal: Vector, most: float) -> Vector:
    """Return the point that is nearest to the goal, at most this far from the present one."""
    (x, y, z), (u, v, w) = now, goal
    length = math.hypot(u - x, v - y, w - z)
    if length <= most:
        return goal
    scale = most / length
    return x + (u - x) * scale, y + (v - y) * scale, z + (w - z) * scale


def _length(vector: Vector) -> float:
    return math.hypot(*vector)
