"""Counts of whole numbers, and their exact quantiles; memory grows with the number of different values.

`quantile` and `median` are the definitions of every percentile that is shown (docs/reference/analyze.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]

_GROUP = 40  # Bits of a value, shifted so that none is negative; above them its group
_ZERO = 1 << (_GROUP - 1)
_MOST_PENDING = 1 << 18
_FEWEST = 10
_TIMES_MORE = 10


class Counts:
    """Counts values of several groups: times in us of servos, for example."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._pending: list[Numbers] = []
        self._waiting = 0

    def take(self, group: Numbers, value: Numbers) -> None:
        """Count values, each in its group (0 to 2^23); shape (values,)."""
        self._pending.append((group << _GROUP) + np.clip(value, -_ZERO, _ZERO - 1) + _ZERO)
        self._waiting += len(value)
        if self._waiting > _MOST_PENDING:
            self._merge()

    def of(self, group: int) -> tuple[Numbers, Numbers]:
        """Return the values of a group, ascending, and how often each was seen."""
        self._merge()
        begin, end = np.searchsorted(self._keys, [group << _GROUP, (group + 1) << _GROUP])
        return self._keys[begin:end] - (group << _GROUP) - _ZERO, self._counts[begin:end]

    @property
    def groups(self) -> list[int]:
        """The groups that have values, ascending."""
        self._merge()
        return sorted(set((self._keys >> _GROUP).tolist()))

    def _merge(self) -> None:
        if not self._pending:
            return
        new, counts = np.unique(np.concatenate(self._pending), return_counts=True)
        keys, where = np.unique(np.concatenate([self._keys, new]), return_inverse=True)
        total = np.zeros(len(keys), np.int64)
        np.add.at(total, where, np.concatenate([self._counts, counts]))
        self._keys, self._counts = keys, total
        self._pending, self._waiting = [], 0


def quantile(values: Numbers, counts: Numbers, share: float) -> float:
    """Return a quantile by nearest rank: the smallest value that at least this share does not exceed.

    It is a value that was seen, never interpolated. Of several seen n times in all it has rank
    ceil(share * n).

    Args:
        values: Ascending, without repetition.
        counts: How often each was seen.
        share: 0.99 for 99 %.

    Returns:
        The value; 0 if there is none.
    """
    seen = np.cumsum(counts)
    if not len(seen):
        return 0.0
    return float(values[np.searchsorted(seen, share * seen[-1] * (1 - 1e-12))])


def median(values: Numbers, counts: Numbers) -> float:
    """Return the median, of an even number of values the mean of the two in the middle; 0 of none."""
    seen = np.cumsum(counts)
    if not len(seen):
        return 0.0
    total = int(seen[-1])
    middle = values[np.searchsorted(seen, [(total - 1) // 2, total // 2], side="right")]
    return float(middle.sum()) / 2


def has_them_alone(own: int, others: int) -> bool:
    """Return whether one of several has so many of something, and all others so few, that it is named.

    Ten at least, and ten times as many as all others together: plain counts, which a sentence can give.
    """
    return own >= max(_FEWEST, _TIMES_MORE * others)
