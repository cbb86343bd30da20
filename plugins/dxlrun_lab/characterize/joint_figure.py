"""Measured: one figure of a servo, such as its top speed, with uncertainty, or why it was not measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

STUDENT_95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13)
"""Two-sided 95 % quantile of Student's distribution with 1, 2, ... degrees of freedom"""
_NORMAL_95, _BEYOND = 1.96, 2.5
"""Approximation 1.96 + 2.5 / freedom of the quantile beyond the table, exact within 0.01"""


class JointFigure(msgspec.Struct, frozen=True):
    """Figure of a joint's servo in SI units: a row in the result of `dxlrun characterize`"""

    name: str
    """Name in the table, such as `response to first motion`"""
    unit: str
    """rad, s, rad/s, rad/s^2, Hz"""
    value: float | None = None
    """None if it was not measured; the reason is in `why`"""
    uncertainty: float | None = None
    """Half-width of the 95 % confidence interval, from scatter and resolution; None if unknown"""
    spread: float | None = None
    """Standard deviation of single measurements; None for a single one"""
    count: int = 0
    """Number of single measurements"""
    how: str = ""
    """Method and motion of the measurement"""
    limit: str = ""
    """Limiting factor or parts of the value, if known: `the bus: ...`"""
    why: str = ""
    """Reason for a missing value, one sentence"""

    @property
    def near_zero(self) -> bool:
        """True if the confidence interval contains 0, so that only an upper bound is known"""
        return self.value is not None and abs(self.value) <= (self.uncertainty or 0.0)


def not_measured(name: str, unit: str, why: str, how: str = "") -> JointFigure:
    """Return a figure without a value, with the reason as one sentence."""
    return JointFigure(name, unit, how=how, why=why)


def mean_of(  # noqa: PLR0917  the fields of Measured, in their order
    name: str, unit: str, values: Sequence[float], resolution: float, how: str, limit: str = ""
) -> JointFigure:
    """Return the mean of single measurements as a figure.

    Args:
        name: Name of the figure.
        unit: Unit of the values.
        values: Single measurements.
        resolution: Systematic uncertainty (half-width), which averaging does not reduce.
        how: Method of the measurement.
        limit: Limiting factor.
    """
    each = np.asarray(values, dtype=np.float64)
    spread = float(each.std(ddof=1)) if len(each) > 1 else None
    scatter = 0.0 if spread is None else student(len(each) - 1) * spread / math.sqrt(len(each))
    return JointFigure(
        name, unit, float(each.mean()), math.hypot(scatter, resolution), spread, len(each), how, limit
    )


def student(freedom: int) -> float:
    """Return the two-sided 95 % quantile of Student's distribution for 1 or more degrees of freedom."""
    if freedom > len(STUDENT_95):
        return _NORMAL_95 + _BEYOND / freedom
    return STUDENT_95[freedom - 1]
