"""Why a loop on simulated buses overran: late servos, a late wake-up, or our own work.

A cycle that ended behind the next deadline is split into what its servos were late (by the ledger), what it
woke late, and what its own work took beyond the median of all cycles. The largest of them is the cause; but a
cycle that would have overrun with punctual servos and a punctual wake-up, too, is our own.

- A servo's lateness counts as far as the loop waited for it: within the read, or in the gap behind the
  deadline. Several buses are waited for at once, so the latest one counts.
- What is left of the time between waking and the last write is our own: the controllers and the log, but
  also a time slice that another process took from us.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.analysis.ledger_waits import Transaction, transactions
from dxlrun.packets import PacketKind
from dxlrun.recording.reader import Log
from dxlrun.simulation import LedgerEntry

Cause = Literal["simulation", "wake-up", "own work"]
_BITS_A_BYTE = 10
Longs = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Overrun:
    """A cycle that ended behind the next deadline; microseconds."""

    seconds: float
    """Since the log's first cycle."""
    skipped: int
    cause: Cause
    simulation_us: float
    wake_up_us: float
    own_us: float
    """Beyond the usual."""


@dataclass(frozen=True, slots=True)
class OverrunCauses:
    """All overruns of a run on simulated buses."""

    cycles: int
    usual_us: float
    """Median of what a cycle takes from waking to its last write, without the servos' lateness."""
    simulation: int
    """Overruns whose cause is the simulation."""
    wake_up: int
    own_work: int
    overruns: tuple[Overrun, ...]

    @property
    def own_share(self) -> float:
        """Overruns by our own work as a share of all cycles."""
        return self.own_work / self.cycles if self.cycles else 0.0


def overrun_causes(log: Log, by_bus: Mapping[str, Sequence[LedgerEntry]]) -> OverrunCauses | None:
    """Split every overrun of a log by the ledger of its buses; None where the log has no cycle."""
    cycles, rates = log.cycles, _baud_rates(log)
    if not len(cycles):
        return None
    woken = cycles["woken_ns"].astype(np.int64)
    scheduled = cycles["scheduled_ns"].astype(np.int64)
    servos, gap = np.zeros(len(cycles), np.int64), np.zeros(len(cycles), np.int64)
    for index, name in enumerate(log.buses):
        sent = [
            (packet.first_ns, len(packet.data))
            for packet in sorted(
                (p for p in log.packets if p.bus == index and p.kind is PacketKind.INSTRUCTION),
                key=lambda packet: packet.first_ns,
            )
        ]
        byte_ns = _BITS_A_BYTE * 1e9 / rates[name] if rates.get(name) else 0.0
        found = transactions(by_bus[name], sent, byte_ns)
        in_read, in_gap = _waited(found, scheduled, woken, cycles["read_ns"].astype(np.int64))
        servos, gap = np.maximum(servos, in_read), np.maximum(gap, in_gap)
    work = cycles["written_ns"].astype(np.int64) - woken - servos
    usual = int(np.median(work))
    late = np.flatnonzero(cycles["skipped"] > 0) - 1  # the cycle before the periods that were left out
    late = late[late >= 0]
    overruns = tuple(
        _overrun(
            (int(woken[index]) - int(woken[0])) / 1e9,
            int(cycles["skipped"][index + 1]),
            (
                int(servos[index] + gap[index]),
                int(woken[index] - scheduled[index] - gap[index]),
                int(work[index]) - usual,
            ),
            too_long=bool(work[index] > log.period_ns),
        )
        for index in late
    )
    count = [one.cause for one in overruns].count
    return OverrunCauses(
        cycles=len(cycles),
        usual_us=usual / 1e3,
        simulation=count("simulation"),
        wake_up=count("wake-up"),
        own_work=count("own work"),
        overruns=overruns,
    )


class _Bus(msgspec.Struct):
    name: str
    baud_rate: int = 0


class _Plan(msgspec.Struct):
    buses: list[_Bus] = []


def _baud_rates(log: Log) -> dict[str, int]:
    """Return the rate of each bus by the log's plan; a log without one leaves waiting for the line unseen."""
    try:
        plan = msgspec.json.decode(log.attachments.get("plan.json", b"{}"), type=_Plan)
    except msgspec.MsgspecError:
        return {}
    return {bus.name: bus.baud_rate for bus in plan.buses}


def _overrun(seconds: float, skipped: int, parts: tuple[int, int, int], *, too_long: bool) -> Overrun:
    simulation, wake_up, own = parts
    causes: tuple[Cause, ...] = ("own work", "wake-up", "simulation")  # in doubt it is our own
    cause = "own work" if too_long else causes[int(np.argmax((own, wake_up, simulation)))]
    return Overrun(seconds, skipped, cause, simulation / 1e3, wake_up / 1e3, own / 1e3)


def _waited(found: Iterable[Transaction], scheduled: Longs, woken: Longs, read: Longs) -> tuple[Longs, Longs]:
    """Return how long each cycle waited for late servos of one bus: in its read, and behind its deadline."""
    in_read, in_gap = np.zeros(len(woken), np.int64), np.zeros(len(woken), np.int64)
    for one in found:
        index = int(np.searchsorted(woken, one.handed_ns, side="right")) - 1
        if index >= 0 and one.handed_ns <= read[index]:
            # a reply that was asked for in the cycle before was on its way already when this one woke
            in_read[index] += min(one.late_ns, one.handed_ns - int(woken[index]))
        elif index + 1 < len(woken) and one.handed_ns > scheduled[index + 1]:
            waited = min(one.late_ns, one.handed_ns - int(scheduled[index + 1]))
            in_gap[index + 1] = max(in_gap[index + 1], waited)
    return in_read, in_gap
