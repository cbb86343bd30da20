"""The time axis of a run, and the cycles that stand out on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.analysis.latency import ROUGH_NS, first_deadline_ns
from dxlrun.interfaces import Floats
from dxlrun.log.reader import Log


def run_time_s(log: Log) -> Floats:
    """Return the time of each cycle's deadline since the loop's first, s."""
    times: Floats = (log.cycles["scheduled_ns"] - first_deadline_ns(log)) / 1e9
    return times


@dataclass(frozen=True, slots=True)
class Marks:
    """Cycles in which one joint's samples have to be read with care; shape (cycles,) each."""

    late: NDArray[np.bool_]
    """Woke later than 150 us after the deadline."""
    skipped: NDArray[np.bool_]
    """At least one period was skipped right before."""
    silent: NDArray[np.bool_]
    """No intact reply: the state is an old one."""
    clamped: NDArray[np.bool_]
    """The last gate changed the command."""

    @classmethod
    def of(cls, log: Log, row: int) -> Marks:
        """Return the marks of the joint in this row."""
        cycles = log.cycles
        return cls(
            late=(cycles["woken_ns"] - cycles["scheduled_ns"]) > ROUGH_NS,
            skipped=cycles["skipped"] > 0,
            silent=~cycles["valid"][:, row],
            clamped=cycles["clamped"][:, row] != 0,
        )
