"""Splines through the points of a trajectory: linear, cubic or quintic pieces, sampled by time; and stops.

A piece is sum(c[k] * t**k) with t from its start. The coefficients are those of Biagiotti and Melchiorri,
Trajectory Planning for Automatic Machines and Robots (2008), section 2.1. scipy is not used because the loop
must not allocate memory that stays, and because its import takes two seconds. The tests compare the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Polynomial, nearest_turn

LINEAR, CUBIC, QUINTIC = 2, 4, 6
"""Order of a piece: number of its coefficients."""
DECELERATION: Final = 20.0
"""Default deceleration of joints without an acceleration limit, rad/s^2; an XM430 stops from top speed in
0.25 s.
"""

START_IN: Final = 3
"""Index of `start_in` (s) in a flat trajectory, after the numbers of points, joints and coefficients."""
_HEAD = 4
"""Length of the header of a flat trajectory, before the times of the points."""
_TRIES = 12
"""Upper limit of the attempts to make a bridge long enough to keep the speed limits."""
_SHORTER = 1.001
"""Extra factor on the duration of a bridge that is too fast: its speed falls less than in proportion."""
_SHARES = np.linspace(1, 0, 17)
"""Normalised times, 1 to 0, at which the search for the peak speed of a piece starts.

A speed has at most three extremes. The end is first, so that a constant speed is reported at the end.
"""
_APART = 1 / 16
"""Distance between two of the times in `_SHARES`."""
_STEPS = 3
"""Iterations of Newton's method for a peak speed. Each doubles the correct digits; a cubic needs only one."""


class SplineSample:
    """Desired state of the joints at one time: position (rad), velocity and acceleration, each of shape
    (joints,).
    """

    def __init__(self, joints: int) -> None:
        self.rows = np.zeros((3, joints))
        self.position, self.velocity, self.acceleration = self.rows

    def rest_at(self, position: Floats) -> None:
        """Set the state to rest at a position."""
        self.rows.fill(0.0)
        np.copyto(self.position, position)


def solve(
    order: int,
    duration: float | Floats,
    start: Sequence[Floats] | Floats,
    end: Sequence[Floats] | Floats,
    out: Floats,
) -> None:
    """Write the coefficients of a polynomial piece between two states into `out`.

    Args:
        order: LINEAR, CUBIC or QUINTIC. A linear piece ignores velocities, and only a quintic one uses
            accelerations.
        duration: s, above 0; one number or one per joint.
        start: Position, velocity and acceleration at the start.
        end: Position, velocity and acceleration at the end.
        out: Output, shape (order, joints).
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


def peak_velocities(piece: Floats, duration: float | Floats) -> tuple[Floats, Floats]:
    """Return the peak velocity of each piece, rad/s, and its time from the start of the piece, s.

    The velocity of a cubic piece is a parabola, and that of a quintic piece a quartic. Newton's method
    refines the largest of some samples.

    Args:
        piece: Coefficients, shape (order, pieces).
        duration: s; one number or one per piece.
    """
    order = len(piece)
    powers = np.asarray(duration, dtype=np.float64) ** np.arange(order - 1)[:, None]
    speed = piece[1:] * np.arange(1, order)[:, None] * powers  # polynomial of the normalised time 0..1
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
    """Return the peak velocity, its time (s) and its piece (from 0) of each joint of a flat trajectory.

    The list is empty for a trajectory of one point, because the start of the motion is unknown.
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
    """Return velocities at the points, shape (points, joints), with which cubic pieces do not overshoot.

    F. N. Fritsch, J. Butland, "A method for constructing local monotone piecewise cubic interpolants", SIAM
    Journal on Scientific and Statistical Computing 5, 1984. Both ends use the three-point formula of C.
    Moler, Numerical Computing with MATLAB (2004), section 3.6.

    Args:
        times: s, increasing, shape (points,).
        positions: rad, shape (points, joints).
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
    """Return a trajectory as the flat array that `Trajectory.load` expects.

    Args:
        orders: Order of each point: LINEAR with a position only, CUBIC with a velocity, QUINTIC with an
            acceleration. A piece has the lower order of its two ends.
        times: s, increasing, shape (points,).
        points: Position, velocity and acceleration, shape (points, 3, joints).
        start_in: Time from loading to time 0 of the points, s.
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
    """Return the number of elements of the flat trajectory with which `data` starts; other values may
    follow.
    """
    count, joints, order = map(int, data[:START_IN].tolist())
    return _HEAD + count + 6 * joints + (count - 1) * order * joints


def whole_turns(data: Floats, now: Floats, wrap: NDArray[np.bool_]) -> Floats:
    """Return a flat trajectory with wrapping joints shifted by whole turns.

    Their first point is then within half a turn of `now`.

    Args:
        data: Flat trajectory. It is returned as it is if no joint needs a shift.
        now: Present position, rad, shape (joints,).
        wrap: True for each joint that may be shifted.
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
    """Trajectory being played: a bridge from the present state to the first point, then the pieces.

    `load` and `join` keep views of the flat array, so the loop allocates no memory that stays.
    """

    def __init__(self, joints: int) -> None:
        self._bridge = np.zeros((QUINTIC, joints))
        self.bridge_s = 0.0
        """Time from `load` or `join` to the end of the bridge, s."""
        self._start_in = 0.0
        self._times = np.zeros(1)
        self._first = self._last = np.zeros((3, joints))
        self._pieces = np.zeros((0, LINEAR, joints))
        self._on_bridge, self._on_piece = Polynomial(QUINTIC, joints), Polynomial(QUINTIC, joints)
        """The bridge, and the current piece, valid from `_begin_s` to `_end_s` of the points' time."""
        self._begin_s = self._end_s = 0.0
        self._tail = StopTrajectory(joints)
        self._tail_s = 0.0
        """Time from `load` or `join` to the start of the stop after the last point, s."""
        self._joined = SplineSample(joints)
        self.duration_s = 0.0
        """Time from `load` or `join` until all joints are at rest, s."""

    def load(self, data: Floats, now: SplineSample, waited_s: float = 0.0) -> None:
        """Start a flat trajectory from the present state.

        From rest, the bridge has the same order as the pieces. From a motion it is quintic, so that velocity
        and acceleration are continuous at both ends.

        Args:
            data: Flat trajectory.
            now: Present desired state.
            waited_s: Part of `start_in` that has already passed, s.
        """
        order = self._set_views(data, float(data[START_IN]) - waited_s)
        self.bridge_s = self._start_in + float(self._times[0])
        self.duration_s = self._tail_s = self._start_in + float(self._times[-1])
        if self.bridge_s > 0:
            start = (now.position, now.velocity, now.acceleration)
            if now.velocity.any() or now.acceleration.any():
                solve(QUINTIC, self.bridge_s, start, self._beginning(order), self._bridge)
            else:
                solve(order, self.bridge_s, start, self._first, self._bridge[:order])
            self._on_bridge.set_piece(self._bridge)

    def join(
        self, data: Floats, now: SplineSample, late_s: float, blend_s: float, limits: SplineLimits
    ) -> bool:
        """Start a flat trajectory in its middle.

        A quintic bridge leads into it. The bridge takes `blend_s`, or longer to keep the speed limits. After
        the last point the joints come to rest.

        Args:
            data: Flat trajectory.
            now: Present desired state.
            late_s: Part of the points' time that has already passed, s.
            blend_s: Shortest duration of the bridge, s.
            limits: Limits of the bridge's speed and of the stop.

        Returns:
            False if all points are in the past.
        """
        self._set_views(data, -late_s)
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
        self._on_bridge.set_piece(self._bridge)
        self.bridge_s, self._tail_s = bridge_s, max(end_s, bridge_s)
        if bridge_s < end_s:
            self._sample_points(end_s, joined)
        self._tail.load(joined, limits.deceleration, limits.lower, limits.upper)
        self.duration_s = self._tail_s + self._tail.duration_s
        return True

    def _set_views(self, data: Floats, start_in: float) -> int:
        """Set the views of a flat trajectory, discard the last bridge, and return the order of the pieces."""
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
        """Return position, velocity and acceleration of the trajectory at its first point."""
        if len(self._pieces):
            first = self._pieces[0]
            return first[0], first[1], first[2] * 2.0 if order > LINEAR else np.zeros_like(first[0])
        velocity, acceleration = self._first[1] * (order > LINEAR), self._first[2] * (order > CUBIC)
        return self._first[0], velocity, acceleration

    @property
    def end_position(self) -> Floats:
        """Position of the joints at the last point, rad."""
        position: Floats = self._last[0]
        return position

    def bridge_speeds(self) -> Floats:
        """Return the highest speed of each joint on the bridge, rad/s."""
        speeds: Floats = np.abs(peak_velocities(self._bridge, self.bridge_s)[0])
        return speeds

    def longest_steps(self, now: SplineSample, rows: NDArray[np.intp]) -> Floats:
        """Return the largest step from one point to the next, rad, for each joint of `rows` (indices).

        The step from `now` to the first point counts as well.
        """
        starts = self._pieces[:, 0, rows]
        points = np.concatenate([[now.position[rows], self._first[0, rows]], starts, [self._last[0, rows]]])
        steps: Floats = np.abs(np.diff(points, axis=0)).max(axis=0)
        return steps

    def first_way(self, now: SplineSample) -> Floats:
        """Return the displacement of each joint from `now` to the first point, rad."""
        way: Floats = self._first[0] - now.position
        return way

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the desired state `t` s after `load` or `join` into `sample`; after the end the joints are
        at rest.
        """
        if t < self.bridge_s:
            np.copyto(sample.rows, self._on_bridge.evaluate(max(t, 0.0)))
        elif t < self._tail_s:
            self._sample_points(t, sample)
        elif t < self.duration_s:
            self._tail.sample(t - self._tail_s, sample)
        else:
            sample.rest_at(self._last[0] if self._tail_s == self.duration_s else self._tail.end)

    def _sample_points(self, t: float, sample: SplineSample) -> None:
        """Write the state of the points, without bridge and stop, `t` s after `load` or `join` into
        `sample`.
        """
        if not len(self._pieces):
            np.copyto(sample.rows, self._first)
            return
        t -= self._start_in
        if not self._begin_s <= t < self._end_s:
            index = max(min(int(self._times.searchsorted(t, side="right")), len(self._pieces)) - 1, 0)
            self._begin_s, self._end_s = float(self._times[index]), float(self._times[index + 1])
            self._on_piece.set_piece(self._pieces[index])
        np.copyto(sample.rows, self._on_piece.evaluate(t - self._begin_s))


class SplineLimits(msgspec.Struct, frozen=True):
    """Limits of joints on the bridge into a trajectory and in the stop after it, each of shape (joints,)."""

    speed: Floats
    """Highest speed, rad/s."""
    deceleration: Floats
    """Deceleration of the stop, rad/s^2."""
    lower: Floats
    upper: Floats
    """Upper position limit, rad; `lower` is the lower one."""


class StopTrajectory:
    """Stop of joints. Each decelerates at a constant rate from its own velocity.

    The stop takes |v| / a and the distance |v|**2 / (2 a), as in joint_trajectory_controller of
    ros2_controllers on cancel (docs.ros.org, joint_trajectory_controller, "Decelerate on cancel"). If a
    position limit is closer than that, the deceleration rises to v**2 / (2 distance to the limit), because
    the position limit has priority.
    """

    def __init__(self, joints: int) -> None:
        self._duration, self.end, self._pull = np.zeros((3, joints))
        self.duration_s = 0.0
        """Time from `load` until all joints are at rest, s."""

    def load(self, now: SplineSample, deceleration: Floats, lower: Floats, upper: Floats) -> None:
        """Start a stop from the position and velocity of `now`.

        Args:
            now: Present desired state.
            deceleration: rad/s^2, shape (joints,).
            lower: Lower position limit, rad, shape (joints,).
            upper: Upper position limit, rad, shape (joints,).
        """
        speed = np.abs(now.velocity)
        room = np.where(now.velocity > 0, upper - now.position, now.position - lower)
        needed = np.divide(speed * speed, 2.0 * room, out=np.full_like(room, np.inf), where=room > 0)
        needed = np.maximum(needed, deceleration)
        self._duration = speed / needed
        # A joint that stops at once has no deceleration phase.
        self._pull = np.where(self._duration > 0, np.copysign(needed, now.velocity), 0.0)
        self.end = now.position + now.velocity * self._duration / 2.0
        self.duration_s = float(self._duration.max(initial=0.0))

    def sample(self, t: float, sample: SplineSample) -> None:
        """Write the state of the stopping joints, `t` s after `load`, into `sample`."""
        left = np.maximum(self._duration - t, 0.0)
        np.multiply(self._pull, left, out=sample.velocity)
        np.add(sample.velocity * left * -0.5, self.end, out=sample.position)
        np.negative(self._pull * np.sign(left), out=sample.acceleration)
