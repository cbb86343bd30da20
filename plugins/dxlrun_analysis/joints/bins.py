"""Time series of joint quantities over a run, in bins that double in length when the run outgrows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

BINS = 512  # Even, because bins are merged in pairs
_FIRST_BIN_NS = 100_000_000


_JOINS = ((np.minimum, np.inf), (np.maximum, -np.inf), (np.add, 0.0), (np.add, 0.0))
"""Reduction and neutral element of each array of `Bins`: minimum, maximum, sum, number of values."""


class Bins:
    """Minimum, mean and maximum of several quantities of each joint in 512 time bins of 0.1 s or more."""

    def __init__(self, quantities: int = 0, joints: int = 0, begin_ns: int = 0) -> None:
        shape = (quantities, BINS, joints)
        self.begin_ns, self.bin_ns = begin_ns, _FIRST_BIN_NS
        self._values = [np.full(shape, empty) for _, empty in _JOINS]

    def bin_cycles(self, times: NDArray[np.int64], values: Sequence[Floats]) -> None:
        """Add the values of some cycles to their bins.

        Args:
            times: Times of the cycles in ns, shape (cycles,).
            values: Values of each quantity, NaN if unknown; shape (joints, cycles).
        """
        index = self.find_bins(times)
        starts = np.flatnonzero(np.diff(index, prepend=-1))
        bins, lengths = index[starts], np.diff(starts, append=len(index)).astype(np.float64)
        for quantity, every in enumerate(values):
            known = np.isfinite(every)
            whole = known.all()
            for (join, empty), array in zip(_JOINS[:3], self._values[:3], strict=True):
                part = every if whole else np.where(known, every, empty)
                array[quantity, bins] = join(array[quantity, bins], join.reduceat(part, starts, axis=1).T)
            counts = lengths[:, None] if whole else np.add.reduceat(known, starts, axis=1, dtype=np.float64).T
            self._values[3][quantity, bins] += counts

    def find_bins(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the bin of each time (ns), after making the bins long enough for the last one."""
        while int(times[-1]) - self.begin_ns >= BINS * self.bin_ns:
            self._halve()
        return np.clip((times - self.begin_ns) // self.bin_ns, 0, BINS - 1)

    @property
    def columns(self) -> dict[str, Floats]:
        """Minimum, maximum, sum and number of values of each bin, shape (quantities, bins, joints)."""
        return dict(zip(("least", "most", "total", "count"), self._values, strict=True))

    def _halve(self) -> None:
        """Merge the bins in pairs, which doubles their length."""
        half = BINS // 2
        for (join, empty), array in zip(_JOINS, self._values, strict=True):
            array[:, :half] = join(array[:, 0::2], array[:, 1::2])
            array[:, half:] = empty
        self.bin_ns *= 2

    def joined(self, seconds: float) -> tuple[float, Floats, Floats, Floats]:
        """Return the time series in windows of about `seconds`, of one bin at least.

        Returns:
            Length of the windows in s, then minimum, mean and maximum in each window, shape (quantities,
                windows, joints). The windows cover the run; a window without a value has NaN.
        """
        used = int(np.max(np.nonzero(self._values[3].sum(axis=(0, 2)))[0], initial=-1)) + 1
        step = max(1, round(seconds * 1e9 / self.bin_ns))
        starts, length_s = np.arange(0, used, step), step * self.bin_ns / 1e9
        if not len(starts):
            none = self._values[0][:, :0]
            return length_s, none, none, none
        least, most, total, count = (
            join.reduceat(array[:, :used], starts, axis=1)
            for (join, _), array in zip(_JOINS, self._values, strict=True)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total / count
        least[count == 0] = most[count == 0] = np.nan
        return length_s, least, mean, most
