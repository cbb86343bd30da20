"""Dead band: distance from its goal at which a joint may rest, and smallest change of the goal that moves it.

A position is approached slowly from both sides, as for the reversal value of ISO 230-2, until the joint
rests. The joint stops short of the goal because of friction, the limited position gain, and the servo's
margin. After a reversal of the goal, the joint moves once the goal has changed by twice that distance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun_lab.characterize.joint_figure import JointFigure, mean_of, not_measured
from dxlrun_lab.characterize.trace import Trace, polynomial

NAME, REVERSAL = "dead band", "smallest change that moves it"
MARGINS = ("cw_compliance_margin", "ccw_compliance_margin")
"""Registers of a servo's own dead band, ticks: Compliance Margin (26, 27) of AX and RX"""
SLOW = math.radians(3.0)
"""Speed of the goal during an approach, rad/s"""
REST_S = 0.7
"""Time for which the goal rests at each place, s"""
_LOOK_S = 0.3
"""Time at the end of a rest in which the joint must not move, s"""
_FOLLOWED_TICKS = 4
"""Shortest motion of a joint that counts as following its goal, ticks"""
_LEAST_ROWS = 5
"""Smallest number of samples for the fit of a line to a motion"""
_MOVING = 0.5
"""Fraction of the goal's speed above which a joint counts as following it"""


class Approach(msgspec.Struct, frozen=True):
    """Rest of a joint after a slow approach to its goal"""

    upward: bool
    """True if the joint came from below"""
    short: float
    """Distance to the goal at rest, rad; positive if the joint stopped before the goal"""
    reversal: float
    """Change of the goal after the reversal at which the joint started to move, rad; NaN if not seen"""


def stops(places: Sequence[float], reach: float) -> list[float]:
    """Return goals, rad, at which to rest in turn, so that each place is approached from both sides.

    `reach` is the distance from which a place is approached, rad.
    """
    return [places[0], *(turn for place in places for turn in (place - reach, place, place + reach, place))]


def table(goals: Sequence[float], period: float) -> tuple[Floats, float]:
    """Return goals for each period, rad, which rest at `goals` and move slowly between, and their time, s."""
    pieces = [np.full(math.ceil(REST_S / period), goals[0])]
    for before, after in itertools.pairwise(goals):
        count = max(1, math.ceil(abs(after - before) / SLOW / period))
        pieces += [np.linspace(before, after, count + 1)[1:], np.full(math.ceil(REST_S / period), after)]
    rows: Floats = np.concatenate(pieces)
    return rows, len(rows) * period


def approaches(trace: Trace) -> list[Approach]:
    """Return the joint's rests in the recording of a `table`.

    Omitted are rests in which the joint still moved, or to which it did not follow its goal.
    """
    moving = np.diff(trace.goal) != 0
    edges = np.flatnonzero(moving)
    if not len(edges):
        return []
    gaps = np.diff(trace.time[edges]) > REST_S / 2
    starts = [int(edges[0]), *edges[1:][gaps].tolist()]
    ends = [*edges[:-1][gaps].tolist(), int(edges[-1])]
    found = []
    for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
        rest = slice(end + 1, starts[number + 1] + 1 if number + 1 < len(starts) else len(trace))
        standing = trace.time[rest] > trace.time[rest][-1] - _LOOK_S
        position = trace.position[rest][standing]
        if np.ptp(position) > 1.5 * trace.tick:  # it has not come to rest
            continue
        sign = math.copysign(1.0, trace.goal[end + 1] - trace.goal[start])
        if sign * (position.mean() - trace.position[start]) < _FOLLOWED_TICKS * trace.tick:
            continue  # its goal moved within its dead band
        short = sign * float(trace.goal[end + 1] - position.mean())
        reversal = math.nan
        if number + 1 < len(starts):
            end_of_rest = starts[number + 2] + 1 if number + 2 < len(starts) else len(trace)
            behind = trace.part(slice(starts[number + 1], end_of_rest))
            moves = ends[number + 1] + 2 - starts[number + 1]
            reversal = _reversal(behind, moves, sign, float(position.mean()))
        found.append(Approach(sign > 0, short, reversal))
    return found


def _reversal(trace: Trace, moves: int, sign: float, rest: float) -> float:
    """Return the change of the goal after a reversal at which the joint left its rest, rad; NaN if not seen.

    Args:
        trace: Samples of the goal's way back, and of the rest that follows.
        moves: Number of samples of the way back.
        sign: Direction of the approach, 1 or -1.
        rest: Position of the rest before the reversal, rad.
    """
    if moves < _LEAST_ROWS or sign * (trace.goal[moves - 1] - trace.goal[0]) > 0:
        return math.nan
    way, after = trace.part(slice(0, moves)), trace.part(slice(moves, None))
    left = np.flatnonzero(-sign * (way.position - rest) > 1.5 * trace.tick)
    if len(left) < _LEAST_ROWS or not len(after):
        return math.nan
    # The joint then moves as fast as the goal. Extrapolate its line back to the position of the rest.
    slope, offset = polynomial(way.time[left], way.position[left], 1)
    if abs(slope) < _MOVING * SLOW:
        return math.nan
    change = abs(float(np.interp((rest - offset) / slope, way.sent, way.goal)) - float(way.goal[0]))
    # A moving joint lags behind more than a resting one. Subtract this additional lag.
    late = way.time > way.time[-1] - _LOOK_S
    behind = np.abs(np.interp(way.time[late], way.sent, way.goal) - way.position[late]).mean()
    standing = after.time > after.time[-1] - _LOOK_S
    at_rest = np.abs(after.goal[standing] - after.position[standing]).mean()
    return change - max(0.0, float(behind - at_rest))


def dead_band(
    found: Sequence[Approach], tick: float, registers: Mapping[str, int], unit: float
) -> tuple[JointFigure, JointFigure]:
    """Return two figures: dead band to each side, and smallest change of the goal that moves the joint.

    Args:
        found: Rests of the joint.
        tick: Resolution of the position, rad.
        registers: Known registers of the servo.
        unit: Unit of a margin register, rad.
    """
    up = [one.short for one in found if one.upward]
    down = [one.short for one in found if not one.upward]
    how = f"{len(up)} stops from below and {len(down)} from above, at {math.degrees(SLOW):.0f} deg/s"
    if min(len(up), len(down)) < 2:
        why = "the joint did not follow its goal, or did not come to rest"
        return not_measured(NAME, "rad", why, how), not_measured(REVERSAL, "rad", why, how)
    halves = [(a + b) / 2 for a, b in zip(up, down, strict=False)]
    # The positions of both rests are rounded to ticks.
    band = mean_of(NAME, "rad", halves, 0.5 * tick, how, _parts(float(np.mean(halves)), registers, unit))
    changes = [one.reversal for one in found if math.isfinite(one.reversal)]
    if len(changes) < 2:
        why = "the joint did not follow the reversed goal far enough"
        return band, not_measured(REVERSAL, "rad", why, how)
    return band, mean_of(REVERSAL, "rad", changes, 0.5 * tick, f"{len(changes)} reversals after these stops")


def _parts(whole: float, registers: Mapping[str, int], unit: float) -> str:
    """Describe which parts of a dead band (rad) the servo's margin and friction cause."""
    margins = [registers[name] * unit for name in MARGINS if name in registers]
    if not margins:
        return "all from friction divided by position gain; the model has no compliance margin"
    margin = sum(margins) / len(margins)
    left = max(0.0, whole - margin)
    return (
        f"{math.degrees(margin):.2f} deg by the compliance margin, "
        f"{math.degrees(left):.2f} deg from friction divided by position gain"
    )
