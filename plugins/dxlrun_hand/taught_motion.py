"""Taught motion: poses and motions that the user showed by hand, joined to one motion within limits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from dxlrun import JointUnit
from dxlrun.tooling.plans import ControllerPlan
from dxlrun_analysis.playback.motion_file import motion_file
from dxlrun_analysis.playback.recorded_motion import Floats, RecordedMotion, What
from dxlrun_analysis.playback.spline_path import TURN_SIZES, fit, tolerances

MOVED_RAD = np.radians(1.0)
"""Movement below which a joint stands still, rad; for a linear joint multiplied by its `TURN_SIZES`."""
REST_S = 0.2
"""Standstill that is kept at both ends, so that a motion begins and ends at rest, s."""
WINDOW_S = 0.2
"""Averaging window of positions, s: a hand trembles at 8 to 12 Hz (R. J. Elble, "Physiologic and essential
tremor", Neurology 36, 1986)."""
LEAST_WAY_S = 0.5  # Shortest transition between two parts
_STEP_S = 0.01  # Sampling interval of a smoothed motion
_SPARE = 0.9
"""Fraction of a joint's speed limit that a taught motion uses at most."""


class TaughtMotion(msgspec.Struct, frozen=True, eq=False):
    """Recorded positions of one pose or motion that the user showed by hand."""

    time_s: Floats
    """Times of the samples, s, shape (moments,), from 0; a single moment is a pose."""
    position: Floats
    """Positions of the taught joints, rad or m, shape (moments, joints)."""


class TaughtJoints(msgspec.Struct, frozen=True):
    """Joints of a taught motion with their limits, and the processing of what the user showed."""

    joints: tuple[str, ...]
    units: tuple[JointUnit, ...]
    lower: Floats
    """rad or m by joint; infinite without a limit, as in `upper` and `speed`"""
    upper: Floats
    speed: Floats
    way_speed: float
    """Speed of the transition from one pose to the next, rad/s of a rotary joint"""

    @property
    def size(self) -> Floats:
        """Movement of each joint that counts as much as 1 rad of a rotary joint, rad or m."""
        return np.array([TURN_SIZES[unit] for unit in self.units])

    def trimmed(self, shown: TaughtMotion) -> TaughtMotion:
        """Return a motion without the standstill at both ends. A motion that never moves becomes a pose."""
        time, position = shown.time_s, shown.position
        still = MOVED_RAD * self.size
        begun = np.flatnonzero((np.abs(position - position[0]) > still).any(axis=1))
        if not len(begun):
            return TaughtMotion(np.zeros(1), position[-1:])
        left = np.flatnonzero((np.abs(position - position[-1]) > still).any(axis=1))
        kept = (time >= time[begun[0]] - REST_S) & (time <= time[left[-1]] + REST_S)
        return TaughtMotion(time[kept] - time[kept][0], position[kept])

    def smoothed(self, shown: TaughtMotion) -> TaughtMotion:
        """Return a motion at equal steps, smoothed with a Hann window."""
        count = round(float(shown.time_s[-1]) / _STEP_S) + 1
        if count < 3:
            return TaughtMotion(np.zeros(1), shown.position[-1:])
        time = np.arange(count, dtype=np.float64) * _STEP_S
        half = round(WINDOW_S / _STEP_S / 2)
        weights = np.hanning(2 * half + 3)[1:-1]
        weights /= weights.sum()
        columns = [
            np.convolve(
                np.pad(np.interp(time, shown.time_s, column), half, mode="edge"), weights, mode="valid"
            )
            for column in shown.position.T
        ]
        return TaughtMotion(time, np.array(columns, np.float64).T)

    def joined(self, parts: Sequence[TaughtMotion], path: Path) -> RecordedMotion:
        """Join poses and motions to one motion, clipped to the limits, with transitions between them.

        `path` is the motion file that it will have.
        """
        times, positions = [0.0], [self._within(parts[0].position[0])]
        for part in parts:
            inside = self._within(part.position)
            begin = times[-1] + (REST_S if part is parts[0] else self._way_s(positions[-1], inside[0]))
            times += (begin + part.time_s).tolist()
            positions += list(inside)
        times.append(times[-1] + REST_S)
        positions.append(positions[-1])
        states: list[What] = ["states" for _ in self.joints]
        return RecordedMotion(
            path, self.joints, tuple(states), np.array(times), np.array(positions), 0.0, self.units
        )

    def slowed(self, motion: RecordedMotion) -> tuple[RecordedMotion, float]:
        """Return a motion slowed to the speed limits of all joints, and the factor of its duration."""
        fastest = np.abs(fit(motion, tolerances(motion, None)).velocity).max(axis=0)
        longer = max(1.0, float((fastest / (_SPARE * self.speed)).max()))
        return replace(motion, time_s=motion.time_s * longer), longer

    def beyond(self, parts: Sequence[TaughtMotion]) -> list[str]:
        """Return the joints that the user moved beyond their position limits."""
        positions, slack = np.concatenate([part.position for part in parts]), MOVED_RAD * self.size
        out = ((positions < self.lower - slack) | (positions > self.upper + slack)).any(axis=0)
        return [joint for joint, is_out in zip(self.joints, out, strict=True) if is_out]

    def _within(self, position: Floats) -> Floats:
        return np.clip(position, self.lower, self.upper)

    def _way_s(self, begin: Floats, end: Floats) -> float:
        speed = np.minimum(self.way_speed * self.size, _SPARE * self.speed)
        return max(LEAST_WAY_S, float((np.abs(end - begin) / speed).max()))

    def text_of(self, motion: RecordedMotion, plans: Sequence[ControllerPlan], origin: str) -> str:
        """Return the YAML text of a motion file that the active controllers of `plans` play.

        `origin` is the comment at its top.
        """
        allowed = tolerances(motion, None)
        speeds = dict(zip(self.joints, self.speed.tolist(), strict=True))
        return motion_file(motion, allowed, motion.path, None, origin, plans=plans, speeds=speeds).text
