"""Samples of desired and actual joint positions and of loads, 50 a second at most.

A run longer than three minutes keeps its first and its newest samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

STEP_S = 0.02  # 50 samples a second
_MOST = 8_192  # Samples kept, nearly three minutes. A longer run keeps the first and the newest half


class TrailSamples(NamedTuple):
    """Positions and loads of all joints over time; NaN if unknown, and at the gap in a long run."""

    step_s: float  # Time between samples; the period of a loop below 50 Hz
    at_s: Floats  # Time since the start, shape (samples,)
    way: Floats  # Reachable trajectory; this and the next arrays have shape (samples, joints)
    position: Floats  # Only with torque and position control
    load: Floats


class Trail:
    """Accumulator of position and load samples of all joints. Its memory does not grow with the log."""

    def __init__(self, joints: int = 0, begin_ns: int = 0) -> None:
        self._begin_ns, self._slot = begin_ns, -1
        self._step_s = STEP_S
        self._rows = np.zeros((0, 1 + 3 * joints))

    def add_cycles(self, at_ns: NDArray[np.int64], way: Floats, position: Floats, load: Floats) -> None:
        """Add the first cycle of each 20 ms; `at_ns` has shape (cycles,), the others (cycles, joints)."""
        since_s = (at_ns - self._begin_ns) * 1e-9
        if len(at_ns) > 2:
            self._step_s = max(STEP_S, float(np.median(np.diff(since_s))))
        slots = np.floor(since_s / STEP_S + 1e-6)
        first = np.diff(slots, prepend=self._slot) > 0
        self._slot = slots[-1]
        new = np.column_stack([since_s[first], way[first], position[first], load[first]])
        self._rows = np.vstack([self._rows, new])
        if len(self._rows) > _MOST:
            half = _MOST // 2
            self._rows = np.vstack([self._rows[:half], self._rows[-half:]])
            self._rows[half, 1:] = np.nan

    def samples(self) -> TrailSamples:
        """Return the kept samples of the run."""
        return TrailSamples(self._step_s, self._rows[:, 0], *np.split(self._rows[:, 1:], 3, axis=1))
