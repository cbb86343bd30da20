"""Longest gap between commands: a smooth motion is sampled and sent with increasing gaps.

The thesis names it as future work: the longest delay without an unwanted deviation. A joint that is commanded
by position moves to each sample as fast as it can and waits there. With posvel it moves to the sample at the
commanded speed, and brakes before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_lab.characterize.joint_figure import JointFigure, not_measured
from dxlrun_lab.characterize.trace import Trace

MOTION_S = math.pi
"""Period of the thesis' motion, 0.5 (sin 2t - sin 4t), s"""
FADE_S = 0.5
"""Time in which the motion fades in, s. Deviations are judged after that."""
LARGEST = 1.7602
"""Maximum of |sin 2t - sin 4t|"""
FASTEST = 6.0
"""Peak speed of the motion per rad of its size, rad/s"""
_STILL_TICKS = 1.5
"""A joint that travels less than this while the motion travels `_MOVES_TICKS` counts as at rest, ticks."""
_MOVES_TICKS = 8.0
_STILL_PART = 0.15
"""The same limit for the joint as a fraction of the travel of the motion"""
_BETWEEN = 0.03
"""Relative distance between the best and the worst gap at which the search ends"""


def motion(time: Floats, size: float) -> tuple[Floats, Floats]:
    """Return position (rad) and speed (rad/s) of the thesis' motion at times (s): `size` (sin 2t - sin 4t).

    The motion fades in from rest, but does not fade out.
    """
    fade = np.clip(time / FADE_S, 0.0, 1.0)
    shape, slope = fade * fade * (3 - 2 * fade), 6 * fade * (1 - fade) / FADE_S
    position = np.sin(2 * time) - np.sin(4 * time)
    speed = 2 * np.cos(2 * time) - 4 * np.cos(4 * time)
    return size * shape * position, size * (shape * speed + slope * position)


class GapResult(msgspec.Struct, frozen=True):
    """Result of one motion that was sent with a gap between two commands"""

    gap_s: float
    """Time between two commands, s"""
    deviation: float
    """Largest deviation from the path with a command in each cycle, rad"""
    stood: bool
    """True if the joint came to rest while its motion continued"""

    def kept(self, tolerance: float) -> bool:
        """Return True if the deviation is within the tolerance, rad, and the joint did not rest."""
        return self.deviation <= tolerance and not self.stood


def judge_gap(gap_s: float, trace: Trace, reference: Trace, size: float) -> GapResult:
    """Compare a motion that was sent with gaps to the same motion that was sent in each cycle.

    The times of both traces start with the first goal of the motion; `size` is that of `motion`, rad.
    """
    time, since = trace.time, trace.time > FADE_S
    path = np.interp(time, reference.time, reference.position)
    deviation = float(np.max(np.abs(trace.position - path)[since], initial=0.0))
    ideal, speed = motion(reference.time, size)
    # The joint lags behind its motion, so the speed of the motion is shifted by this lag.
    lag = _lag(reference, ideal)
    going = np.abs(np.interp(time - lag, reference.time, speed))
    return GapResult(gap_s, deviation, _stood(trace, going, since))


def _lag(trace: Trace, ideal: Floats) -> float:
    """Return the time by which the joint lags behind the ideal positions of its motion, 0 to 0.3 s."""
    shifts = np.linspace(0.0, 0.3, 61)
    middle = trace.position - trace.position.mean()
    off = [float(np.sum((middle - np.interp(trace.time - s, trace.time, ideal)) ** 2)) for s in shifts]
    return float(shifts[int(np.argmin(off))])


def _stood(trace: Trace, going: Floats, since: NDArray[np.bool_]) -> bool:
    """Return True if the joint rested while its motion continued. `going` is the motion's speed, rad/s."""
    fast = going > 0.3 * float(np.max(going, initial=0.0))
    way = np.concatenate(([0.0], np.cumsum(going[1:] * np.diff(trace.time))))
    ends = np.searchsorted(way, way + _MOVES_TICKS * trace.tick)
    for at, end in enumerate(ends.tolist()):
        if end >= len(trace) or end - at < 3 or not (since[at] and fast[at : end + 1].all()):
            continue
        moved = np.ptp(trace.position[at : end + 1])
        if moved <= max(_STILL_TICKS * trace.tick, _STILL_PART * (way[end] - way[at])):
            return True
    return False


def following(
    tried: Sequence[GapResult], shortest: float, longest: float, step: float, tolerance: float
) -> float | None:
    """Return the gap to try next, s, a multiple of `step`, or None at the end of the search.

    Gaps from `shortest` to `longest` grow by half until the joint leaves its path by more than `tolerance`,
    rad. A bisection follows.
    """
    kept = [round(gap.gap_s / step) for gap in tried if gap.kept(tolerance)]
    bad = min((round(gap.gap_s / step) for gap in tried if not gap.kept(tolerance)), default=0)
    least = max(1, round(shortest / step))
    good, most = max(kept, default=least), max(least + 1, round(longest / step))
    if bad:
        return (good + bad) // 2 * step if bad - good > max(1, round(_BETWEEN * good)) else None
    if good >= most:
        return None
    return min(max(good + 1, math.ceil(good * 1.5) if kept else 0), most) * step


def longest_gap(
    tried: list[GapResult],
    interface: Literal["position", "posvel"],
    tolerance: float,
    shortest: float,
    speed: float,
    *,
    tick: float = 0.0,
) -> JointFigure:
    """Return the figure of the longest gap with which the joint stays on its path, between two tried gaps.

    Args:
        tried: Results in increasing order of their gaps.
        interface: Interface of the commands.
        tolerance: Largest deviation, rad.
        shortest: Gap of the reference, s.
        speed: Peak speed of the motion, rad/s.
        tick: Resolution of the position, rad.
    """
    name = f"longest gap, {interface}"
    degrees = f"{math.degrees(tolerance):.2g} deg"
    how = f"sum of two sines at up to {speed:.2g} rad/s, {len(tried)} gaps; tolerance {degrees}"
    if not tried:
        return not_measured(name, "s", "no gap was tried", how)
    bad = [gap for gap in tried if not gap.kept(tolerance)]
    if not bad:
        most = f"{tried[-1].gap_s * 1e3:.0f} ms"
        why = f"the joint stayed within {degrees} at the longest tried gap, {most}"
        return not_measured(name, "s", why, how)
    first = bad[0]
    kept = [gap for gap in tried if gap.gap_s < first.gap_s]
    below_s, below = (kept[-1].gap_s, kept[-1].deviation) if kept else (shortest, 0.0)
    half = (first.gap_s - below_s) / 2
    if not kept:
        why = f"the joint leaves its path at the shortest tried gap, {first.gap_s * 1e3:.1f} ms"
        return not_measured(name, "s", why, how)
    if first.stood and first.deviation <= tolerance:
        return JointFigure(
            name, "s", below_s + half, half, None, len(tried), how, "the joint stops between commands"
        )
    # Interpolate, because the deviation grows with the gap.
    part = (tolerance - below) / (first.deviation - below)
    limit = (
        f"the joint leaves its path by {math.degrees(first.deviation):.2g} deg at {first.gap_s * 1e3:.0f} ms"
    )
    # A deviation is the difference of two positions that are rounded to ticks.
    coarse = tick * 2 * half / (first.deviation - below)
    # The deviation may grow anywhere between the two gaps.
    uncertainty = math.hypot(2 * half * max(part, 1 - part), coarse)
    return JointFigure(name, "s", below_s + part * 2 * half, uncertainty, None, len(tried), how, limit)
