"""Shares of causes in cycles' excess time: collected as columns, summed by cause."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun_analysis.cycles.worst import CauseKind

Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class CauseName:
    """What tells causes apart; a servo by its ID, -1 where the cause is none."""

    kind: CauseKind
    subject: str = ""
    bus: int = -1
    servo_id: int = -1


class CauseNames:
    """Numbers for causes, in the order in which they came first."""

    __slots__ = ("_numbers", "latest", "names")

    def __init__(self) -> None:
        self.names: list[CauseName] = []
        self.latest: Counter[tuple[int, int]] = Counter()
        """In how many cycles which servo had the latest reply of its bus, by bus and ID; -1: it does not tell
        whose it was."""
        self._numbers: dict[CauseName, int] = {}

    def number(self, name: CauseName) -> int:
        """Return the number of a cause."""
        if name not in self._numbers:
            self._numbers[name] = len(self.names)
            self.names.append(name)
        return self._numbers[name]


class Shares:
    """What causes have of the excess of some cycles, piece by piece."""

    __slots__ = ("_pieces", "names")

    def __init__(self, names: CauseNames) -> None:
        self.names = names
        self._pieces: list[tuple[Numbers, Numbers, Numbers]] = []

    def add(self, name: CauseName, rows: Numbers, ns: Numbers) -> None:
        """Add what one cause has of cycles, by their rows; a row may come several times."""
        if len(rows):
            self.add_many(np.full(len(rows), self.names.number(name)), rows, ns)

    def add_many(self, causes: Numbers, rows: Numbers, ns: Numbers) -> None:
        """Add what causes, by their numbers, have of cycles, by their rows."""
        there = ns > 0
        self._pieces.append((causes[there], rows[there], ns[there]))

    def summed(self) -> tuple[Numbers, Numbers, Numbers]:
        """Return cause, row and ns, each pair of cause and row once; by rows, the largest share first."""
        if not self._pieces:
            return (np.zeros(0, np.int64),) * 3
        causes, rows, ns = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        count = max(len(self.names.names), 1)
        keys, inverse = np.unique(rows * count + causes, return_inverse=True)
        total = np.zeros(len(keys), np.int64)
        np.add.at(total, inverse, ns)
        order = np.lexsort((-total, keys // count))
        keys, total = keys[order], total[order]
        return keys % count, keys // count, total
