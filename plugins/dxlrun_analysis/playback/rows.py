"""Rows of a recorded motion for playback on a robot: positions of all joints for each period of its loop."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Self

import msgspec
import numpy as np

from dxlrun import InputError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.plans import JointPlan
from dxlrun_analysis.playback.recorded_motion import Floats, RecordedMotion
from dxlrun_analysis.playback.spline_path import SplinePath, fit, tolerances

LEAST_SPEED, MOST_SPEED = 0.01, 10.0  # Factors on a motion's speed, as in `dxlrun play`
MOST_NUMBERS = 500_000  # Numbers in all rows: the most that a sample_player keeps of one table
LONGEST_PERIOD_S = 0.02  # Longest time between rows, if one row per cycle would be too many
WINDOW_S = 0.05  # Interval over which speeds and accelerations are measured
RAMP_S = 0.3
"""Time in which the speed of a played motion ramps up from 0 at the start and down to 0 at the end."""


class PlaybackRows(msgspec.Struct, frozen=True, eq=False):
    """Table of positions that plays a motion at a given speed, which ramps up from 0 and down to 0."""

    motion: RecordedMotion
    speed: float
    period_s: float
    at_s: Floats  # Shape (rows,)
    recorded_s: Floats  # Time in the motion of each row
    positions: Floats  # Shape (rows, joints), rad (m for linear joints)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of the columns."""
        return self.motion.joints

    @property
    def duration_s(self) -> float:
        """Duration of the playback, s."""
        return len(self.positions) * self.period_s

    @classmethod
    def from_motion(cls, motion: RecordedMotion, path: SplinePath, speed: float, period_s: float) -> Self:
        """Sample a motion's path at a speed factor into rows, without regard to the limits of joints. A
        long motion has several periods per row."""
        duration_s = path.duration_s
        ramp_s = min(RAMP_S, duration_s / speed)
        seconds = duration_s / speed + ramp_s
        most = MOST_NUMBERS // len(motion.joints)
        row_s = period_s * max(1, math.ceil(seconds / period_s / most))
        at_s = np.append(np.arange(0.0, seconds, row_s), seconds)
        left_s = seconds - at_s
        begin, end = speed * at_s**2 / (2 * ramp_s), duration_s - speed * left_s**2 / (2 * ramp_s)
        even = speed * (at_s - ramp_s / 2)
        recorded_s = np.where(at_s < ramp_s, begin, np.where(left_s < ramp_s, end, even))
        return cls(motion, speed, row_s, at_s, recorded_s, path.positions_at(recorded_s))


def rows_of(
    motion: RecordedMotion,
    joints: Mapping[str, JointPlan],
    *,
    speed: float,
    tolerance: float | None,
    period_s: float,
) -> PlaybackRows:
    """Return the rows of a motion for a robot, one per cycle of `period_s`, after a check of all limits.

    Args:
        motion: The recorded motion.
        joints: Plans of the robot's joints, by name.
        speed: Factor on the speed of the motion.
        tolerance: Tolerance of smoothing, rad; None: see spline_path. A position may exceed its limit by
            it and is clamped.
        period_s: Period of the loop.

    Raises:
        InputError: Every joint that the robot lacks, and everything beyond the joints' limits.
    """
    if not LEAST_SPEED <= speed <= MOST_SPEED:
        raise InputError(f"--speed {speed:g}: give a factor from {LEAST_SPEED:g} to {MOST_SPEED:g}")
    _check_joints(motion, joints)
    plans = [joints[name] for name in motion.joints]
    allowed = tolerances(motion, tolerance)
    path = fit(motion, allowed)
    played = PlaybackRows.from_motion(motion, path, speed, period_s)
    wrong = _all_beyond(plans, played, allowed)
    if wrong:
        enough = _slow_enough(plans, played, path, period_s, allowed)
        wrong += [f"write --speed {enough:g} to stay within all limits"] if enough else []
        raise InputError("\n".join(f"{motion.path}: {sentence}" for sentence in wrong))
    if played.period_s > max(LONGEST_PERIOD_S, period_s):
        most_s = MOST_NUMBERS // len(plans) * max(LONGEST_PERIOD_S, period_s)
        raise InputError(
            f"{motion.path}: {played.at_s[-1]:.0f} s of {len(plans)} joints are too long to play at once, at "
            f"most {most_s:.0f} s; choose a stretch by --from and --to"
        )
    for column, plan in enumerate(plans):
        if plan.bounded:
            held = played.positions[:, column]
            np.clip(held, plan.lower, plan.upper, out=held)
    return played


def _check_joints(motion: RecordedMotion, joints: Mapping[str, JointPlan]) -> None:
    known = tuple(joints)
    missing = [name for name in motion.joints if name not in joints]
    if missing:
        raise InputError(
            "\n".join(
                f"{motion.path}: the robot has no joint {name}; {suggestion(name, known)}; write "
                f"--map {name}=JOINT, or --map {name}= to omit it"
                for name in missing
            )
        )


def _all_beyond(plans: Sequence[JointPlan], played: PlaybackRows, allowed: Floats) -> list[str]:
    """Return a sentence for each joint and each quantity (position, speed, acceleration) beyond its limit,
    at the greatest excess."""
    return [
        f"at {played.motion.begin_s + played.recorded_s[row]:.3f} s {plan.name} {text}"
        for column, plan in enumerate(plans)
        for row, text in _beyond(plan, played.positions[:, column], played.period_s, allowed[column])
    ]


def _beyond(
    plan: JointPlan, positions: Floats, period_s: float, tolerance: float
) -> Iterator[tuple[int, str]]:
    """Yield row and sentence for each quantity of a joint that exceeds its limit so far that the joint errs
    by `tolerance`.

    Speeds and accelerations are averaged over WINDOW_S: shorter peaks do not move a joint off its path. The
    joint is at rest before and after the rows.
    """
    unit = plan.unit
    if plan.bounded:
        off = np.maximum(positions - plan.upper, plan.lower - positions)
        row = int(off.argmax())
        if off[row] > tolerance:
            limits = f"{plan.lower * unit.factor:.4g} to {plan.upper * unit.factor:.4g} {unit.shown}"
            where = f"{positions[row] * unit.factor:.4g} {unit.shown}"
            yield row, f"is at {where}, beyond its limits of {limits}"
    count = max(1, round(WINDOW_S / period_s))
    window_s = count * period_s
    path = np.pad(positions, count, mode="edge")
    velocity = (path[count:] - path[:-count]) / window_s
    row = int(np.abs(velocity).argmax())
    speed, most = abs(float(velocity[row])), plan.highest_speed
    if speed > most + tolerance / window_s:
        yield max(row - count, 0), f"moves at {speed:.4g} {unit.speed}, more than its {most:.4g} {unit.speed}"
    if plan.acceleration is None:
        return
    change = (velocity[count:] - velocity[:-count]) / window_s
    row = int(np.abs(change).argmax())
    rate, most = abs(float(change[row])), plan.acceleration
    if rate > most + tolerance / window_s**2:
        limit = f"{most:.4g} {unit.acceleration}"
        yield row, f"accelerates with {rate:.4g} {unit.acceleration}, more than its {limit}"


def _slow_enough(
    plans: Sequence[JointPlan], played: PlaybackRows, path: SplinePath, period_s: float, allowed: Floats
) -> float | None:
    """Return the highest lower speed factor at which no limit is exceeded, in steps of 0.01, or None."""
    low, high = 0, math.ceil(played.speed * 100)
    while high - low > 1:
        middle = (low + high) // 2
        if _all_beyond(plans, PlaybackRows.from_motion(played.motion, path, middle / 100, period_s), allowed):
            high = middle
        else:
            low = middle
    return low / 100 if low else None
