"""Dead band: how far from its goal a joint may rest, and which change of the goal moves it.

A place is approached slowly from both sides, as the reversal value of ISO 230-2 is measured, and the joint is
left to rest: it stops short of it by what friction and the position gain leave, and by the servo's margin.
Turned round from there, it moves when the goal has gone through twice of that.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun_lab.characterize.measured import Measured, mean_of, not_measured
from dxlrun_lab.characterize.trace import Trace, polynomial

NAME, REVERSAL = "dead band", "smallest change that moves it"
MARGINS = ("cw_compliance_margin", "ccw_compliance_margin")
"""Registers of a dead band: Compliance Margin (26, 27) of AX and RX, ticks."""
SLOW = math.radians(3.0)
"""rad/s of the goal"""
REST_S = 0.7
_LOOK_S = 0.3
"""At the end of a rest, in which the joint must stand."""
_FOLLOWED_TICKS = 4
"""A joint that came by less nearer to its goal did not follow it."""
_LEAST_ROWS = 5
"""Of a line"""
_MOVING = 0.5
"""Of the goal's speed: a joint that goes faster follows it."""


class Approach(msgspec.Struct, frozen=True):
    """One rest after a slow way to it."""

    upward: bool
    short: float
    """rad by which the joint stands short of the goal, positive where it did not come there"""
    reversal: float
    """rad that the goal had gone back from there when the joint began to move; NaN: not seen"""


def stops(places: Sequence[float], reach: float) -> list[float]:
    """Return the goals between which a table goes slowly, resting at each: to each place from both sides."""
    return [places[0], *(turn for place in places for turn in (place - reach, place, place + reach, place))]


def table(goals: Sequence[float], period: float) -> tuple[Floats, float]:
    """Return a table of goals that rest at each place and go slowly between them, and its duration, s."""
    pieces = [np.full(math.ceil(REST_S / period), goals[0])]
    for before, after in itertools.pairwise(goals):
        count = max(1, math.ceil(abs(after - before) / SLOW / period))
        pieces += [np.linspace(before, after, count + 1)[1:], np.full(math.ceil(REST_S / period), after)]
    rows: Floats = np.concatenate(pieces)
    return rows, len(rows) * period


def approaches(trace: Trace) -> list[Approach]:
    """Return the rests in a trace of such a table to which the joint followed its goal."""
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
    """Return how far the goal had gone back when the joint left its rest, rad; NaN where it did not.

    `trace`: the way back, of so many rows, and the rest after it.
    """
    if moves < _LEAST_ROWS or sign * (trace.goal[moves - 1] - trace.goal[0]) > 0:
        return math.nan
    way, after = trace.part(slice(0, moves)), trace.part(slice(moves, None))
    left = np.flatnonzero(-sign * (way.position - rest) > 1.5 * trace.tick)
    if len(left) < _LEAST_ROWS or not len(after):
        return math.nan
    # it goes as fast as the goal then: back along a line to where it rested
    slope, offset = polynomial(way.time[left], way.position[left], 1)
    if abs(slope) < _MOVING * SLOW:
        return math.nan
    change = abs(float(np.interp((rest - offset) / slope, way.sent, way.goal)) - float(way.goal[0]))
    # the line lies behind by what the motion itself needs: more than what is left when it rests again
    late = way.time > way.time[-1] - _LOOK_S
    behind = np.abs(np.interp(way.time[late], way.sent, way.goal) - way.position[late]).mean()
    standing = after.time > after.time[-1] - _LOOK_S
    at_rest = np.abs(after.goal[standing] - after.position[standing]).mean()
    return change - max(0.0, float(behind - at_rest))


def dead_band(
    found: Sequence[Approach], tick: float, registers: Mapping[str, int], unit: float
) -> tuple[Measured, Measured]:
    """Return the dead band, to each side, and the smallest change of the goal that moves the joint.

    `registers`: of the servo, as far as they are known; `unit`: of a margin, rad.
    """
    up = [one.short for one in found if one.upward]
    down = [one.short for one in found if not one.upward]
    how = (
        f"{len(up)} rests from below and {len(down)} from above, approached at {math.degrees(SLOW):.0f} deg/s"
    )
    if min(len(up), len(down)) < 2:
        why = "the joint did not follow its goal, or did not come to rest"
        return not_measured(NAME, "rad", why, how), not_measured(REVERSAL, "rad", why, how)
    halves = [(a + b) / 2 for a, b in zip(up, down, strict=False)]
    # each of the two rests is rounded to ticks
    band = mean_of(NAME, "rad", halves, 0.5 * tick, how, _parts(float(np.mean(halves)), registers, unit))
    changes = [one.reversal for one in found if math.isfinite(one.reversal)]
    if len(changes) < 2:
        why = "the joint did not follow its goal back by enough to see where it began to"
        return band, not_measured(REVERSAL, "rad", why, how)
    return band, mean_of(REVERSAL, "rad", changes, 0.5 * tick, f"{len(changes)} reversals after such a rest")


def _parts(whole: float, registers: Mapping[str, int], unit: float) -> str:
    """Return which part of a dead band is the servo's margin, and which the position gain leaves."""
    margins = [registers[name] * unit for name in MARGINS if name in registers]
    if not margins:
        return "all of it by friction over the position gain: the model has no margin"
    margin = sum(margins) / len(margins)
    left = max(0.0, whole - margin)
    return (
        f"{math.degrees(margin):.2f} deg of it by the compliance margin, "
        f"{math.degrees(left):.2f} deg by friction over the position gain"
    )
