"""Why cycles were late or too long: their excess time split over causes, from packets and plan alone.

Two kinds of cycles are looked at:

- *late*: woken more than 150 us (ROUGH_NS) after it could begin. Its excess is that lateness.
- *long*: it took longer than its period, or ended so late that periods were skipped behind it. Its excess is
  its lateness and all that it took beyond its planned exchanges (at most a period): late and missing replies,
  write() calls, controllers, own work. So its shares say where its time went, not only what was too much.

The shares of a cycle add up to its excess; what no rule explains is a share of its own. Late wake-ups, and
own work, are the machine's as far as a sample of /machine of that second has the time: steal first, then what
the loop was runnable without a core, then interrupts.

A single late reply does not tell whether servo, adapter, kernel or simulation kept it: it is the bus'. A
servo is named where it had the latest reply of its bus in ten cycles at least, and ten times as often as all
others together.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.errors import counted
from dxlrun.log.columns import PacketColumns
from dxlrun.log.reader import Log
from dxlrun_analysis.causes.machine import TAKERS, MachineHistory, MachineLoad, MachineSample
from dxlrun_analysis.causes.shares import CauseName, CauseNames, Shares
from dxlrun_analysis.causes.timeline import timeline
from dxlrun_analysis.causes.waits import BusWaits, Rows, joined_rows
from dxlrun_analysis.counts import has_them_alone
from dxlrun_analysis.cycles.latency import DISORDER_NS, ROUGH_NS, begins, first_deadline_ns
from dxlrun_analysis.cycles.worst import Cause, CauseKind, CauseShare, WorstCycle
from dxlrun_analysis.plan import LoggedBus, plan_of

WORST = 10
"""So many of the worst cycles are kept."""
AT_ONCE = 4096
"""Cycles that are looked at together, at least: slices of a log may be small."""
_SAMPLE_NS = 2_000_000_000
"""A sample of the machine comes at most so long after the cycles that it is about."""
_LATE, _OWN = CauseName("late wake-up"), CauseName("own work")
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Causes:
    """All late and long cycles of a run."""

    late: int = 0
    """Cycles that woke late, long ones too."""
    long: int = 0
    """Cycles that took longer than their period, or ended so late that periods were skipped."""
    excess_ns: int = 0
    """Of all of them; the sum of the causes."""
    causes: tuple[Cause, ...] = ()
    """The largest first."""
    worst: tuple[WorstCycle, ...] = ()
    """The worst first."""
    throttled: int = 0
    """Samples of the machine with a core that was hot and slow."""
    load: MachineLoad = field(default_factory=MachineLoad)


NO_CAUSES = Causes()


class _Named(NamedTuple):
    """What a cause is called once all late replies are known; as in Cause."""

    kind: CauseKind
    subject: str
    servo: str = ""
    evidence: str = ""


@dataclass(slots=True)
class _Sum:
    cycles: int = 0
    total_ns: int = 0
    worst_ns: int = 0
    long_ns: int = 0

    def take(self, ns: Numbers, long: Flags) -> None:
        """Add what a cause has of different cycles."""
        if len(ns):
            self.add(_Sum(int((ns > 0).sum()), int(ns.sum()), int(ns.max()), int(ns[long].sum())))

    def add(self, other: _Sum) -> None:
        """Add another one; cycles that both have count twice."""
        self.cycles += other.cycles
        self.total_ns += other.total_ns
        self.worst_ns = max(self.worst_ns, other.worst_ns)
        self.long_ns += other.long_ns


@dataclass(frozen=True, slots=True)
class _Kept:
    """A cycle that may be one of the worst, and its shares by the causes' numbers, ns."""

    cycle: WorstCycle
    woken_ns: int
    shares: tuple[tuple[int, int], ...]
    excess_ns: int


@dataclass(slots=True)
class _Pending:
    """Shares of one cause that may be the machine's, until the sample of that second comes."""

    name: CauseName
    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """Time, ns, and 1 for a long cycle."""

    def add(self, t_ns: Numbers, ns: Numbers, long: Flags) -> None:
        self.rows = np.concatenate([self.rows, np.stack([t_ns, ns, long], axis=1)])

    def pop(self, begin_ns: int, end_ns: int) -> tuple[Numbers, Flags]:
        """Return those of a time, and which of them are of long cycles, and forget them."""
        mine = (self.rows[:, 0] > begin_ns) & (self.rows[:, 0] <= end_ns)
        found, self.rows = self.rows[mine], self.rows[~mine]
        return found[:, 1], found[:, 2] > 0


class CycleCauses:
    """Finds the causes slice by slice of a log, in memory that does not grow with it."""

    __slots__ = (
        "_before",
        "_begin_ns",
        "_buses",
        "_controllers",
        "_cycles",
        "_late",
        "_long",
        "_machine",
        "_names",
        "_packets",
        "_parts",
        "_pending",
        "_samples",
        "_sequential",
        "_sums",
        "_waiting",
        "_waits",
        "_worst",
    )

    def __init__(self) -> None:
        self._names = CauseNames()
        self._sums: defaultdict[int, _Sum] = defaultdict(_Sum)
        self._late = self._long = 0
        self._sequential = False
        self._cycles: list[Rows] = []
        """Cycles whose packets may not be complete yet."""
        self._waiting = 0
        """How many."""
        self._before: Rows | None = None
        """The cycle before them."""
        self._packets: list[PacketColumns] = []
        self._buses: tuple[LoggedBus, ...] = ()
        self._controllers: tuple[str, ...] = ()
        self._waits: BusWaits | None = None
        self._machine = MachineHistory()
        self._samples: list[MachineSample] = []
        """About cycles that were not looked at yet."""
        self._pending = (_Pending(_LATE), _Pending(_OWN))
        self._parts: list[tuple[int, int, tuple[tuple[float, ...], ...]]] = []
        """Times that a sample is about, and which shares of late wake-ups and own work each taker had."""
        self._worst: list[_Kept] = []
        self._begin_ns: int | None = None

    def take(self, log: Log) -> None:
        """Take the next slice. Raises LogError when a packet in it cannot be read."""
        if self._waits is None:
            planned = plan_of(log).by_name
            self._buses = tuple(planned.get(name, LoggedBus(name)) for name in log.buses)
            self._controllers = tuple(controller.name for controller in log.controllers)
            self._sequential = plan_of(log).loop.schedule == "sequential"
            self._waits = BusWaits(self._buses)
        if self._begin_ns is None and begins(log):
            self._begin_ns = first_deadline_ns(log)
        self._cycles.append(_rows(log))
        self._waiting += len(log.cycles)
        if len(log.packets):
            self._packets.append(log.packets)
        self._samples += self._machine.new(log, self._begin_ns)
        if self._waiting >= AT_ONCE:
            self._advance(final=False)
            self._settle()

    def finish(self) -> Causes:
        """Return the causes of the whole run."""
        self._advance(final=True)
        self._settle(final=True)
        named = self._named()
        sums: defaultdict[_Named, _Sum] = defaultdict(_Sum)
        for number, one in list(self._sums.items()):
            sums[named[number]].add(one)
        causes = [
            Cause(kind, subject, one.cycles, one.total_ns, one.worst_ns, one.long_ns, servo, evidence)
            for (kind, subject, servo, evidence), one in sums.items()
            if one.total_ns
        ]
        return Causes(
            self._late,
            self._long,
            sum(one.total_ns for one in causes),
            tuple(sorted(causes, key=lambda one: -one.total_ns)),
            tuple(self._final(kept, named) for kept in self._worst),
            self._machine.slow,
            self._machine.load,
        )

    def _certain(self, rows: Rows) -> int:
        """Return how many of the waiting cycles have all their packets, and a cycle behind them."""
        if len(rows) < 2:
            return 0
        newest_ns = int(self._packets[-1].last_ns.max()) if self._packets else 0
        over = int(np.searchsorted(rows.written, rows.written[-1] - DISORDER_NS))
        return min(len(rows) - 1, max(int(np.searchsorted(rows.written, newest_ns)), over))

    def _advance(self, *, final: bool) -> None:
        """Look at the waiting cycles that have all their packets, and forget them and their packets."""
        if not self._waiting:
            return
        waiting = joined_rows(self._cycles)
        count = len(waiting) if final else self._certain(waiting)
        if not count:
            return
        ready, behind = waiting.take(slice(count)), waiting.take(slice(1, count + 1))
        followed = len(behind)
        # what was skipped behind a cycle is declared by the next one
        skipped, period = np.zeros(count, np.int64), ready.period.copy()
        skipped[:followed] = behind.skipped
        counted_from = ready.woken if self._sequential else ready.scheduled
        between = behind.scheduled - counted_from[:followed]
        between //= np.maximum(behind.cycle - ready.cycle[:followed], 1)
        period[:followed] = np.where(between > 0, between, period[:followed])
        self._cycles = [waiting.take(slice(count, None))]
        self._waiting -= count
        ready = replace(ready, skipped=skipped, period=period)
        rows = ready if self._before is None else joined_rows((self._before, ready))
        self._look(rows, new=len(rows) - count)
        self._before = rows.take(slice(-1, None))
        from_ns = int(rows.woken[-1])
        kept = [part.take(part.last_ns >= from_ns) for part in self._packets]
        self._packets = [part.compact() for part in kept if len(part)]

    def _look(self, rows: Rows, new: int) -> None:
        """Split the excess of the cycles from row `new` on."""
        late_ns, took = rows.late, rows.written - rows.woken
        late = late_ns > ROUGH_NS
        over = rows.written > rows.scheduled + rows.period
        long = (took > rows.period) | (over & (rows.skipped > 0))
        late[:new] = long[:new] = False
        bad = late | long
        if self._waits is None or not bad.any():
            return
        shares = Shares(self._names)
        packets = PacketColumns.joined(self._packets)
        waits = self._waits.split(rows, long, bad, self._wanted(rows, long, bad, packets), shares)
        at = np.flatnonzero(long)
        within = np.minimum(waits.planned, rows.period)
        excess = np.where(bad, late_ns, 0) + np.where(long, took - within, 0)
        shares.add(CauseName("plan"), at, (waits.planned - within)[at])
        for index, name in enumerate(self._controllers):
            shares.add(CauseName("controller", name), at, rows.controllers[at, index])
        own = took - waits.exchanged - waits.writes - rows.controllers.sum(axis=1)
        shares.add(_OWN, at, own[at])
        at = np.flatnonzero(bad)
        shares.add(_LATE, at, (late_ns - waits.idle)[at])
        self._late += int(late.sum())
        self._long += int(long.sum())
        self._count(rows, excess, long, shares, packets)

    def _wanted(self, rows: Rows, long: Flags, bad: Flags, packets: PacketColumns) -> PacketColumns:
        """Return the packets of long cycles, and those behind the read of the cycle before a bad one."""
        row = np.searchsorted(rows.woken, packets.first_ns, side="right") - 1
        before = np.append(bad[1:], False)[row] & (packets.first_ns > rows.read[row])
        return packets.take((row >= 0) & (long[row] | before))

    def _count(
        self, rows: Rows, excess: Numbers, long: Flags, shares: Shares, packets: PacketColumns
    ) -> None:
        causes, row, ns = shares.summed()
        explained = np.zeros(len(rows), np.int64)
        np.add.at(explained, row, ns)
        if (explained < excess).any():
            at = np.flatnonzero(explained < excess)
            shares.add(CauseName("unexplained"), at, (excess - explained)[at])
            causes, row, ns = shares.summed()
        excess = np.maximum(excess, explained)
        may_be_machine = {self._names.number(one.name): one for one in self._pending}
        for number in np.unique(causes).tolist():
            mine = causes == number
            if number in may_be_machine:
                may_be_machine[number].add(rows.woken[row[mine]], ns[mine], long[row[mine]])
            else:
                self._sums[number].take(ns[mine], long[row[mine]])
        self._keep_worst(rows, excess, (causes, row, ns), packets)

    # Whose late replies are

    def _named(self) -> list[_Named]:
        """Return what each cause is called, now that all late replies are known."""
        return [self._name(one) for one in self._names.names]

    def _name(self, one: CauseName) -> _Named:
        if one.bus < 0:
            return _Named(one.kind, one.subject)
        bus, servo, evidence = self._buses[one.bus], one.servo_id, ""
        if one.kind == "late reply":
            servo, evidence = self._latest(one.bus)
        if servo < 0:
            return _Named(one.kind, f"bus {bus.name}", "", evidence)
        joint = bus.names.get(servo, "")
        return _Named(
            one.kind, f"servo {servo} ({joint or bus.name})", joint or f"{bus.name} {servo}", evidence
        )

    def _latest(self, bus: int) -> tuple[int, str]:
        """Return the servo of a bus that has its late replies, -1: none has, and how many are whose."""
        counts = {servo: count for (of, servo), count in self._names.latest.items() if of == bus}
        total, others = sum(counts.values()), len(self._buses[bus].names) - 1
        servo, most = max(counts.items(), key=lambda item: item[1], default=(-1, 0))
        if others < 1:
            return -1, "it has one servo, so the log does not show whether that or the adapter is late"
        if servo < 0 or not has_them_alone(most, total - most):
            return -1, "no servo has them alone, and the log does not show why they were"
        text = f"it had the latest reply in {most} of {counted(total, 'cycle', 'cycles')}"
        return servo, f"{text}, the other {counted(others, 'servo', 'servos')} in {total - most}"

    # What the machine has of it

    def _settle(self, *, final: bool = False) -> None:
        """Give the machine its part of what is waiting, as far as samples of that time came."""
        looked_at_ns = int(self._before.woken[-1]) if self._before is not None else 0
        while self._samples and (final or self._samples[0].end_ns <= looked_at_ns):
            self._share(self._samples.pop(0))
        for pending in self._pending:
            until_ns = looked_at_ns + _SAMPLE_NS if final else looked_at_ns - DISORDER_NS - _SAMPLE_NS
            self._sums[self._names.number(pending.name)].take(*pending.pop(0, until_ns))

    def _share(self, sample: MachineSample) -> None:
        """Let what took the loop's core have what was late in the time of a sample, as far as it goes."""
        left = list(sample.taken_ns)
        parts: list[tuple[float, ...]] = []
        for pending in self._pending:
            ns, long = pending.pop(sample.begin_ns, sample.end_ns)
            total = int(ns.sum())
            given: list[int] = []
            for index, budget in enumerate(left):
                given.append(min(budget, total - sum(given)))
                left[index] -= given[-1]
            parts.append(tuple(one / total if total else 0.0 for one in given))
            remaining = ns.copy()
            for taker, part in zip(TAKERS, parts[-1], strict=True):
                taken = (ns * part).astype(np.int64)
                self._sums[self._names.number(CauseName("machine", taker))].take(taken, long)
                remaining -= taken
            self._sums[self._names.number(pending.name)].take(remaining, long)
        if any(map(any, parts)):
            self._parts.append((sample.begin_ns, sample.end_ns, tuple(parts)))

    # The worst cycles

    def _keep_worst(
        self,
        rows: Rows,
        excess: Numbers,
        shares: tuple[Numbers, Numbers, Numbers],
        packets: PacketColumns,
    ) -> None:
        least = self._worst[-1].excess_ns if len(self._worst) == WORST else 0
        candidates = np.argsort(-excess, kind="stable")[:WORST]
        causes, row, ns = shares
        for index in candidates[excess[candidates] > least].tolist():
            begin, end = np.searchsorted(row, [index, index + 1])
            pairs = zip(causes[begin:end].tolist(), ns[begin:end].tolist(), strict=True)
            cycle = self._cycle(rows, index, packets)
            self._worst.append(_Kept(cycle, int(rows.woken[index]), tuple(pairs), int(excess[index])))
        self._worst = sorted(self._worst, key=lambda one: -one.excess_ns)[:WORST]

    def _cycle(self, rows: Rows, index: int, packets: PacketColumns) -> WorstCycle:
        scheduled = int(rows.scheduled[index])
        begin = int(rows.written[index - 1]) if index else scheduled - int(rows.period[index])
        mine = (packets.first_ns >= begin) & (packets.first_ns <= rows.written[index])
        return WorstCycle(
            cycle=int(rows.cycle[index]),
            seconds=(scheduled - (self._begin_ns or 0)) / 1e9,
            scheduled_ns=scheduled,
            period_us=int(rows.period[index]) / 1e3,
            woken_us=(int(rows.woken[index]) - scheduled) / 1e3,
            read_us=(int(rows.read[index]) - scheduled) / 1e3,
            updated_us=(int(rows.updated[index]) - scheduled) / 1e3,
            written_us=(int(rows.written[index]) - scheduled) / 1e3,
            skipped=int(rows.skipped[index]),
            excess_us=0.0,
            causes=(),
            packets=tuple(timeline(packets.take(mine), self._buses, scheduled)),
        )

    def _final(self, kept: _Kept, named: list[_Named]) -> WorstCycle:
        """Return one of the worst cycles with its causes, those of the machine too."""
        found: defaultdict[_Named, float] = defaultdict(float)
        taken = next((parts for begin, end, parts in self._parts if begin < kept.woken_ns <= end), ())
        parts = dict(zip((one.name for one in self._pending), taken, strict=False))
        for number, ns in kept.shares:
            rest = float(ns)
            for taker, part in zip(TAKERS, parts.get(self._names.names[number], ()), strict=False):
                found[_Named("machine", taker)] += ns * part
                rest -= ns * part
            found[named[number]] += rest
        shares = [CauseShare(kind, subject, ns / 1e3) for (kind, subject, *_), ns in found.items() if ns >= 1]
        shares.sort(key=lambda one: -one.us)
        return replace(kept.cycle, excess_us=kept.excess_ns / 1e3, causes=tuple(shares))


def _rows(log: Log) -> Rows:
    cycles = log.cycles
    times = ("scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns")
    scheduled, woken, read, updated, written = (cycles[name].copy() for name in times)
    return Rows(
        cycles["cycle"].copy(),
        scheduled,
        woken,
        read,
        updated,
        written,
        np.full(len(cycles), log.period_ns, np.int64),
        cycles["skipped"].copy(),
        cycles["controller_ns"].copy(),
    )
