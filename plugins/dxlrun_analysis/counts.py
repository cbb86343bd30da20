"""Exact quantiles of integers, from the count of each distinct value.

`quantile` and `median` define every percentile that is shown (docs/reference/analyze.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]

_GROUP = 40  # Low bits of a key hold the value, shifted to be non-negative; the bits above hold its group
_ZERO = 1 << (_GROUP - 1)
_MOST_PENDING = 1 << 18  # Values that are merged at once
_FEWEST = 10  # Fewer occurrences can be a coincidence
_TIMES_MORE = 10


class Counts:
    """Counter of each distinct integer value in several groups, for example reply times in us by servo."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._pending: list[Numbers] = []
        self._waiting = 0

    def count_values(self, group: Numbers, value: Numbers) -> None:
        """Count values in their groups.

        Args:
            group: Group of each value, 0 to 2^23; shape (values,).
            value: Values to count; shape (values,).
        """
        key = np.clip(value, -_ZERO, _ZERO - 1)
        key += _ZERO
        key += group << _GROUP
        self._pending.append(key)
        self._waiting += len(value)
        if self._waiting > _MOST_PENDING:
            self._merge()

    def counts_of(self, group: int) -> tuple[Numbers, Numbers]:
        """Return the distinct values that were counted in a group, ascending, and the count of each value."""
        self._merge()
        begin, end = np.searchsorted(self._keys, [group << _GROUP, (group + 1) << _GROUP])
        return self._keys[begin:end] - (group << _GROUP) - _ZERO, self._counts[begin:end]

    @property
    def groups(self) -> list[int]:
        """Numbers of the groups that have values, ascending."""
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
    """Return a quantile of counted values: the smallest value whose cumulative share reaches `share`.

    The result is an observed value, never an interpolated one. Its rank among n observations is ceil(share *
    n).

    Args:
        values: Distinct values, ascending.
        counts: Number of observations of each value.
        share: 0.99 for 99 %.

    Returns:
        The quantile, or 0 without observations.
    """
    seen = np.cumsum(counts)
    if not len(seen):
        return 0.0
    # The factor keeps a product such as 0.07 * 100 from rounding up to the next rank.
    return float(values[np.searchsorted(seen, share * seen[-1] * (1 - 1e-12))])


def median(values: Numbers, counts: Numbers) -> float:
    """Return the median of counted values (distinct, ascending), or 0 without values.

    The median of an even number is the mean of the two middle values.
    """
    seen = np.cumsum(counts)
    if not len(seen):
        return 0.0
    total = int(seen[-1])
    middle = values[np.searchsorted(seen, [(total - 1) // 2, total // 2], side="right")]
    return float(middle.sum()) / 2


def has_them_alone(own: int, others: int) -> bool:
    """Return whether one part has nearly all occurrences of a problem, so that a finding may name it.

    It needs at least ten occurrences, and ten times as many as all other parts together. The bounds are plain
    counts, so a sentence can quote them.
    """
    return own >= max(_FEWEST, _TIMES_MORE * others)
