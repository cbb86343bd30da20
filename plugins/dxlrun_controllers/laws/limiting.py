"""Limiting: positions that follow a reference within limits of position, velocity and acceleration.

Each joint by itself is a double integrator p'' = a with |a| <= A and |p'| <= V. The way to a reference in
the least time is a trapezoid of the velocity: constant acceleration, velocity, and deceleration
(L. Biagiotti, C. Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, section 3.2; with
an initial velocity as in T. Kroeger, On-Line Trajectory Generation in Robotic Systems, 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats


class Limiter:
    """Follows references of some joints; arrays have the shape (joints,), nothing is allocated in `update`.

    - A reference that can be reached in one period, with its own velocity and within the limits, is passed on
      as it is.
    - Any other is approached in the least time. A reference that moves is at rest in a frame that moves with
      it, in which the trapezoid is planned anew each period, and followed for the period's length.
    - A joint never gets so fast that it could not stop before its position limit.
    """

    def __init__(self, joints: int) -> None:
        self.position, self.velocity = np.zeros((2, joints))
        """What is commanded: rad, rad/s."""
        self.lower, self.upper = np.full(joints, -np.inf), np.full(joints, np.inf)
        self.speed, self.acceleration = np.full(joints, np.inf), np.full(joints, np.inf)
        """Limits: rad, rad/s and rad/s^2, the last one finite."""

    def begin(self, position: Floats) -> None:
        """Begin at rest."""
        np.copyto(self.position, position)
        self.velocity.fill(0.0)

    def stopping_point(self, position: Floats, velocity: Floats) -> Floats:
        """Return where joints come to rest that stop there: p + v |v| / (2 A)."""
        point: Floats = np.abs(velocity) * velocity / self.acceleration * 0.5 + position
        return point

    def update(self, reference: Floats, rate: Floats, period_s: float) -> None:
        """Follow `reference` (rad), which moves at `rate` (rad/s), for a period."""
        target = np.maximum(np.minimum(reference, self.upper), self.lower)
        speed = np.minimum(np.maximum(rate, -self.speed), self.speed)
        speed *= target == reference  # a limit does not move
        passed = self._reachable(target, speed, period_s)
        position, velocity = target, speed
        if not passed.all():
            position, velocity = self._approach(target, speed, period_s)
            np.copyto(position, target, where=passed)
            np.copyto(velocity, speed, where=passed)
        outside = self._outside(position, velocity)
        if outside.any():
            limit = np.where(velocity < 0, self.lower, self.upper)
            limit = np.where(outside, limit, self.position)  # any finite one
            nearer, slower = self._approach(limit, np.zeros_like(speed), period_s)
            position = np.where(outside, nearer, position)
            velocity = np.where(outside, slower, velocity)
        np.copyto(self.position, position)
        np.copyto(self.velocity, velocity)

    def _reachable(self, target: Floats, speed: Floats, period_s: float) -> NDArray[np.bool_]:
        """Return where one period leads to the target.

        The farthest way in it, from v to r', is w h - ((w - v)**2 + (w - r')**2) / (2 A), with the highest
        velocity between w = min((v + r' + A h) / 2, V); the farthest way back is the same with other signs.
        """
        way, most = target - self.position, self.acceleration
        passed: NDArray[np.bool_] = np.abs(speed - self.velocity) / period_s - most <= 1e-9
        both = self.velocity + speed
        squares = (self.velocity * self.velocity + speed * speed) * 0.5
        for there, direction in ((both, 1.0), (-both, -1.0)):
            w = np.minimum((there + most * period_s) * 0.5, self.speed)
            # ((w - v)^2 + (w - r')^2) / 2 = w^2 - w (v + r') + (v^2 + r'^2) / 2
            farthest = w * period_s - ((w - there) * w + squares) / most
            farthest += 1e-12  # rad, far below any servo's resolution: the rounding of the way
            passed &= way * direction <= farthest
        return passed

    def _outside(self, position: Floats, velocity: Floats) -> NDArray[np.bool_]:
        """Return where the joint could not stop before its limit."""
        stop = self.stopping_point(position, velocity)
        above: NDArray[np.bool_] = (stop > self.upper + 1e-12) & (velocity > 0.0)
        return above | ((stop < self.lower - 1e-12) & (velocity < 0.0))

    def _approach(self, target: Floats, speed: Floats, period_s: float) -> tuple[Floats, Floats]:
        """Return the state after a period on the shortest way to a target that moves at `speed`.

        In the frame of the target, and in the direction s in which it lies from where the joint would stop:
        u is the velocity, d the way, w the highest velocity between, w = min(sqrt(A d + u**2 / 2), V - s r').
        """
        most = self.acceleration
        u = self.velocity - speed
        d = speed * -period_s + target - self.position  # the target is where it was when the period began
        sign = np.copysign(1.0, np.abs(u) * u / most * -0.5 + d)
        u, d = u * sign, d * sign
        peak = np.minimum(np.sqrt(np.maximum(most * d + u * u * 0.5, 0.0)), self.speed - sign * speed)
        # the times of the three parts: to the highest velocity, with it, and to rest
        acceleration = np.copysign(most, peak - u)
        first, third = (peak - u) / acceleration, peak / most
        # the way that is left for the second part, of which the third takes w t3 / 2
        left = ((u + peak) * first + peak * third) * -0.5 + d
        # a target that is as fast as the joint may be is never caught up with
        second = np.where(left <= 0.0, 0.0, left / np.maximum(peak, 1e-200))
        done = first + second + third <= period_s
        # as much of them as lies in the period
        first = np.minimum(first, period_s)
        second = np.minimum(second, period_s - first)
        third = np.minimum(third, period_s - first - second)
        # d = u t1 + a t1^2 / 2 + w t2 + w t3 - A t3^2 / 2, with w as far as it is reached
        gained = acceleration * first
        reached, lost = gained + u, third * most
        way = gained * first * 0.5 + first * u + (second + third) * reached - lost * lost / most * 0.5
        # back from the frame of the target
        position = way * sign + self.position + speed * period_s
        velocity = (reached - lost) * sign + speed
        return np.where(done, target, position), np.where(done, speed, velocity)
