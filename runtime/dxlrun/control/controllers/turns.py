"""Turns: in which of the loop's cycles a controller with a rate of its own is updated."""

from __future__ import annotations

import math

from dxlrun.control.loop_plan import ControllerPlan


def fits(plan: ControllerPlan, period_ns: int) -> bool:
    """Say whether a controller's own rate can be kept: the loop's is a multiple of it."""
    if plan.rate is None:
        return True
    turns = 1e9 / period_ns / plan.rate if plan.rate > 0 else 0.0
    return math.isfinite(turns) and round(turns) >= 1 and abs(turns - round(turns)) < 1e-6 * turns


def every(plan: ControllerPlan, period_ns: int) -> int:
    """Return every how many cycles a controller is updated."""
    return 1 if plan.rate is None else max(1, round(1e9 / period_ns / plan.rate))
