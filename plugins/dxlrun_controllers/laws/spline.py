"""Splines through the points of a trajectory: linear, cubic or quintic pieces, sampled by time; and stops.

A piece is sum(c[k] * t**k), t from its start. Coefficients as in Biagiotti and Melchiorri, Trajectory
Planning for Automatic Machines and Robots (2008), section 2.1. They are our own because the loop needs them
without growing memory, and scipy takes two seconds to import; the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dxlrun import Floats

LINEAR, CUBIC, QUINTIC = 2, 4, 6
"""Number of coefficients of a piece."""
DECELERATION: Final = 20.0
"""rad/s^2, of joints that have no limit of their own: an XM430 is at rest from its top speed in 0.25 s."""

_HEAD = 4


class SplineSample:
    """The desired state of the joints at one time; shape (joints,) each: rad, rad/s, rad/s^2."""

    def __init__(self, joints: int) -> None:
        self.rows = np.zeros((3, joints))
        self.position, self.velocity, self.acceleration = self.rows

    def rest_at(self, position: Floats) -> None:
        """Be at rest at a position."""
        self.rows.fill(0.0)
        np.copyto(self.position, position)


def solve(
    order: int,
    duration: float | Floats,
    start: Sequence[Floats] | Floats,
    end: Sequence[Floats] | Floats,
    out: Floats,
) -> None:
    """Write the piece from `start` to `end` (position, velocity, acceleration) into `out`.

    `duration` in s, above 0, for all joints or of each; `out` has the shape (order, joints). A linear piece
    looks only at positions, a cubic one not at accelerations.
    """
    way, t = end[0] - start[0], duration
    out[0] = start[0]
    if order == LINEAR:
        out[1] = way / t
        return
    v0, v1 = start[1], end[1]
    out[1] = v0
    if order == CUBIC:
        out[2] = (3 * way - (2 * v0 + v1) * t) / t**2
        out[3] = (-2 * way + (v0 + v1) * t) / t**3
        return
    a0, a1 = start[2], end[2]
    out[2] = a0 / 2
    out[3] = (20 * way - (8 * v1 + 12 * v0) * t - (3 * a0 - a1) * t**2) / (2 * t**3)
    out[4] = (-30 * way + (14 * v1 + 16 * v0) * t + (3 * a0 - 2 * a1) * t**2) / (2 * t**4)
    out[5] = (12 * way - 6 * (v1 + v0) * t + (a1 - a0) * t**2) / (2 * t**5)


def evaluate(piece: Sequence[Floats] | Floats, t: float, sample: SplineSample) -> None:
    """Write the piece's value and derivatives at `t` s into `sample` (Horner's scheme)."""
    position, velocity, acceleration = sample.rows
    sample.rows.fill(0.0)
    for coefficients in piece[::-1]:
        acceleration *= t
        acceleration += velocity
        velocity *= t
        velocity += position
        position *= t
        position += coefficients
    acceleration *= 2.0


def flatten(order: int, times: Floats, points: Floats, start_in: float) -> Floats:
    """Return a trajectory as the one flat array that `Trajectory.load` takes.

    `times` in s, shape (points,), growing; `points` has the shape (points, 3, joints): position, velocity,
    acceleration; `start_in` in s.
    """
    count, _, joints = points.shape
    pieces = np.empty((count - 1, order, joints))
    for index in range(count - 1):
        solve(order, float(times[index + 1] - times[index]), points[index], points[index + 1], pieces[index])
    head = np.array([count, joints, order, start_in])
    return np.concatenate([head, times, points[0].ravel(), points[-1].ravel(), pieces.ravel()])


class Trajectory:
    """A trajectory that is being played: a bridge from where the joints are to its first point, then pieces.

    `load` takes views of the flat array, so that nothing grows in the loop.
    """

    def __init__(self, joints: int) -> None:
        self._bridge = np.zeros((QUINTIC, joints))
        self.bridge_s = 0.0
        """From `load` to the first point, s."""
        self._start_in = 0.0
        self._times = np.zeros(1)
        self._first = self._last = np.zeros((3, joints))
        self._pieces = np.zeros((0, LINEAR, joints))
        self._now: tuple[Floats, ...] = ()
        """Coefficients of the piece that is played, from `_begin_s` to `_end_s`, in time of the points."""
        self._begin_s = self._end_s = 0.0
        self.duration_s = 0.0
        """From `load` to the last point, s."""

    def load(self, data: Floats, now: SplineSample) -> Floats:
        """Begin a flat trajectory from the sample `now`; time counts from here.

        From rest, the bridge is a piece as the others. From a motion it is quintic, whatever they are: it
        keeps velocity and acceleration at both its ends. Returns what `data` has beyond the trajectory.
        """
        count, joints, order = int(data[0]), int(data[1]), int(data[2])
        ends = _HEAD + count
        body = ends + 6 * joints
        end = body + (count - 1) * order * joints
        self._start_in = float(data[3])
        self._times = data[_HEAD:ends]
        self._first = data[ends : ends + 3 * joints].reshape(3, joints)
        self._last = data[ends + 3 * joints : body].reshape(3, joints)
        self._pieces = data[body:end].reshape(count - 1, order, joints)
        self._begin_s = self._end_s = 0.0
        self.bridge_s = self._start_in + float(self._times[0])
        self.duration_s = self._start_in + float(self._times[-1])
        self._bridge.fill(0.0)
        if self.bridge_s > 0:
            start = (now.position, now.velocity, now.acceleration)
            if now.velocity.any() or now.acceleration.any():
                solve(QUINTIC, self.bridge_s, start, self._beginning(order), self._bridge)
            else:
                solve(order, self.bridge_s, start, self._first, self._bridge[:order])
        return data[end:]

    def _beginning(self, order: int) -> tuple[Floats, Floats, Floats]:
        """Return position, velocity and acceleration with which the first piece begins, or what it has."""
        if len(self._pieces):
            first = self._pieces[0]
            return first[0], first[1], first[2] * 2.0 if order > LINEAR else np.zeros_like(first[0])
        velocity, acceleration = self._first[1] * (order > LINEAR), self._first[2] * (order > CUBIC)
        return self._first[0], velocity, acceleration

    def first_way(self, now: SplineSample) -> Floats:
        """Return the way from `now` to the first point, rad."""
        way: Floats = self._first[0] - now.position
        return way

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the desired state `t` s after `load`; after the end: the last position, at rest."""
        if t >= self.duration_s:
            sample.rest_at(self._last[0])
        else:
            piece, t = self._piece(t)
            evaluate(piece, t, sample)

    def _piece(self, t: float) -> tuple[Sequence[Floats] | Floats, float]:
        """Return the piece that is played `t` s after `load`, and the time in it."""
        if t < self.bridge_s:
            return self._bridge, max(t, 0.0)
        t -= self._start_in
        if not self._begin_s <= t < self._end_s:
            index = max(min(int(self._times.searchsorted(t, side="right")), len(self._pieces)) - 1, 0)
            self._begin_s, self._end_s = float(self._times[index]), float(self._times[index + 1])
            self._now = tuple(self._pieces[index])
        return self._now, t - self._begin_s


class Stop:
    """Joints that come to rest, each with a constant deceleration from its own velocity.

    t_stop = |v| / a, and the way is |v| t_stop / 2, as joint_trajectory_controller of ros2_controllers does
    on cancel (docs.ros.org, joint_trajectory_controller, "Decelerate on cancel"). Where a position limit is
    nearer than that way, the deceleration is v**2 / (2 way to the limit): the limit goes before it.
    """

    def __init__(self, joints: int) -> None:
        self._duration, self._end, self._pull = np.zeros((3, joints))
        self.duration_s = 0.0
        """From `load` until all are at rest, s."""

    def load(self, now: SplineSample, deceleration: Floats, lower: Floats, upper: Floats) -> None:
        """Begin to stop from position and velocity of `now`; limits shape (joints,), rad/s^2 and rad."""
        speed = np.abs(now.velocity)
        room = np.where(now.velocity > 0, upper - now.position, now.position - lower)
        needed = np.divide(speed * speed, 2.0 * room, out=np.full_like(room, np.inf), where=room > 0)
        needed = np.maximum(needed, deceleration)
        self._duration = speed / needed
        # a joint that stops at once has none
        self._pull = np.where(self._duration > 0, np.copysign(needed, now.velocity), 0.0)
        self._end = now.position + now.velocity * self._duration / 2.0
        self.duration_s = float(self._duration.max(initial=0.0))

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the state `t` s after `load` into `sample`."""
        left = np.maximum(self._duration - t, 0.0)
        np.multiply(self._pull, left, out=sample.velocity)
        np.add(sample.velocity * left * -0.5, self._end, out=sample.position)
        np.negative(self._pull * np.sign(left), out=sample.acceleration)
