"""Why a loop on simulated buses overran: late servos, the kernel, a late wake-up, or our own work.

A cycle that ended behind the next deadline is split into what its servos were late (by the ledger), how long
the kernel kept replies, what it woke late, and what its own work took beyond the median of all cycles. The
largest of them is the cause; but a cycle that would have overrun with all of them punctual, too, is our own.

- A servo's lateness counts as far as the loop waited for it: within the read, or in the idle time behind
  the deadline. Several buses are waited for at once, so the latest one counts.
- The kernel keeps a reply from when the servos' process has written it until the loop has it, beyond the
  median of this bus: a worker of the kernel carries the bytes through a pseudo-terminal, and it, or the loop,
  had no processor. Only where the log is what the ledger has, to the byte; else it counts as our own.
- What is left of the time between waking and the last write is our own: the controllers and the log, but
  also a time slice that another process took from us outside of such a wait.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.packets import PacketKind
from dxlrun.log.reader import Log
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.ledger.streams import logged, seen
from dxlrun_analysis.plan import LoggedBus, plan_of

Cause = Literal["simulation", "kernel", "wake-up", "own work"]
_BITS_A_BYTE = 10
Longs = NDArray[np.int64]
Sent = Sequence[tuple[int, int]]
"""When a host began to write, ns, and how many bytes; all that it wrote, in order."""
LATE_REPLY_NS = 1_000_000
"""A reply later than this can cost a loop its period [i]: at 1 kHz it is one."""


@dataclass(frozen=True, slots=True)
class Overrun:
    """A cycle that ended behind the next deadline; microseconds."""

    seconds: float
    """Since the log's first cycle."""
    skipped: int
    cause: Cause
    simulation_us: float
    kernel_us: float
    """Beyond the usual."""
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
    kernel: int
    wake_up: int
    own_work: int
    overruns: tuple[Overrun, ...]

    @property
    def own_share(self) -> float:
        """Overruns by our own work as a share of all cycles."""
        return self.own_work / self.cycles if self.cycles else 0.0


def overrun_causes(log: Log, by_bus: Mapping[str, Sequence[LedgerEntry]]) -> OverrunCauses | None:
    """Split every overrun of a log by the ledger of its buses; None where the log has no cycle."""
    cycles = log.cycles
    if not len(cycles):
        return None
    woken = cycles["woken_ns"].astype(np.int64)
    scheduled = cycles["scheduled_ns"].astype(np.int64)
    servos, idle, kept = _waited(log, by_bus)
    work = cycles["written_ns"].astype(np.int64) - woken - servos
    usual = int(np.median(work))
    kernel = np.clip(work - usual, 0, kept)
    work = work - kernel
    late = np.flatnonzero(cycles["skipped"] > 0) - 1  # the cycle before the periods that were left out
    late = late[late >= 0]
    overruns = tuple(
        _overrun(
            (int(woken[index]) - int(woken[0])) / 1e9,
            int(cycles["skipped"][index + 1]),
            (
                int(servos[index] + idle[index]),
                int(kernel[index]),
                int(woken[index] - scheduled[index] - idle[index]),
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
        kernel=count("kernel"),
        wake_up=count("wake-up"),
        own_work=count("own work"),
        overruns=overruns,
    )


def waits_for_servos(log: Log, by_bus: Mapping[str, Sequence[LedgerEntry]]) -> tuple[Longs, Longs]:
    """Return how long each cycle waited for late simulated servos, ns: in its read, behind its deadline."""
    in_read, in_idle, _ = _waited(log, by_bus)
    return in_read, in_idle


def _waited(log: Log, by_bus: Mapping[str, Sequence[LedgerEntry]]) -> tuple[Longs, Longs, Longs]:
    """Return as `waits_for_servos`, and how long the kernel kept replies from a cycle; of the latest bus."""
    cycles = log.cycles
    waits = _Waits(*(cycles[name].astype(np.int64) for name in ("scheduled_ns", "woken_ns", "read_ns")))
    servos, idle, kept = (np.zeros(len(cycles), np.int64) for _ in range(3))
    for index, name in enumerate(log.buses):
        found, kept_ns = _found(log, index, by_bus[name])
        in_read, in_idle = waits.late(found)
        servos, idle = np.maximum(servos, in_read), np.maximum(idle, in_idle)
        kept = np.maximum(kept, waits.kept(found, kept_ns))
    return servos, idle, kept


def _overrun(seconds: float, skipped: int, parts: tuple[int, int, int, int], *, too_long: bool) -> Overrun:
    simulation, kernel, wake_up, own = parts
    causes: tuple[Cause, ...] = ("own work", "wake-up", "kernel", "simulation")  # in doubt it is our own
    cause = "own work" if too_long else causes[int(np.argmax((own, wake_up, kernel, simulation)))]
    return Overrun(seconds, skipped, cause, *(part / 1e3 for part in parts))


def _found(log: Log, bus: int, entries: Sequence[LedgerEntry]) -> tuple[list[LedgerTransaction], Longs]:
    """Return what was answered on a bus, and how long the kernel kept the end of each answer, ns."""
    packets = sorted((p for p in log.packets if p.bus == bus), key=lambda packet: packet.first_ns)
    sent = [(p.first_ns, len(p.data)) for p in packets if p.kind is PacketKind.INSTRUCTION]
    rate = plan_of(log).by_name.get(log.buses[bus], LoggedBus()).baud_rate
    found = list(transactions(entries, sent, _BITS_A_BYTE * 1e9 / rate if rate else 0.0))
    got, given = logged(packets, "received"), seen(entries, "received")
    most = min(len(got.data), len(given.data))
    if not most or got.data[:most] != given.data[:most]:
        return found, np.zeros(len(found), np.int64)
    kept = [got.time_at(one.given - 1) - one.handed_ns if one.given <= most else 0 for one in found]
    return found, np.array(kept, np.int64)


@dataclass(frozen=True, slots=True)
class _Waits:
    """Cycles: in which of them, and in which part of it, something was waited for."""

    scheduled: Longs
    woken: Longs
    read: Longs

    def late(self, found: Iterable[LedgerTransaction]) -> tuple[Longs, Longs]:
        """Return how long each cycle waited for late servos of a bus: in its read, behind its deadline."""
        scheduled, woken = self.scheduled, self.woken
        in_read, in_idle = np.zeros(len(woken), np.int64), np.zeros(len(woken), np.int64)
        for one in found:
            index = int(np.searchsorted(woken, one.handed_ns, side="right")) - 1
            if index >= 0 and one.handed_ns <= self.read[index]:
                # a reply that was asked for in the cycle before was on its way already when this one woke
                in_read[index] += min(one.late_ns, one.handed_ns - int(woken[index]))
            elif index + 1 < len(woken) and one.handed_ns > scheduled[index + 1]:
                waited = min(one.late_ns, one.handed_ns - int(scheduled[index + 1]))
                in_idle[index + 1] = max(in_idle[index + 1], waited)
        return in_read, in_idle

    def kept(self, found: Sequence[LedgerTransaction], kept_ns: Longs) -> Longs:
        """Return how long the kernel kept answers of a bus from the read of each cycle, beyond the median."""
        in_read = np.zeros(len(self.woken), np.int64)
        if not found:
            return in_read
        beyond = np.maximum(kept_ns - int(np.median(kept_ns)), 0)
        handed = np.array([one.handed_ns for one in found], np.int64)
        index = np.searchsorted(self.woken, handed, side="right") - 1
        waited = (index >= 0) & (handed <= self.read[index])
        np.add.at(in_read, index[waited], beyond[waited])
        return in_read


# What a host waited for on a simulated bus
#
# A simulated servo is a process, so it takes an instruction later than a real one would, and hands its reply
# over later. The ledger records both:
#
# - `in`: when the bytes were taken. When the host wrote them is known only of hosts that record it. Bytes
#   that had to wait for the line anyway are not late.
# - `out`: how long after it had passed the wire a reply was handed over.
#
# Only what a host waits for counts: the last reply of a transaction, and the instruction before it.


@dataclass(frozen=True, slots=True)
class LedgerTransaction:
    """An instruction that was answered."""

    handed_ns: int
    """When the host was given the end of the last reply."""
    late_ns: int
    """How much sooner that could have been."""
    taken: int
    """Bytes that went to the servos until then, since the ledger began."""
    given: int
    """Bytes that came back."""


def transactions(entries: Sequence[LedgerEntry], sent: Sent, byte_ns: float) -> Iterator[LedgerTransaction]:
    """Yield what was answered on one bus; without `sent` only the replies' lateness counts."""
    written = _written(entries, sent)
    free_ns = could_be_free_ns = waited_ns = 0.0
    taken = given = 0
    last: LedgerEntry | None = None
    for number, entry in enumerate(entries):
        if entry.direction == "out":
            last = entry
            given += len(entry.data)
        elif entry.direction == "in":
            if last is not None:
                yield _answered(last, waited_ns, taken, given)
                last = None
            wire_ns = len(entry.data) * byte_ns
            could = max(min(written.get(number, entry.t_ns), entry.t_ns), could_be_free_ns)
            began = max(entry.t_ns, free_ns)
            waited_ns = began - could
            could_be_free_ns, free_ns = could + wire_ns, began + wire_ns
            taken += len(entry.data)
    if last is not None:
        yield _answered(last, waited_ns, taken, given)


def _answered(last: LedgerEntry, waited_ns: float, taken: int, given: int) -> LedgerTransaction:
    return LedgerTransaction(last.t_ns + last.late_ns, round(last.late_ns + waited_ns), taken, given)


def _written(entries: Sequence[LedgerEntry], sent: Sent) -> dict[int, int]:
    """Return by number of an `in` when the host began to write its first byte; {} when they do not match."""
    ends = np.cumsum([count for _, count in sent])
    taken = sum(len(entry.data) for entry in entries if entry.direction == "in")
    if not len(ends) or taken > ends[-1]:
        return {}
    found: dict[int, int] = {}
    offset = 0
    for number, entry in enumerate(entries):
        if entry.direction == "in":
            found[number] = sent[int(np.searchsorted(ends, offset, side="right"))][0]
            offset += len(entry.data)
    return found


# How late the replies were over the whole run


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
    """Those of them in whose time a delivery was later than 1 ms: the simulation may be the cause."""


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
    handed_over = np.sort(handed_ns[late > LATE_REPLY_NS])
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
