"""Envelope: curves of a run in bounded memory, by the smallest and the largest value in each time bin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float32]  # Shape (rows, curves); NaN without a value
Times = NDArray[np.int64]  # Shape (rows,), ns


@dataclass(frozen=True, slots=True)
class EnvelopeRows:
    """Smallest and largest value of several curves at common times, a row for each time bin.

    Equal values are a single sample.
    """

    t_ns: Times
    low: Samples
    high: Samples

    def and_samples(self, times: Times, values: Samples, windows: list[tuple[int, int]]) -> EnvelopeRows:
        """Return a copy in which single samples replace the time bins within windows.

        A bin that extends beyond the end of a window is drawn from that end on.

        Args:
            times: Times of the samples in the windows, ns.
            values: The samples, shape (samples, curves).
            windows: Disjoint ascending windows, (begin, end) in ns.
        """
        t_ns, keep = self.t_ns.copy(), np.ones(len(self.t_ns), dtype=np.bool_)
        ends = np.append(t_ns[1:], np.iinfo(np.int64).max)
        for begin, end in windows:
            begun = (t_ns >= begin) & (t_ns < end)
            keep &= ~(begun & (ends <= end))
            t_ns[begun & (ends > end)] = end
        t_ns = np.concatenate([t_ns[keep], times])
        order = np.argsort(t_ns, kind="stable")
        low, high = (np.concatenate([side[keep], values])[order] for side in (self.low, self.high))
        return EnvelopeRows(t_ns[order], low, high)

    def with_gaps(self, longest_ns: int) -> EnvelopeRows:
        """Return a copy with a row of NaN in each gap longer than `longest_ns`: no line crosses it."""
        before = np.flatnonzero(np.diff(self.t_ns) > longest_ns) + 1
        if not len(before):
            return self
        nothing = np.float32(np.nan)
        return EnvelopeRows(
            np.insert(self.t_ns, before, self.t_ns[before - 1] + 1),
            np.insert(self.low, before, nothing, axis=0),
            np.insert(self.high, before, nothing, axis=0),
        )


class Envelope:
    """Accumulator of samples of several curves: keeps the smallest and largest value in each of a bounded
    number of time bins.

    When the bins do not suffice, pairs of bins are merged, which doubles their width.
    """

    def __init__(self, curves: int, most: int, width_ns: int) -> None:
        """Create an empty envelope.

        Args:
            curves: Number of curves.
            most: Largest number of bins; an odd number is rounded up.
            width_ns: Initial width of a bin; the sample interval gives each sample a bin of its own.
        """
        most += most % 2
        self._width_ns = max(1, width_ns)
        self._origin_ns: int | None = None
        self._t_ns = np.full(most, np.iinfo(np.int64).max)
        self._low = np.full((most, curves), np.nan, np.float32)
        self._high = self._low.copy()

    def add_samples(self, t_ns: Times, values: Samples) -> None:
        """Add the next samples; `values` has shape (samples, curves), NaN without a value."""
        if not len(t_ns):
            return
        if self._origin_ns is None:
            self._origin_ns = int(t_ns.min())
        since = np.maximum(t_ns - self._origin_ns, 0)
        while int(since.max()) // self._width_ns >= len(self._t_ns):
            self._double()
        bins = since // self._width_ns
        if (np.diff(bins) < 0).any():
            order = np.argsort(bins, kind="stable")
            t_ns, bins, values = t_ns[order], bins[order], values[order]
        first = np.flatnonzero(np.diff(bins, prepend=-1))
        into = bins[first]
        self._t_ns[into] = np.minimum(self._t_ns[into], np.minimum.reduceat(t_ns, first))
        self._low[into] = np.fmin(self._low[into], np.fmin.reduceat(values, first, axis=0))
        self._high[into] = np.fmax(self._high[into], np.fmax.reduceat(values, first, axis=0))

    @property
    def apart_ns(self) -> int:
        """Greatest time between two rows that have no gap in the samples between them, ns."""
        return 2 * self._width_ns

    def rows(self) -> EnvelopeRows:
        """Return a row for each bin that has samples, at the time of its first sample."""
        filled = np.flatnonzero(self._t_ns != np.iinfo(np.int64).max)
        return EnvelopeRows(self._t_ns[filled], self._low[filled], self._high[filled])

    def _double(self) -> None:
        half = len(self._t_ns) // 2
        self._width_ns *= 2
        self._t_ns[:half] = np.minimum(self._t_ns[0::2], self._t_ns[1::2])
        self._t_ns[half:] = np.iinfo(np.int64).max
        for side, nearer in ((self._low, np.fmin), (self._high, np.fmax)):
            side[:half] = nearer(side[0::2], side[1::2])
            side[half:] = np.nan
