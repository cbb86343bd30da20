"""Exact quantiles of integers, from the count of each distinct value.

`quantile` and `median` define every percentile that is shown (docs/reference/analyze.md).
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_int64, c_void_p
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dxlrun.tooling.compiled_code import load_compiled, parse_structs

Numbers = NDArray[np.int64]

SOURCE = Path(__file__).with_name("counts.c")
_TABLE = parse_structs(SOURCE.read_text())["Table"]
_GROUP = 40  # Low bits of a key hold the value, shifted to be non-negative; the bits above hold its group
_ZERO = 1 << (_GROUP - 1)
_FEWEST_SLOTS = 1 << 10
_FEWEST = 10  # Fewer occurrences can be a coincidence
_TIMES_MORE = 10


class Counts:
    """Counter of each distinct integer value in several groups, for example reply times in us by servo."""

    def __init__(self) -> None:
        self._resize(_FEWEST_SLOTS)
        self._sorted: tuple[Numbers, Numbers] | None = None  # Keys, ascending, and the count of each

    def _resize(self, slots: int) -> None:
        self._slots = np.zeros((2, slots), np.int64)  # Keys and counts
        keys, counts = (row.ctypes.data for row in self._slots)
        self._table = _TABLE(keys=keys, counts=counts, slots=slots, bits=_GROUP)

    def count_values(self, group: Numbers, value: Numbers) -> None:
        """Count values in their groups.

        Args:
            group: Group of each value, 0 to 2^22, or less than 0 to skip it; shape (values,).
            value: Values to count; shape (values,).
        """
        self._sorted, done = None, 0
        group, value = (np.ascontiguousarray(each, np.int64) for each in (group, value))
        while done < len(value):
            rest = group[done:].ctypes.data, value[done:].ctypes.data, len(value) - done
            done += _library().counts_add(byref(self._table), *rest)
            if 2 * self._table.used >= self._slots.shape[1]:
                full, slots = self._table, self._slots
                self._resize(2 * slots.shape[1])
                _library().counts_merge(byref(self._table), byref(full))

    def _ascending(self) -> tuple[Numbers, Numbers]:
        if self._sorted is None:
            keys, counts = self._slots[:, self._slots[1] > 0]
            order = np.argsort(keys)
            self._sorted = keys[order], counts[order]
        return self._sorted

    def counts_of(self, group: int) -> tuple[Numbers, Numbers]:
        """Return the distinct values that were counted in a group, ascending, and the count of each value."""
        keys, counts = self._ascending()
        begin, end = np.searchsorted(keys, [group << _GROUP, (group + 1) << _GROUP])
        return keys[begin:end] - (group << _GROUP) - _ZERO, counts[begin:end]

    @property
    def groups(self) -> list[int]:
        """Numbers of the groups that have values, ascending."""
        return sorted(set((self._ascending()[0] >> _GROUP).tolist()))


@cache
def _library() -> ctypes.CDLL:
    found = load_compiled(SOURCE, ctypes.CDLL)
    found.counts_add.argtypes, found.counts_add.restype = (c_void_p, c_void_p, c_void_p, c_int64), c_int64
    found.counts_merge.argtypes, found.counts_merge.restype = (c_void_p, c_void_p), None
    return found


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
