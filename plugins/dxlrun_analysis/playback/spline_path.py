"""Spline path: a recorded motion as a few knots with cubic pieces between them, within a tolerance.

Noise and quantization steps below the tolerance disappear, so that speeds and accelerations are those of the
motion. Knots are added where the path is farthest from the recording, until it is within the tolerance
everywhere. The velocities at the knots come from a parabola through three knots. They are limited to values
that keep a piece between its ends (F. N. Fritsch, R. E. Carlson, "Monotone Piecewise Cubic Interpolation",
SIAM J. Numer. Anal. 17, 1980), with half the tolerance as margin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import LINEAR, ROTARY, JointUnit
from dxlrun_analysis.playback.recorded_motion import Floats, RecordedMotion

GOAL_TOLERANCE = math.radians(0.1)
TURN_SIZES: Mapping[JointUnit, float] = {ROTARY: 1.0, LINEAR: 0.01}
"""Movement of a joint that counts as much as 1 rad, by unit: 1 rad, or 10 mm of a linear joint, as of a
pinion with this radius. [i]"""
STATE_TOLERANCE = math.radians(0.5)
"""Default tolerance of a path for measured positions: more than half a unit of the coarsest encoder, an
AX-12A's with 0.29 deg."""
_OVERSHOOT = 27 / 8
"""A cubic piece of length L with slope v at one end and otherwise flat overshoots by 4/27 v L. With v = 27/8
tolerance / L this is half the tolerance."""


class SplinePath(msgspec.Struct, frozen=True, eq=False):
    """Smoothed motion of several joints: knots with cubic pieces between them."""

    time_s: Floats  # Shape (knots,), ascending, from 0
    position: Floats  # Shape (knots, joints), rad
    velocity: Floats  # Shape (knots, joints), rad/s

    @property
    def duration_s(self) -> float:
        """Time from the first knot to the last."""
        return float(self.time_s[-1])

    def positions_at(self, time_s: Floats) -> Floats:
        """Return the positions of all joints at the given times, shape (times, joints)."""
        knots, position = self.time_s, self.position
        piece = np.clip(np.searchsorted(knots, time_s, side="right") - 1, 0, len(knots) - 2)
        width = (knots[piece + 1] - knots[piece])[:, None]
        part = np.clip((time_s - knots[piece])[:, None] / width, 0.0, 1.0)
        begin, way = position[piece], position[piece + 1] - position[piece]
        first, last = self.velocity[piece] * width, self.velocity[piece + 1] * width
        found: Floats = begin + part * (
            first + part * (3 * way - 2 * first - last + part * (first + last - 2 * way))
        )
        return found


def tolerances(motion: RecordedMotion, given: float | None) -> Floats:
    """Return the tolerance of each joint for `fit`: `given` (rad), or the default for goals or states.

    The tolerance of a linear joint is in m: its movement for that angle (`TURN_SIZES`).
    """
    usual = [GOAL_TOLERANCE if what == "goals" else STATE_TOLERANCE for what in motion.what]
    found = np.array(usual) if given is None else np.full(len(motion.what), given)
    return found * [TURN_SIZES[unit] for unit in motion.units]


def fit(motion: RecordedMotion, tolerance: Floats) -> SplinePath:
    """Fit a path with few knots to a recorded motion, within `tolerance` at each recorded moment; rad or
    m, shape (joints,)."""
    times, positions = motion.time_s, motion.position
    chosen = np.zeros(len(times), dtype=np.bool_)
    chosen[[0, -1]] = True
    while True:
        knots = np.flatnonzero(chosen)
        path = SplinePath(times[knots], positions[knots], _velocities(times, positions, knots, tolerance))
        off = (np.abs(path.positions_at(times) - positions) / tolerance).max(axis=1)
        off[knots] = 0.0
        if off.max() <= 1.0:
            return path
        # Add the worst moment of each piece that exceeds the tolerance.
        piece = np.clip(np.searchsorted(knots, np.arange(len(times)), side="right") - 1, 0, len(knots) - 2)
        worst = np.maximum.reduceat(off, knots[:-1])
        chosen[(off == worst[piece]) & (off > 1.0)] = True


def _velocities(times: Floats, positions: Floats, knots: NDArray[np.intp], tolerance: Floats) -> Floats:
    width = np.diff(times[knots])[:, None]
    slope = np.diff(positions[knots], axis=0) / width
    found = np.zeros((len(knots), positions.shape[1]))
    before, after = width[:-1], width[1:]
    inner = (slope[:-1] * after + slope[1:] * before) / (before + after)
    same = slope[:-1] * slope[1:] > 0
    steepest = np.where(same, 3 * np.minimum(np.abs(slope[:-1]), np.abs(slope[1:])), 0.0)
    steepest += _OVERSHOOT * tolerance / np.maximum(before, after)
    found[1:-1] = np.clip(inner, -steepest, steepest)
    # Natural end conditions: no acceleration at either end.
    for end, near in ((0, 1), (-1, -2)):
        most = 3 * np.abs(slope[end]) + _OVERSHOOT * tolerance / width[end]
        found[end] = np.clip((3 * slope[end] - found[near]) / 2, -most, most) if len(knots) > 2 else slope[0]
    return found
