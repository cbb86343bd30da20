"""Samples: detection of new samples of a device or sensor from their ages, and the time between them."""

from __future__ import annotations

import math

FRESH = 0.25
"""Fraction of the controller's period by which the times of two samples must differ.

The time of one sample varies by some microseconds, because its age is computed again in each cycle.
"""


class SampleTimes:
    """Time of the newest sample, computed from its age, so that a gap between samples has its true length."""

    def __init__(self, period_ns: int) -> None:
        """Set the smallest time between two samples from the period of the controller, ns."""
        self._least_s = FRESH * period_ns * 1e-9
        self.discard_sample()

    def discard_sample(self) -> None:
        """Discard the last sample, so that the next one counts as the first."""
        self.time_s = self.elapsed_s = math.nan

    def accept_sample(self, time_ns: int, age_s: float) -> bool:
        """Return True if the sample is new, and set `elapsed_s` to the time since the last one, NaN for the
        first.

        Args:
            time_ns: Time of the cycle, ns.
            age_s: Age of the sample, s; NaN while there is none.
        """
        sampled_s = time_ns * 1e-9 - age_s
        if math.isnan(sampled_s) or sampled_s - self.time_s <= self._least_s:
            return False
        self.elapsed_s = sampled_s - self.time_s
        self.time_s = sampled_s
        return True

    def age_s(self, time_ns: int) -> float:
        """Return the age of the newest sample, s; NaN without one."""
        return time_ns * 1e-9 - self.time_s
