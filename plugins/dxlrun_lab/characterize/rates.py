"""Highest rate of communication: the rate rises until replies are lost or cycles exceed their period.

The method is that of the thesis' freq_estimator, which found 333 Hz for its MX-64. The log provides the valid
replies and the time from a cycle's wake-up to its last write. A late wake-up is caused by the machine, so it
is ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Literal

import msgspec
import numpy as np

from dxlrun.tooling.plans import Plan
from dxlrun_lab.characterize.joint_figure import JointFigure, not_measured
from dxlrun_lab.guided.segment import SegmentRecording

NAME = "highest rate"
MOST_HZ = 2000.0
ALLOWED = 0.001
"""Allowed fraction of cycles with a lost reply, or with an exchange longer than the period"""
GROWS = 1.3
"""Ratio of each tried rate to the previous one, until one fails"""
NEAR = 0.02
"""Relative distance between the best and the worst rate at which the bisection ends"""
BURST_S = 0.04
"""Duration of a first try at a rate, s. A servo would be lost after 3 missing replies and 50 ms."""

Fault = Literal["", "servo", "bus", "run"]
"""Reason why a rate fails: lost replies, exchanges longer than the period, or a refusal of the run"""


class RateResult(msgspec.Struct, frozen=True):
    """Result of one loop rate that was tried"""

    rate: float
    """Loop rate, Hz"""
    cycles: int
    """Number of cycles at this rate; 0 if the run refused it"""
    lost: int
    """Number of cycles without an intact reply of the joint"""
    too_long: int
    """Number of cycles with an exchange longer than their period, although no reply was lost"""
    late: int
    """Number of cycles with a wake-up later than a tenth of a period. They are caused by the machine."""
    exchange_s: float
    """Median time from a cycle's wake-up to its last write, s; NaN without cycles"""
    text: str = ""
    """Reason for an early end or for the refusal; empty otherwise"""

    @property
    def fault(self) -> Fault:
        """Reason why the rate fails: servo, bus or run; empty on success"""
        if not self.cycles:
            return "run"
        if self.lost > ALLOWED * self.cycles:
            return "servo"
        return "bus" if self.too_long > ALLOWED * self.cycles and self.exchange_s * self.rate > 1 else ""


def judge_rate(rate: float, recorded: Sequence[SegmentRecording], column: int) -> RateResult:
    """Evaluate the recordings at a loop rate, Hz; `column` is that of the joint in them."""
    period_ns = 1e9 / rate
    valid = np.concatenate([part.valid[:, column] for part in recorded])
    took = np.concatenate([part.of_cycles("written_ns") - part.of_cycles("woken_ns") for part in recorded])
    late = np.concatenate([part.of_cycles("woken_ns") - part.of_cycles("scheduled_ns") for part in recorded])
    return RateResult(
        rate,
        len(valid),
        int(np.count_nonzero(~valid)),
        int(np.count_nonzero((took > period_ns) & valid)),
        int(np.count_nonzero(late > 0.1 * period_ns)),
        float(np.median(took)) * 1e-9 if len(took) else math.nan,
        next((part.text for part in recorded if not part.whole), ""),
    )


def refused(rate: float, text: str) -> RateResult:
    """Return the result of a loop rate, Hz, that the run refused with a text."""
    return RateResult(rate, 0, 0, 0, 0, math.nan, text)


def rate_step(plan: Plan) -> Fraction:
    """Return the frequency, Hz, of which the loop rate must be a multiple because of controllers' own rates.

    0 if no controller has a rate of its own.
    """
    step = Fraction(0)
    for controller in plan.loop.controllers:
        if controller.rate is not None:
            rate = Fraction(controller.rate).limit_denominator(1000)
            step = rate if not step else _common(step, rate)
    return step


def _common(a: Fraction, b: Fraction) -> Fraction:
    return Fraction(
        math.lcm(a.numerator * b.denominator, b.numerator * a.denominator), a.denominator * b.denominator
    )


def fitting(rate: float, step: Fraction) -> float:
    """Return the largest multiple of `step` up to `rate`, Hz, but at least one step; `rate` if step is 0."""
    if not step:
        return rate
    return float(max(1, math.floor(Fraction(rate) / step + Fraction(1, 10**6))) * step)


def highest_by_bus(plan: Plan) -> float:
    """Return the highest loop rate that the buses allow by the plan, Hz; infinite if it has none."""
    return 1e9 / plan.loop.least_period_ns if plan.loop.least_period_ns else math.inf


def following(tried: Sequence[RateResult], begin: float, highest: float, step: Fraction) -> float | None:
    """Return the loop rate to try next, Hz, or None at the end of the search.

    Rates grow from `begin` up to `highest` until one fails. A bisection follows. All are multiples of `step`.
    """
    if not tried:
        return fitting(min(begin, highest), step)
    good = max((one.rate for one in tried if not one.fault), default=0.0)
    bad = min((one.rate for one in tried if one.fault), default=math.inf)
    if math.isinf(bad):
        # If the controllers allow only few rates, the next one may be farther away than GROWS.
        rate = fitting(min(max(GROWS * good, good + float(step)), highest), step)
    else:
        rate = fitting((good + bad) / 2 if good else bad / GROWS, step)
    known = rate <= good or any(one.rate == rate for one in tried)
    return None if known or bad - good < NEAR * good else rate


def highest_rate(tried: Sequence[RateResult], plan: Plan, servo: str) -> JointFigure:
    """Return the figure of the highest rate without a fault, and what limits it.

    `servo` is the servo's name in sentences.
    """
    how = f"{len(tried)} rates, {sum(rate.cycles for rate in tried)} cycles"
    kept = [rate for rate in tried if not rate.fault]
    failed = [rate for rate in tried if rate.fault]
    if not kept:
        why = f"no rate was kept: {_reason(tried[0], servo)}" if tried else "no rate was tried"
        return not_measured(NAME, "Hz", why, how)
    best = kept[-1].rate
    above = [rate for rate in failed if rate.rate > best]
    step, by_bus = rate_step(plan), highest_by_bus(plan)
    if above:
        between = above[0].rate - best
        return JointFigure(NAME, "Hz", best, between, None, len(tried), how, _reason(above[0], servo))
    if best >= fitting(by_bus, step):
        budget = max((bus for bus in plan.buses), key=lambda bus: bus.budget.total_ns)
        limit = (
            f"the bus: at {budget.baud_rate} bit/s and {budget.return_delay_ns / 1e3:.0f} us return delay, "
            f"an exchange takes {budget.budget.total_ns / 1e6:.2f} ms (computed)"
        )
        between = min(by_bus - best, float(step)) if step else by_bus - best
        return JointFigure(NAME, "Hz", best, max(between, 0.0), None, len(tried), how, limit)
    return JointFigure(NAME, "Hz", best, None, None, len(tried), how, "none found: no higher rate was tried")


def _reason(rate: RateResult, servo: str) -> str:
    at = f"at {rate.rate:.4g} Hz"
    if rate.fault == "servo":
        return f"the servo: {rate.lost} of {rate.cycles} replies of {servo} are lost {at}"
    if rate.fault == "bus":
        return f"the bus: a cycle's exchange takes {rate.exchange_s * 1e3:.2f} ms {at}"
    return f"the run: {rate.text or f'refused {at}'}"
