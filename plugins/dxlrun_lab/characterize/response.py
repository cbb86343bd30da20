"""Response time, from small steps: to the first motion, and to 63 % of the way.

The time of the first motion is found by a fit through the first samples. The first tick would be too late by
the time in which the slow shaft turns by one tick: some 9 ms for the 0.29 deg of an AX-12A.

A small step must fit into one packet, so the loop rate is low, because the gate limits a goal to the speed of
its servo. Steps at several loop rates are combined, so that their samples interleave. Half of the steps start
from a rest that was approached from below, and half from above, so that the shifts by ticks and dead band
cancel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun_lab.characterize.joint_figure import JointFigure, not_measured, student
from dxlrun_lab.characterize.trace import Trace, polynomial

PART = 1 - math.exp(-1)
"""63 %: fraction of the way that a first-order lag has covered after its time constant"""
LEAST_STEPS = 6
"""Smallest number of steps from which response times are determined, because their scatter is estimated"""
_CLEAR_S = 0.02
"""A shorter response is still reported if its uncertainty is below half of this time, s"""
LEAST_TICKS = 8
"""Shortest way from which a response time can be determined, ticks"""
ONSET_PART = 0.5
"""Fraction of the way that is used to find the first motion"""
_MISSED_PART = 0.04
"""Systematic error of the first motion as a fraction of the time to 63 %, found with simulated servos of
known delay. Their way does not start as a polynomial."""
_REST_S = 0.1
"""Time before a step, and before the next one, in which the shaft must be at rest, s"""
_STILL_TICKS, _STILL_PART = 2.5, 0.05
"""Motion below which a joint counts as at rest: ticks, or fraction of the step's height"""
_BEFORE_S = 0.03
"""A step's samples start this long before its goal was sent, s."""
ONSET, RISE = "response to first motion", "response to 63 %"


class StepResponse(msgspec.Struct, frozen=True):
    """Recorded response of a resting joint to one step of its goal, until the next step"""

    time: Floats
    """Time since the last byte of the first packet with the new goal, s"""
    way: Floats
    """Distance of the joint from its rest before the step, rad, positive towards the goal"""
    goal: Floats
    """Distance of the sent goal from the previous one, rad"""
    height: float
    """Height of the step of the goal, rad, positive"""
    reached: float
    """Distance from the first to the final rest, rad; NaN if the joint did not come to rest"""
    packets_s: float
    """Time in which packets with changing goals were sent, s; above 0 if the gate limited the step"""
    tick: float
    """Resolution of the position, rad"""


def steps_of(trace: Trace) -> list[StepResponse]:
    """Return the steps in a recording. A step starts when the goal changes after a rest of the joint."""
    changed = np.flatnonzero(np.diff(trace.goal) != 0) + 1
    if not len(changed):
        return []
    pauses = np.diff(trace.time[changed], prepend=-math.inf)
    starts = changed[pauses > max(2 * _REST_S, 3.5 * trace.period)]
    ends = [*starts[1:].tolist(), len(trace)]
    return [
        step
        for start, end in zip(starts.tolist(), ends, strict=True)
        if (step := _step(trace, start, end)) is not None
    ]


def _step(trace: Trace, start: int, end: int) -> StepResponse | None:
    """Return the step from row `start` to before row `end`, or None if the joint did not rest before it."""
    origin = float(trace.sent[start])
    before = trace.part((trace.time > trace.time[start] - _REST_S) & (np.arange(len(trace)) <= start))
    height = float(trace.goal[end - 1] - trace.goal[start - 1])
    still = max(_STILL_TICKS * trace.tick, _STILL_PART * abs(height))
    if len(before) < 2 or np.ptp(before.position) > still:
        return None
    rest = float(before.position.mean())
    sign = math.copysign(1.0, height)
    first = int(np.searchsorted(trace.time, trace.time[start] - _BEFORE_S))
    rows = slice(first, end)
    last = trace.position[start:end][trace.time[start:end] > trace.time[end - 1] - _REST_S]
    rested = len(last) > 1 and np.ptp(last) <= still
    moving = np.flatnonzero(np.diff(trace.goal[start - 1 : end]) != 0)
    return StepResponse(
        trace.time[rows] - origin,
        sign * (trace.position[rows] - rest),
        sign * (trace.goal[rows] - trace.goal[start - 1]),
        abs(height),
        float(sign * (last.mean() - rest)) if rested else math.nan,
        float(trace.time[start + moving[-1]] - trace.time[start]),
        trace.tick,
    )


# Response


def response(steps: Sequence[StepResponse]) -> tuple[JointFigure, JointFigure]:
    """Return two figures: the response times to the first motion and to 63 % of the way.

    The samples of all steps are pooled. Steps at different loop rates interleave, so the samples are dense.
    """
    why, good = _not_usable(steps), [step for step in steps if _rested(step)]
    if why:
        return not_measured(ONSET, "s", why), not_measured(RISE, "s", why)
    how = f"{len(good)} steps of {math.degrees(float(np.mean([step.height for step in good]))):.3g} deg"
    pools = [_Pool(step.time, step.way / step.reached) for step in good]
    rise = _rise(pools)
    missed = _MISSED_PART * rise if math.isfinite(rise) else 0.0
    return (
        _pooled(ONSET, pools, (_first_motion, *_OTHER_FITS), how, missed),
        _pooled(RISE, pools, (_rise,), how),
    )


def _rested(step: StepResponse) -> bool:
    return step.reached >= LEAST_TICKS * step.tick


def _not_usable(steps: Sequence[StepResponse]) -> str:
    """Return the reason why no response time can be found from the steps, one sentence; empty if it can."""
    if len(steps) < LEAST_STEPS:
        return f"only {len(steps)} steps started at rest; {LEAST_STEPS} are needed"
    most, height = max(float(np.max(step.way)) for step in steps), steps[0].height
    if height < LEAST_TICKS * steps[0].tick:
        step, tick = math.degrees(height), math.degrees(steps[0].tick)
        return (
            f"the range allows steps of {step:.2g} deg, too small for positions in ticks of {tick:.2g} deg; "
            f"give a range of about {math.ceil(2.5 * LEAST_TICKS * tick):.0f} deg"
        )
    if most < max(LEAST_TICKS * steps[0].tick, height / 4):
        moved, of = math.degrees(most), math.degrees(height)
        return f"the joint moved by only {moved:.2g} deg in steps of {of:.2g} deg"
    if sum(map(_rested, steps)) < LEAST_STEPS:
        return "the joint did not come to rest after its steps"
    slow = max(step.packets_s for step in steps)
    if slow > 0:
        return f"each step was sent in several packets, for {slow * 1e3:.0f} ms; raise limits.acceleration"
    return ""


class _Pool(NamedTuple):
    """Samples of one step: time since the goal's packet, s, and fraction of the whole way"""

    time: Floats
    part: Floats


def _pooled(
    name: str,
    pools: Sequence[_Pool],
    ways: Sequence[Callable[[Sequence[_Pool]], float]],
    how: str,
    resolution: float = 0.0,
) -> JointFigure:
    """Return the figure of a response time that the first of the estimators `ways` finds in all steps.

    The scatter is estimated by the jackknife (B. Efron and C. Stein, Annals of Statistics 9, 1981).
    Differences to the other estimators in `ways` add to the uncertainty.
    """
    value, count = ways[0](pools), len(pools)
    if math.isnan(value):
        return not_measured(name, "s", "the positions scatter too much to measure it", how)
    without = np.array([ways[0]([*pools[:at], *pools[at + 1 :]]) for at in range(count)])
    error = math.sqrt((count - 1) / count * float(np.nansum((without - np.nanmean(without)) ** 2)))
    others = [abs(way(pools) - value) for way in ways[1:]]
    uncertainty = math.hypot(
        student(count - 1) * error, resolution, *(one for one in others if math.isfinite(one))
    )
    if uncertainty > max(value, 0.5 * _CLEAR_S):
        found = f"{value * 1e3:.0f} ms, with an uncertainty of {uncertainty * 1e3:.0f} ms"
        why = f"{found}: the positions scatter too much, or are too coarse"
        return not_measured(name, "s", why, how)
    return JointFigure(name, "s", max(0.0, value), uncertainty, _spread(pools), count, how)


def _curve(pools: Sequence[_Pool]) -> tuple[Floats, Floats]:
    time = np.concatenate([one.time for one in pools])
    part = np.concatenate([one.part for one in pools])
    order = np.argsort(time, kind="stable")
    return time[order], part[order]


def _rise(pools: Sequence[_Pool], level: float = PART) -> float:
    """Return the response time to the fraction `level` of the way, s, by a parabola through samples near it.
    NaN with too few samples."""
    time, part = _curve(pools)
    rising = (time > 0) & (time < _until(time, part, 0.5 * (1 + level)))
    near = rising & (np.abs(part - level) < 0.5 * (1 - level) + 1e-9)
    if np.count_nonzero(near) < LEAST_STEPS:
        return math.nan
    return float(np.polyval(polynomial(part[near] - level, time[near], 2), 0.0))


def _until(time: Floats, part: Floats, level: float) -> float:
    """Return the last time, s, at which a sample is below a fraction of the way; at least 0."""
    below = time[part < level]
    return float(below.max(initial=0.0))


def _first_motion(
    pools: Sequence[_Pool], part_of_way: float = ONSET_PART, powers: Sequence[int] = (2, 3, 4)
) -> float:
    """Return the time t0 of the first motion, s, with which c2 (t - t0)^2 + c3 (t - t0)^3 + ... fits best.

    The motor's torque jumps with the goal, so the way starts with the square of the time. The other terms
    account for the speed and the decreasing error. NaN if the fit has no minimum.
    """
    time, part = _curve(pools)
    until = _rise(pools, part_of_way)
    if math.isnan(until):
        return math.nan
    rows = time <= until
    time, part = time[rows], part[rows]
    candidates = np.linspace(-0.2 * until, 0.95 * until, 231)
    since = np.maximum(time[None, :] - candidates[:, None], 0.0) / until
    terms = np.stack([since**power for power in powers], axis=2)
    square = np.einsum("cni,cnj->cij", terms, terms) + 1e-12 * np.eye(len(powers))
    right = np.einsum("cni,n->ci", terms, part)
    found = np.linalg.solve(square, right[:, :, None])[:, :, 0]
    cost = part @ part - np.einsum("ci,ci->c", found, right)
    cost[found[:, 0] <= 0] = math.inf  # reject fits that start backwards
    at = int(np.argmin(cost))
    if not 0 < at < len(candidates) - 1:
        return math.nan
    before, best, behind = cost[at - 1 : at + 2]
    bend = before - 2 * best + behind
    shift = 0.5 * (before - behind) / bend if math.isfinite(bend) and bend > 0 else 0.0
    return float(candidates[at] + shift * (candidates[1] - candidates[0]))


_OTHER_FITS: Final[Sequence[Callable[[Sequence[_Pool]], float]]] = (
    lambda pools: _first_motion(pools, 0.8 * ONSET_PART, (2, 3)),
    lambda pools: _first_motion(pools, 0.7 * ONSET_PART),
    lambda pools: _first_motion(pools, 1.3 * ONSET_PART),
)
"""Estimators of the first motion that use less or more of the way. Their differences to the main estimate
are its error by polynomial and ticks."""


def _spread(pools: Sequence[_Pool]) -> float | None:
    """Return the standard deviation of single steps' response times, s, by their shifts against all samples.
    None with too few samples."""
    time, part = _curve(pools)
    rows = (part > 0.1) & (part < 0.9) & (time < _until(time, part, 0.9))
    if np.count_nonzero(rows) < 3 * LEAST_STEPS:
        return None
    curve = polynomial(time[rows], part[rows], 3)
    slope = np.polyder(curve)
    shifts = []
    for one in pools:
        mine = (one.part > 0.1) & (one.part < 0.9) & (one.time < time[rows].max())
        if np.any(mine):
            steep = np.polyval(slope, one.time[mine])
            off = np.polyval(curve, one.time[mine]) - one.part[mine]
            shifts.append(float(steep @ off / max(steep @ steep, 1e-12)))
    return float(np.std(shifts, ddof=1)) if len(shifts) > 1 else None
