"""Samples of where joints should be and are, at most 50 a second: the first of a run and its newest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

STEP_S = 0.02
_MOST = 8_192  # Samples kept, nearly three minutes: of a longer run the first half of them, and the newest


class Samples(NamedTuple):
    """Quantities by time; NaN where they are not known, and where samples were left out."""

    step_s: float  # Between two of them: of a loop below 50 Hz its period
    at_s: Floats  # Since the first one, shape (samples,)
    way: Floats  # The reachable trajectory, here and in the others of shape (samples, joints)
    position: Floats  # Only with torque, in control of a position
    load: Floats


class Trail:
    """Collects samples, in memory that does not grow with the log."""

    def __init__(self, joints: int = 0, begin_ns: int = 0) -> None:
        self._begin_ns, self._slot = begin_ns, -1
        self._step_s = STEP_S
        self._rows = np.zeros((0, 1 + 3 * joints))

    def take(self, at_ns: NDArray[np.int64], way: Floats, position: Floats, load: Floats) -> None:
        """Take cycles, shapes (cycles,) and (cycles, joints); of each 20 ms the first is kept."""
        since_s = (at_ns - self._begin_ns) * 1e-9
        if len(at_ns) > 2:
            self._step_s = max(STEP_S, float(np.median(np.diff(since_s))))
        slots = np.floor(since_s / STEP_S + 1e-6)
        first = np.diff(slots, prepend=self._slot) > 0
        self._slot = slots[-1]
        new = np.column_stack([since_s, way, position, load])[first]
        self._rows = np.vstack([self._rows, new])
        if len(self._rows) > _MOST:
            half = _MOST // 2
            self._rows = np.vstack([self._rows[:half], self._rows[-half:]])
            self._rows[half, 1:] = np.nan

    def samples(self) -> Samples:
        """Return what was kept."""
        return Samples(self._step_s, self._rows[:, 0], *np.split(self._rows[:, 1:], 3, axis=1))
