"""Measured: one figure of a joint with its uncertainty, or why it could not be measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

STUDENT_95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13)
"""Two-sided 95 % quantile of Student's distribution with 1, 2, ... degrees of freedom."""
_NORMAL_95, _BEYOND = 1.96, 2.5
"""Beyond the table it is 1.96 + 2.5 / freedom, within 0.01."""


class Measured(msgspec.Struct, frozen=True):
    """One figure of a joint, in SI units; angles in rad."""

    name: str
    """As in the table: `response to first motion`."""
    unit: str
    """rad, s, rad/s, rad/s^2, Hz"""
    value: float | None = None
    """None: not measurable, or not measured; then `why`."""
    uncertainty: float | None = None
    """Half of the interval that holds the value in 95 of 100 cases: scatter and resolution together."""
    spread: float | None = None
    """Standard deviation of single measurements; None where there is one only."""
    count: int = 0
    """Of single measurements."""
    how: str = ""
    """How it was measured, with which motion."""
    limit: str = ""
    """What limited it, where that is to be named."""
    why: str = ""
    """Why there is no value, one sentence."""

    @property
    def near_zero(self) -> bool:
        """True where the interval contains 0: only an upper bound is known."""
        return self.value is not None and abs(self.value) <= (self.uncertainty or 0.0)


def not_measured(name: str, unit: str, why: str, how: str = "") -> Measured:
    """Return a figure without a value."""
    return Measured(name, unit, how=how, why=why)


def mean_of(  # noqa: PLR0917  the fields of Measured, in their order
    name: str, unit: str, values: Sequence[float], resolution: float, how: str, limit: str = ""
) -> Measured:
    """Return the mean of single measurements.

    `resolution`: half of the interval that a single one is uncertain by for itself, whatever the others say.
    """
    each = np.asarray(values, dtype=np.float64)
    spread = float(each.std(ddof=1)) if len(each) > 1 else None
    scatter = 0.0 if spread is None else student(len(each) - 1) * spread / math.sqrt(len(each))
    return Measured(
        name, unit, float(each.mean()), math.hypot(scatter, resolution), spread, len(each), how, limit
    )


def student(freedom: int) -> float:
    """Return the two-sided 95 % quantile for some degrees of freedom, 1 or more."""
    if freedom > len(STUDENT_95):
        return _NORMAL_95 + _BEYOND / freedom
    return STUDENT_95[freedom - 1]
