"""Top speed, acceleration and braking, from moves as long as the range allows.

The thesis' step tests (Figures 19 and 20) moved from -1 rad to +1 rad. Speeds are slopes of the positions,
because the manuals do not document the filter on a servo's reported speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun_lab.characterize.joint_figure import JointFigure, mean_of, not_measured
from dxlrun_lab.characterize.response import LEAST_TICKS, StepResponse
from dxlrun_lab.characterize.trace import crossing, polynomial, slopes

TOP, ACCELERATION, BRAKING = "top speed", "acceleration", "braking"
RISE = 0.2, 0.8
"""Fractions of the highest speed between which acceleration and braking are measured"""
_CRUISE = 0.95
"""Fraction of the highest speed above which a joint counts as cruising"""
_FOLLOWS = 0.015
"""If the cruise differs from the goal's speed by less than this fraction, the goal limits it."""
_SLOPE_NOISE = 0.01
"""Allowed scatter of a speed by the ticks of positions, as a fraction of the top speed"""
_LEAST_SAMPLES, _MOST_SAMPLES = 5, 41
"""Smallest and largest number of positions from which a speed is found"""
_ROOM = 1.3
"""Safety factor on the range of motion that is recommended to reach the top speed"""


class Move(msgspec.Struct, frozen=True):
    """Speeds of one long move of a joint; the joint cruises while it is nearly as fast as at its peak"""

    time: Floats
    """Time since the goal's packet, s"""
    speed: Floats
    """Speed at each time, rad/s, positive towards the goal"""
    highest: float
    """Mean speed of the cruise, or the peak without one, rad/s"""
    cruised_s: float
    """Duration of the cruise, s"""
    cruised: bool
    """True if the joint cruised for at least as long as it accelerated, so that `highest` is its top speed"""
    rise_s: float
    """Time of acceleration between the fractions `RISE` of the highest speed, s; NaN if not seen"""
    fall_s: float
    """Time of braking between these fractions, s; NaN if not seen"""
    drift: float
    """Half of the speed difference between the two halves of the cruise, rad/s"""
    half_width_s: float
    """Half-width of the window of positions from which each speed is found, s"""
    follows: bool
    """True if the joint was exactly as fast as its goal, so the servo may be faster"""


def move_of(step: StepResponse) -> Move | None:
    """Evaluate the recording of a long move. Return None if the joint hardly moved."""
    way, tick = step.way, step.tick
    total = float(np.max(way))
    if total < LEAST_TICKS * tick:
        return None
    period = float(np.median(np.diff(step.time)))
    rough = float(np.nanmax(slopes(step.time, way, 2.5 * period)))
    half_width = _half_width(period, tick, rough)
    speed = np.nan_to_num(slopes(step.time, way, half_width))
    peak_at = int(np.argmax(speed))
    slower = np.flatnonzero(speed < _CRUISE * speed[peak_at])
    first = int(slower[slower < peak_at].max(initial=-1)) + 1
    last = int(slower[slower > peak_at].min(initial=len(speed))) - 1
    stretch = slice(first, last + 1)
    highest, cruised_s = float(speed[peak_at]), float(step.time[last] - step.time[first])
    goal_speed = drift = 0.0
    if last - first >= _LEAST_SAMPLES:
        highest = float(polynomial(step.time[stretch], way[stretch], 1)[0])
        goal_speed = float(polynomial(step.time[stretch], step.goal[stretch], 1)[0])
        middle = (first + last) // 2
        halves = [
            polynomial(step.time[a:b], way[a:b], 1)[0] for a, b in ((first, middle), (middle, last + 1))
        ]
        drift = abs(float(halves[1] - halves[0])) / 2
    low, high = (part * highest for part in RISE)
    rising, falling = slice(0, peak_at + 1), slice(peak_at, None)
    rise = crossing(step.time[rising], speed[rising], high) - crossing(step.time[rising], speed[rising], low)
    behind, fading = -step.time[falling][::-1], speed[falling][::-1]
    fall = crossing(behind, fading, high) - crossing(behind, fading, low)
    return Move(
        step.time,
        speed,
        highest,
        cruised_s,
        cruised_s >= rise,
        rise if rise > 0 else math.nan,
        fall if fall > 0 else math.nan,
        drift,
        half_width,
        abs(goal_speed / highest - 1) < _FOLLOWS,
    )


def _half_width(period: float, tick: float, speed: float) -> float:
    """Return the half-width, s, of the window of positions from which a speed (rad/s) is found. It is the
    shortest one that keeps the scatter by the tick (rad) below _SLOPE_NOISE."""
    for count in range(_LEAST_SAMPLES, _MOST_SAMPLES, 2):
        scatter = tick / math.sqrt(12) / (period * math.sqrt(count * (count**2 - 1) / 12))
        if scatter <= _SLOPE_NOISE * speed:
            return count // 2 * period
    return _MOST_SAMPLES // 2 * period


def speeds(
    steps: Sequence[StepResponse], range_rad: float, own_speed: float
) -> tuple[JointFigure, JointFigure, JointFigure]:
    """Return three figures: top speed, acceleration and braking.

    Args:
        steps: Long moves.
        range_rad: Range of the joint in the experiment, rad.
        own_speed: Speed in the model's manual, rad/s, for the recommendation of a range.
    """
    how = f"{len(steps)} moves of {math.degrees(max((s.height for s in steps), default=0.0)):.3g} deg"
    moves = [move for step in steps if (move := move_of(step)) is not None]
    units = {TOP: "rad/s", ACCELERATION: "rad/s^2", BRAKING: "rad/s^2"}
    if len(moves) < max(2, len(steps) // 2):
        why = "the joint hardly moved" if steps else "no move started at rest"
        top, faster, slower = (not_measured(name, unit, why, how) for name, unit in units.items())
        return top, faster, slower
    period = float(np.median(np.diff(steps[0].time)))
    return (
        _top(moves, range_rad, own_speed, how),
        _change(ACCELERATION, moves, [move.rise_s for move in moves], period, how),
        _change(BRAKING, moves, [move.fall_s for move in moves], period, how),
    )


def _top(moves: Sequence[Move], range_rad: float, own_speed: float, how: str) -> JointFigure:
    cruising = [move for move in moves if move.cruised]
    if len(cruising) < max(2, len(moves) // 2):
        fastest = float(np.median([move.highest for move in moves]))
        needed = _needed_range(moves, own_speed)
        why = (
            f"the range of {math.degrees(range_rad):.0f} deg is too small: the joint reached "
            f"{fastest:.3g} rad/s, but no constant speed; give a range of about {needed:.0f} deg"
            if needed is not None
            else f"the joint reached {fastest:.3g} rad/s, but no constant speed within a move"
        )
        return not_measured(TOP, "rad/s", why, how)
    limit = ""
    if sum(move.follows for move in cruising) > len(cruising) // 2:
        limit = "the goal's own speed: see limits.velocity, and Moving Speed or Profile Velocity"
    drift = float(np.median([move.drift for move in cruising]))
    return mean_of(TOP, "rad/s", [move.highest for move in cruising], drift, how, limit)


def _needed_range(moves: Sequence[Move], own_speed: float) -> float | None:
    """Return the range of motion in which the joint would reach its top speed, deg; None if unknown."""
    whole = [move for move in moves if math.isfinite(move.rise_s + move.fall_s)]
    if not whole:
        return None
    highest = float(np.median([move.highest for move in whole]))
    part = RISE[1] - RISE[0]
    gain = part * highest / float(np.median([move.rise_s for move in whole]))
    loss = part * highest / float(np.median([move.fall_s for move in whole]))
    speed = max(own_speed, highest)
    if not math.isfinite(speed):
        speed = 2 * highest
    needed = speed**2 / (2 * gain) + speed**2 / (2 * loss) + speed * part * speed / gain
    return math.ceil(math.degrees(_ROOM * needed) / 10) * 10


def _change(name: str, moves: Sequence[Move], times: Sequence[float], period: float, how: str) -> JointFigure:
    """Return the figure of acceleration or braking (`name`), rad/s^2, from each move's time (s) between the
    fractions `RISE` of its highest speed."""
    part = RISE[1] - RISE[0]
    known = [(move.highest, time) for move, time in zip(moves, times, strict=True) if math.isfinite(time)]
    if len(known) < max(2, len(moves) // 2):
        return not_measured(name, "rad/s^2", "the start or end of the change was not recorded", how)
    median = float(np.median([time for _, time in known]))
    if median < 1.5 * period:
        why = f"it takes less than {1.5 * period * 1e3:.1f} ms, too short for the read rate"
        return not_measured(name, "rad/s^2", why, how)
    values = [part * speed / time for speed, time in known]
    # The window of a slope smooths quick changes. Inside a ramp it shifts both crossings alike.
    resolution = (
        float(np.mean(values)) * 0.2 * float(np.median([move.half_width_s for move in moves])) / median
    )
    low, high = (round(100 * one) for one in RISE)
    speed = float(np.median([speed for speed, _ in known]))
    return mean_of(name, "rad/s^2", values, resolution, f"{how}, from {low} to {high} % of {speed:.3g} rad/s")
