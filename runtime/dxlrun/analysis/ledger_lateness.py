"""How late the simulated buses were themselves, and whether that is why the loop overran."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dxlrun.recording.reader import Log
from dxlrun.simulation import LedgerEntry

ROUGH_NS = 1_000_000
"""A reply later than this can cost a loop its period [i]: at 1 kHz it is one."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """How long after it was due the host got what the simulated servos sent, us; zero on virtual time."""

    deliveries: int
    median_us: float
    p99_us: float
    max_us: float
    rough: int
    """Deliveries that were later than 1 ms."""
    overruns: int
    """Cycles of the loop before which periods were skipped."""
    overruns_beside: int
    """Those of them in whose time a delivery was later than 1 ms: the simulation may be why."""


def lateness(log: Log, entries: Iterable[LedgerEntry]) -> Lateness | None:
    """Return how late the buses were; None where the ledger has no delivery. `entries` of the run."""
    out = [entry for entry in entries if entry.direction == "out"]
    if not out:
        return None
    late = np.array([entry.late_ns for entry in out], np.int64)
    handed_over = np.sort(np.array([e.t_ns + e.late_ns for e in out if e.late_ns > ROUGH_NS], np.int64))
    after = log.cycles[log.cycles["skipped"] > 0]
    begins = after["scheduled_ns"] - (after["skipped"] + 1).astype(np.int64) * log.period_ns
    beside = np.searchsorted(handed_over, after["woken_ns"], side="right") > np.searchsorted(
        handed_over, begins, side="left"
    )
    median, p99 = np.percentile(late, [50, 99])
    return Lateness(
        deliveries=len(out),
        median_us=float(median) / 1e3,
        p99_us=float(p99) / 1e3,
        max_us=float(late.max()) / 1e3,
        rough=len(handed_over),
        overruns=len(after),
        overruns_beside=int(beside.sum()),
    )
