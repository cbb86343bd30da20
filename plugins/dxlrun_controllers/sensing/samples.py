"""Samples of a device or a sensor: which values that a controller reads are new, and when they were true."""

from __future__ import annotations

import math

FRESH = 0.25
"""Of the controller's period: a sample is a new one when it is younger than the one before by so much. Ages
of the same sample differ by the microseconds in which they are computed."""


class SampleTimes:
    """When the newest sample was measured, from its age, so that lost samples are counted with true times."""

    def __init__(self, period_ns: int) -> None:
        """`period_ns` is the controller's."""
        self._least_s = FRESH * period_ns * 1e-9
        self.forget()

    def forget(self) -> None:
        """Begin anew: the next sample is the first one."""
        self.time_s = self.elapsed_s = math.nan

    def take(self, time_ns: int, age_s: float) -> bool:
        """Return whether the sample is a new one; `elapsed_s` is the time since the one before, else NaN.

        `age_s` NaN: there is none yet.
        """
        sampled_s = time_ns * 1e-9 - age_s
        if math.isnan(sampled_s) or sampled_s - self.time_s <= self._least_s:
            return False
        self.elapsed_s = sampled_s - self.time_s
        self.time_s = sampled_s
        return True

    def age_s(self, time_ns: int) -> float:
        """Return how old the newest sample is, s; NaN where there is none."""
        return time_ns * 1e-9 - self.time_s
