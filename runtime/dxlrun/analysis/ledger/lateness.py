"""How late the simulated buses were themselves, and whether that is why the loop overran."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dxlrun.log.reader import Log
from dxlrun.simulation import LedgerEntry

ROUGH_NS = 1_000_000
"""A reply later than this can cost a loop its period [i]: at 1 kHz it is one."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """How long after it was due the host got what the simulated servos sent, us; zero on virtual time.

    Of answers that it got together the last one counts: the others waited for it.
    """

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
    late_ns: dict[tuple[str, int], int] = {}
    for entry in entries:
        if entry.direction == "out":
            handed = (entry.bus, entry.t_ns + entry.late_ns)
            late_ns[handed] = min(late_ns.get(handed, entry.late_ns), entry.late_ns)
    if not late_ns:
        return None
    late = np.array(list(late_ns.values()), np.int64)
    handed_ns = np.array([at_ns for _, at_ns in late_ns], np.int64)
    handed_over = np.sort(handed_ns[late > ROUGH_NS])
    after = log.cycles[log.cycles["skipped"] > 0]
    begins = after["scheduled_ns"] - (after["skipped"] + 1).astype(np.int64) * log.period_ns
    beside = np.searchsorted(handed_over, after["woken_ns"], side="right") > np.searchsorted(
        handed_over, begins, side="left"
    )
    median, p99 = np.percentile(late, [50, 99])
    return Lateness(
        deliveries=len(late),
        median_us=float(median) / 1e3,
        p99_us=float(p99) / 1e3,
        max_us=float(late.max()) / 1e3,
        rough=len(handed_over),
        overruns=len(after),
        overruns_beside=int(beside.sum()),
    )
