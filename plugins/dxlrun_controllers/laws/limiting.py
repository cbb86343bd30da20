"""Limiting: positions that follow a reference within limits of position, velocity and acceleration.

Each joint by itself is a double integrator p'' = a with |a| <= A and |p'| <= V. The way to a reference in
the least time is a trapezoid of the velocity: constant acceleration, velocity, and deceleration
(L. Biagiotti, C. Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, section 3.2; with
an initial velocity as in T. Kroeger, On-Line Trajectory Generation in Robotic Systems, 2010).
"""

from __future__ import annotations

import numpy as np

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
        self._target, self._rate = np.zeros((2, joints))
        self._step = np.zeros((2, joints))
        self._arrays = np.zeros((10, joints))
        self._both = np.zeros((3, 2, joints))
        """There and back."""
        self._flags = np.zeros((3, joints), dtype=np.bool_)

    def begin(self, position: Floats) -> None:
        """Begin at rest."""
        np.copyto(self.position, position)
        self.velocity.fill(0.0)

    def stopping_point(self, out: Floats) -> None:
        """Write where each joint comes to rest if it stops now: p + v |v| / (2 A)."""
        np.abs(self.velocity, out=out)
        out *= self.velocity
        out /= self.acceleration
        out *= 0.5
        out += self.position

    def update(self, reference: Floats, rate: Floats, period_s: float) -> None:
        """Follow `reference` (rad), which moves at `rate` (rad/s), for a period."""
        target, speed = self._target, self._rate
        position, velocity = self._step
        passed, outside = self._flags[:2]
        np.minimum(reference, self.upper, out=target)
        np.maximum(target, self.lower, out=target)
        np.negative(self.speed, out=speed)
        np.maximum(rate, speed, out=speed)
        np.minimum(speed, self.speed, out=speed)
        speed *= np.equal(target, reference, out=passed)  # a limit does not move
        self._reachable(target, speed, period_s)
        if np.count_nonzero(passed) < passed.size:
            self._approach(target, speed, period_s)
        np.copyto(position, target, where=passed)
        np.copyto(velocity, speed, where=passed)
        self._outside(position, velocity)
        if np.count_nonzero(outside):
            kept = self._arrays[8:10]
            np.copyto(kept, self._step)
            np.copyto(target, self.upper)
            np.copyto(target, self.lower, where=velocity < 0)
            speed.fill(0.0)
            np.copyto(target, self.position, where=~outside)  # any finite one
            self._approach(target, speed, period_s)
            np.copyto(self._step, kept, where=~outside)
        np.copyto(self.position, position)
        np.copyto(self.velocity, velocity)

    def _reachable(self, target: Floats, speed: Floats, period_s: float) -> None:
        """Set in the first flags where one period leads to the target.

        The farthest way in it, from v to r', is w h - ((w - v)**2 + (w - r')**2) / (2 A), with the highest
        velocity between w = min((v + r' + A h) / 2, V); the farthest way back is the same with other signs.
        """
        way, change = self._arrays[:2]
        passed, _, fits = self._flags
        np.subtract(target, self.position, out=way)
        np.subtract(speed, self.velocity, out=change)
        np.abs(change, out=change)
        change /= period_s
        np.subtract(change, self.acceleration, out=change)
        np.less_equal(change, 1e-9, out=passed)
        w, part, there = self._both
        np.add(self.velocity, speed, out=there[0])
        np.negative(there[0], out=there[1])
        np.multiply(self.acceleration, period_s, out=change)
        np.add(there, change, out=w)
        w *= 0.5
        np.minimum(w, self.speed, out=w)
        # ((w - v)^2 + (w - r')^2) / 2 = w^2 - w (v + r') + (v^2 + r'^2) / 2
        np.subtract(w, there, out=part)
        part *= w
        np.multiply(self.velocity, self.velocity, out=change)
        np.multiply(speed, speed, out=there[0])
        change += there[0]
        change *= 0.5
        part += change
        part /= self.acceleration
        w *= period_s
        w -= part
        w += 1e-12  # rad, far below any servo's resolution: the rounding of the way
        np.less_equal(way, w[0], out=fits)
        passed &= fits
        np.negative(way, out=way)
        np.less_equal(way, w[1], out=fits)
        passed &= fits

    def _outside(self, position: Floats, velocity: Floats) -> None:
        """Set in the second flags where the joint could not stop before its limit."""
        stop, limit = self._arrays[:2]
        _, outside, towards = self._flags
        np.abs(velocity, out=stop)
        stop *= velocity
        stop /= self.acceleration
        stop *= 0.5
        stop += position
        np.add(self.upper, 1e-12, out=limit)
        np.greater(stop, limit, out=outside)
        np.greater(velocity, 0.0, out=towards)
        outside &= towards
        np.subtract(self.lower, 1e-12, out=limit)
        np.less(velocity, 0.0, out=towards)
        np.copyto(limit, -np.inf, where=~towards)
        np.less(stop, limit, out=towards)
        outside |= towards

    def _approach(self, target: Floats, speed: Floats, period_s: float) -> None:
        """Write the state after a period on the shortest way to a target that moves at `speed`.

        In the frame of the target, and in the direction s in which it lies from where the joint would stop:
        u is the velocity, d the way, w the highest velocity between, w = min(sqrt(A d + u**2 / 2), V - s r').
        """
        self._plan(target, speed, period_s)
        self._follow(target, speed, period_s)

    def _plan(self, target: Floats, speed: Floats, period_s: float) -> None:
        """Set direction, velocity, way, highest velocity, acceleration and the times of the three parts."""
        sign, u, d, peak, first, second, third, acceleration = self._arrays[:8]
        most = self.acceleration
        np.subtract(self.velocity, speed, out=u)
        np.multiply(speed, -period_s, out=d)  # the target is where it was when the period began
        d += target
        d -= self.position
        np.abs(u, out=sign)
        sign *= u
        sign /= most
        sign *= -0.5
        sign += d
        np.copysign(1.0, sign, out=sign)
        u *= sign
        d *= sign
        np.multiply(most, d, out=peak)
        np.multiply(u, u, out=first)
        first *= 0.5
        peak += first
        np.maximum(peak, 0.0, out=peak)
        np.sqrt(peak, out=peak)
        np.multiply(sign, speed, out=first)
        np.subtract(self.speed, first, out=first)
        np.minimum(peak, first, out=peak)
        np.subtract(peak, u, out=first)
        np.copysign(most, first, out=acceleration)
        first /= acceleration
        np.divide(peak, most, out=third)
        np.add(u, peak, out=second)
        second *= first
        # the way that is left for the second part, of which the third takes w t3 / 2
        np.multiply(peak, third, out=self._step[0])
        second += self._step[0]
        second *= -0.5
        second += d
        nothing = self._flags[2]
        np.less_equal(second, 0.0, out=nothing)
        # a target that is as fast as the joint may be is never caught up with
        second /= np.maximum(peak, 1e-200, out=peak)
        np.copyto(second, 0.0, where=nothing)

    def _follow(self, target: Floats, speed: Floats, period_s: float) -> None:
        """Write the state after as much of the planned parts as lies in the period."""
        position, velocity = self._step
        sign, u, _, _, first, second, third, acceleration = self._arrays[:8]
        most = self.acceleration
        np.add(first, second, out=position)
        position += third
        done = self._flags[2]
        np.less_equal(position, period_s, out=done)
        np.minimum(first, period_s, out=first)
        np.subtract(period_s, first, out=position)
        np.minimum(second, position, out=second)
        position -= second
        np.minimum(third, position, out=third)
        # d = u t1 + a t1^2 / 2 + w t2 + w t3 - A t3^2 / 2, with w as far as it is reached
        np.multiply(acceleration, first, out=velocity)
        np.multiply(velocity, first, out=position)
        position *= 0.5
        first *= u
        position += first
        velocity += u
        second += third
        second *= velocity
        position += second
        third *= most
        velocity -= third
        third *= third
        third /= most
        third *= 0.5
        position -= third
        # back from the frame of the target
        position *= sign
        velocity *= sign
        position += self.position
        velocity += speed
        np.multiply(speed, period_s, out=first)
        position += first
        np.copyto(position, target, where=done)
        np.copyto(velocity, speed, where=done)
