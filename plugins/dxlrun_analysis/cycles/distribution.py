"""Distributions of times, collected piece by piece in memory that does not grow with their number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EXACT_VALUES = 65_536
"""Up to so many values quantiles are exact; beyond, they are those of a histogram."""
_BITS = 8
"""A bin has the upper 8 bits of a value in common, so it is at most 1/128 of its values wide."""
RESOLUTION = 1 / (1 << _BITS)
"""How far a quantile of more values may be from the true one, as a share of it: half a bin."""
_HALF = 1 << (_BITS - 1)
_BINS = (64 - _BITS) * _HALF + 2 * _HALF
Longs = NDArray[np.int64]


class Distribution:
    """Counts, quantiles and the maximum of whole numbers from 0 on, such as times in ns."""

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0
        self._pieces: list[Longs] = []
        self._bins: Longs | None = None

    def take(self, values: Longs) -> None:
        """Add values, shape (n,); one below 0 counts as 0."""
        if not len(values):
            return
        values = np.maximum(values, 0)
        self.count += len(values)
        self.largest = max(self.largest, int(values.max()))
        if self._bins is not None:
            self._bins += np.bincount(_bin(values), minlength=_BINS)
            return
        self._pieces.append(values)
        if self.count > EXACT_VALUES:
            self._bins = np.bincount(_bin(np.concatenate(self._pieces)), minlength=_BINS)
            self._pieces = []

    def quantiles(self, *shares: float) -> tuple[float, ...]:
        """Return the values below which these shares (0 to 1) of all lie; zeros of none."""
        if not self.count:
            return (0.0,) * len(shares)
        if self._bins is None:
            values = np.concatenate(self._pieces)
            self._pieces = [values]
            return tuple(np.quantile(values, shares).tolist())
        ranks = np.asarray(shares) * (self.count - 1)
        index = np.searchsorted(np.cumsum(self._bins), ranks, side="right")
        return tuple(np.minimum(_middle(index), self.largest).tolist())


def _bin(values: Longs) -> Longs:
    exponent = np.maximum(np.frexp(values.astype(np.float64))[1] - _BITS, 0).astype(np.int64)
    found: Longs = exponent * _HALF + (values >> exponent)
    return found


def _middle(index: Longs) -> NDArray[np.float64]:
    """Return the middle of bins; those of less than 256 hold one whole number each."""
    exponent = np.maximum(index // _HALF - 1, 0)
    width = 2.0**exponent
    middle: NDArray[np.float64] = (index - exponent * _HALF) * width + (width - 1) / 2
    return middle
