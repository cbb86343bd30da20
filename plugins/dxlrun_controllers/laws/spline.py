"""Splines through the points of a trajectory: linear, cubic or quintic pieces, sampled by time; and stops.

A piece is sum(c[k] * t**k), t from its start. Coefficients as in Biagiotti and Melchiorri, Trajectory
Planning for Automatic Machines and Robots (2008), section 2.1. They are our own because the loop needs them
without growing memory, and scipy takes two seconds to import; the tests compare the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, nearest_turn

LINEAR, CUBIC, QUINTIC = 2, 4, 6
"""Number of coefficients of a piece."""
DECELERATION: Final = 20.0
"""rad/s^2, of joints that have no limit of their own: an XM430 is at rest from its top speed in 0.25 s."""

START_IN: Final = 3
"""Where `start_in` is in the flat array of a trajectory, behind the numbers of points, joints and
coefficients."""
_HEAD = 4
_TRIES = 12
"""In which a bridge becomes so long that it is not too fast."""
_SHORTER = 1.001
"""By so much more than it is too fast a bridge is made longer: its speed does not fall in proportion."""
_SHARES = np.linspace(1, 0, 17)
"""Shares of a piece's time from which its peak is searched: its speed has at most three extremes. The end
comes first, as a constant speed is that of the way to the end."""
_APART = 1 / 16
_STEPS = 3
"""Of Newton's method, which doubles the digits in each: that of a cubic's parabola is exact after one."""


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


def peak_velocities(piece: Floats, duration: float | Floats) -> tuple[Floats, Floats]:
    """Return the velocity of the largest magnitude on each piece, rad/s, and its time, s from its start.

    `piece` has the shape (order, pieces), `duration` is in s, of all pieces or of each. This is the one
    place where the peak of a spline is found. The velocity of a cubic is a parabola, that of a quintic has
    the extremes of a quartic: Newton's method finds the one next to the highest of some samples.
    """
    order = len(piece)
    powers = np.asarray(duration, dtype=np.float64) ** np.arange(order - 1)[:, None]
    speed = piece[1:] * np.arange(1, order)[:, None] * powers  # coefficients of the share of the time
    slope = speed[1:] * np.arange(1, order - 1)[:, None]
    bend = slope[1:] * np.arange(1, order - 2)[:, None]
    sampled = _SHARES[:, None] ** np.arange(order - 1) @ speed
    best = np.abs(sampled).argmax(axis=0)
    highest, share = sampled[best, np.arange(piece.shape[1])], _SHARES[best]
    lower, upper = np.maximum(share - _APART, 0.0), np.minimum(share + _APART, 1.0)
    near = share
    for _ in range(_STEPS):
        bent = _horner(bend, near)
        step = np.divide(_horner(slope, near), bent, out=np.zeros_like(near), where=bent != 0.0)
        near = np.minimum(np.maximum(near - step, lower), upper)
    refined = _horner(speed, near)
    higher = np.abs(refined) > np.abs(highest)
    return np.where(higher, refined, highest), np.where(higher, near, share) * duration


def _horner(coefficients: Floats, at: Floats) -> Floats:
    value = np.zeros_like(at)
    for coefficient in coefficients[::-1]:
        value = value * at + coefficient
    return value


def trajectory_peaks(data: Floats) -> list[tuple[float, float, int]]:
    """Return for each joint of a flat trajectory its peak velocity, when, s, and on which piece, from 0.

    Nothing where the trajectory has one point: the way there is not known.
    """
    count, joints, order = map(int, data[:START_IN].tolist())
    if count < 2:
        return []
    times = data[_HEAD : _HEAD + count]
    pieces = data[_HEAD + count + 6 * joints : flat_size(data)].reshape(count - 1, order, joints)
    flat = np.ascontiguousarray(pieces.transpose(1, 0, 2)).reshape(order, -1)
    speed, at = peak_velocities(flat, np.repeat(np.diff(times), joints))
    speed, at = speed.reshape(-1, joints), at.reshape(-1, joints)
    rows = np.abs(speed).argmax(axis=0).tolist()
    return [
        (float(speed[row, joint]), float(times[row] + at[row, joint]), row) for joint, row in enumerate(rows)
    ]


def smooth_velocities(times: Floats, positions: Floats) -> Floats:
    """Return velocities at points with which cubic pieces overshoot none of them, shape (points, joints).

    F. N. Fritsch, J. Butland, "A method for constructing local monotone piecewise cubic interpolants", SIAM
    Journal on Scientific and Statistical Computing 5, 1984; at both ends the three-point formula of C. Moler,
    Numerical Computing with MATLAB (2004), section 3.6. `times` in s, growing, shape (points,).
    """
    gaps = np.diff(times)[:, None]
    slopes = np.diff(positions, axis=0) / gaps
    if len(times) < 3:
        return np.resize(slopes, positions.shape) if len(slopes) else np.zeros_like(positions)
    velocities = np.zeros_like(positions)
    before, after, gap, next_gap = slopes[:-1], slopes[1:], gaps[:-1], gaps[1:]
    first, second = 2.0 * next_gap + gap, next_gap + 2.0 * gap
    grows = before * after > 0
    weighed = first * after + second * before
    np.divide((first + second) * before * after, weighed, out=velocities[1:-1], where=grows)
    velocities[0] = _end_velocity(gaps[0], gaps[1], slopes[0], slopes[1])
    velocities[-1] = _end_velocity(gaps[-1], gaps[-2], slopes[-1], slopes[-2])
    return velocities


def _end_velocity(gap: Floats, next_gap: Floats, slope: Floats, next_slope: Floats) -> Floats:
    velocity = ((2.0 * gap + next_gap) * slope - gap * next_slope) / (gap + next_gap)
    velocity = np.where(velocity * slope > 0, velocity, 0.0)
    bends = (slope * next_slope < 0) & (np.abs(velocity) > 3.0 * np.abs(slope))
    return np.where(bends, 3.0 * slope, velocity)


def flatten(orders: Sequence[int], times: Floats, points: Floats, start_in: float) -> Floats:
    """Return a trajectory as the one flat array that `Trajectory.load` takes.

    `times` in s, shape (points,), growing; `points` has the shape (points, 3, joints): position, velocity,
    acceleration; `start_in` in s. Each point has its order, by what is given of it; a piece has the lower one
    of its two ends.
    """
    count, _, joints = points.shape
    of_pieces = [min(pair) for pair in pairwise(orders)]
    order = max(of_pieces, default=orders[0])
    pieces = np.zeros((count - 1, order, joints))
    for index, own in enumerate(of_pieces):
        gap = float(times[index + 1] - times[index])
        solve(own, gap, points[index], points[index + 1], pieces[index, :own])
    head = np.array([count, joints, order, start_in])
    return np.concatenate([head, times, points[0].ravel(), points[-1].ravel(), pieces.ravel()])


def flat_size(data: Floats) -> int:
    """Return how many numbers of a flat array are those of its trajectory."""
    count, joints, order = map(int, data[:START_IN].tolist())
    return _HEAD + count + 6 * joints + (count - 1) * order * joints


def whole_turns(data: Floats, now: Floats, wrap: NDArray[np.bool_]) -> Floats:
    """Return a flat trajectory with the joints of `wrap` moved by whole turns.

    Their first point is at most half a turn from `now`, rad, shape (joints,).
    """
    count, joints, order = map(int, data[:START_IN].tolist())
    ends = _HEAD + count
    first = data[ends : ends + joints]
    moved = np.where(wrap, nearest_turn(first, now) - first, 0.0)
    if not np.any(moved) or not np.isfinite(moved).all():
        return data
    shifted, body = data.copy(), ends + 6 * joints
    shifted[ends : ends + joints] += moved
    shifted[ends + 3 * joints : ends + 4 * joints] += moved
    shifted[body : flat_size(data)].reshape(count - 1, order, joints)[:, 0] += moved
    return shifted


class Trajectory:
    """A trajectory that is being played: a bridge from where the joints are to its first point, then pieces.

    `load` and `join` take views of the flat array, so that nothing grows in the loop.
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
        self._tail = Stop(joints)
        self._tail_s = 0.0
        """When the joints begin to come to rest behind the last point."""
        self._joined = SplineSample(joints)
        self.duration_s = 0.0
        """From `load` until all are at rest, s."""

    def load(self, data: Floats, now: SplineSample, waited_s: float = 0.0) -> None:
        """Begin a flat trajectory from the sample `now`; time counts from here.

        From rest, the bridge is a piece as the others. From a motion it is quintic, whatever they are: it
        keeps velocity and acceleration at both its ends. `waited_s` of the time until its start have passed.
        """
        order = self._take(data, float(data[START_IN]) - waited_s)
        self.bridge_s = self._start_in + float(self._times[0])
        self.duration_s = self._tail_s = self._start_in + float(self._times[-1])
        if self.bridge_s > 0:
            start = (now.position, now.velocity, now.acceleration)
            if now.velocity.any() or now.acceleration.any():
                solve(QUINTIC, self.bridge_s, start, self._beginning(order), self._bridge)
            else:
                solve(order, self.bridge_s, start, self._first, self._bridge[:order])

    def join(self, data: Floats, now: SplineSample, late_s: float, blend_s: float, limits: Limits) -> bool:
        """Begin a flat trajectory from the sample `now`, in its middle: `late_s` of its points' time is over.

        A quintic bridge passes into it in `blend_s`, or so much later that the way there is not too fast.
        Behind the last point the joints come to rest. Returns False where all of its points are in the past.
        """
        self._take(data, -late_s)
        joined, end_s = self._joined, float(self._times[-1]) - late_s
        if end_s <= 0:
            return False
        bridge_s, haste = max(blend_s, float(self._times[0]) - late_s), 1.0
        for _ in range(_TRIES):
            bridge_s *= haste
            if bridge_s < end_s:
                self._sample_points(bridge_s, joined)
            else:
                joined.rest_at(self._last[0])
            solve(QUINTIC, bridge_s, now.rows, joined.rows, self._bridge)
            haste = float((np.abs(peak_velocities(self._bridge, bridge_s)[0]) / limits.speed).max())
            if haste <= 1.0:
                break
            haste *= _SHORTER
        self.bridge_s, self._tail_s = bridge_s, max(end_s, bridge_s)
        if bridge_s < end_s:
            self._sample_points(end_s, joined)
        self._tail.load(joined, limits.deceleration, limits.lower, limits.upper)
        self.duration_s = self._tail_s + self._tail.duration_s
        return True

    def _take(self, data: Floats, start_in: float) -> int:
        """Take the parts of a flat array; return the order of its pieces."""
        count, joints, order = map(int, data[:START_IN].tolist())
        ends = _HEAD + count
        body, end = ends + 6 * joints, flat_size(data)
        self._start_in = start_in
        self._times = data[_HEAD:ends]
        self._first = data[ends : ends + 3 * joints].reshape(3, joints)
        self._last = data[ends + 3 * joints : body].reshape(3, joints)
        self._pieces = data[body:end].reshape(count - 1, order, joints)
        self._begin_s = self._end_s = 0.0
        self._bridge.fill(0.0)
        return order

    def _beginning(self, order: int) -> tuple[Floats, Floats, Floats]:
        """Return position, velocity and acceleration with which the first piece begins, or what it has."""
        if len(self._pieces):
            first = self._pieces[0]
            return first[0], first[1], first[2] * 2.0 if order > LINEAR else np.zeros_like(first[0])
        velocity, acceleration = self._first[1] * (order > LINEAR), self._first[2] * (order > CUBIC)
        return self._first[0], velocity, acceleration

    @property
    def end(self) -> Floats:
        """Position of the last point, as it was asked, rad."""
        position: Floats = self._last[0]
        return position

    def bridge_speeds(self) -> Floats:
        """Return the highest speed of each joint on the bridge, rad/s."""
        speeds: Floats = np.abs(peak_velocities(self._bridge, self.bridge_s)[0])
        return speeds

    def longest_steps(self, now: SplineSample, rows: NDArray[np.intp]) -> Floats:
        """Return the longest way of each joint of `rows` from one point to the next, from `now` on, rad."""
        starts = self._pieces[:, 0, rows]
        points = np.concatenate([[now.position[rows], self._first[0, rows]], starts, [self._last[0, rows]]])
        steps: Floats = np.abs(np.diff(points, axis=0)).max(axis=0)
        return steps

    def first_way(self, now: SplineSample) -> Floats:
        """Return the way from `now` to the first point, rad."""
        way: Floats = self._first[0] - now.position
        return way

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the desired state `t` s after `load`; after the end: at rest."""
        if t < self.bridge_s:
            evaluate(self._bridge, max(t, 0.0), sample)
        elif t < self._tail_s:
            self._sample_points(t, sample)
        elif t < self.duration_s:
            self._tail.sample(t - self._tail_s, sample)
        else:
            sample.rest_at(self._last[0] if self._tail_s == self.duration_s else self._tail.end)

    def _sample_points(self, t: float, sample: SplineSample) -> None:
        """Write the state on the pieces, or at the only point, `t` s after `load`."""
        if not len(self._pieces):
            np.copyto(sample.rows, self._first)
            return
        t -= self._start_in
        if not self._begin_s <= t < self._end_s:
            index = max(min(int(self._times.searchsorted(t, side="right")), len(self._pieces)) - 1, 0)
            self._begin_s, self._end_s = float(self._times[index]), float(self._times[index + 1])
            self._now = tuple(self._pieces[index])
        evaluate(self._now, t - self._begin_s, sample)


class Limits(NamedTuple):
    """What joints keep when they pass into a trajectory and behind its end; shape (joints,) each."""

    speed: Floats
    """rad/s"""
    deceleration: Floats
    """rad/s^2"""
    lower: Floats
    upper: Floats
    """rad"""


class Stop:
    """Joints that come to rest, each with a constant deceleration from its own velocity.

    t_stop = |v| / a, and the way is |v| t_stop / 2, as joint_trajectory_controller of ros2_controllers does
    on cancel (docs.ros.org, joint_trajectory_controller, "Decelerate on cancel"). Where a position limit is
    nearer than that way, the deceleration is v**2 / (2 way to the limit): the limit goes before it.
    """

    def __init__(self, joints: int) -> None:
        self._duration, self.end, self._pull = np.zeros((3, joints))
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
        self.end = now.position + now.velocity * self._duration / 2.0
        self.duration_s = float(self._duration.max(initial=0.0))

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the state `t` s after `load` into `sample`."""
        left = np.maximum(self._duration - t, 0.0)
        np.multiply(self._pull, left, out=sample.velocity)
        np.add(sample.velocity * left * -0.5, self.end, out=sample.position)
        np.negative(self._pull * np.sign(left), out=sample.acceleration)
