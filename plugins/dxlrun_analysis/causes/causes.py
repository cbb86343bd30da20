"""Causes of late and long cycles, derived from the packets and the plan in a log.

There are two kinds of cycles:

- *late*: woken more than 150 us (ROUGH_NS) after it could begin. Its excess is that lateness.
- *long*: took longer than its period, or ended so late that the following periods were skipped. Its excess
  is its lateness and all time beyond its planned exchanges (at most a period): late and missing replies,
  write() calls, controllers, own work. The shares therefore show where its time went, not only by how much it
  was too long.

All late and long cycles are counted; the 200 worst are kept with their packets, and split by `Account`. Late
wake-ups and own work are attributed to the machine as far as a sample of /machine of that second accounts for
the time: steal first, then time in which the loop was runnable without a core, then interrupts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.logs import PacketColumns
from dxlrun.tooling.records import MachineLoad
from dxlrun_analysis.causes.account import Account, CauseName
from dxlrun_analysis.causes.machine_history import TAKERS, MachineHistory, MachineSample
from dxlrun_analysis.causes.timeline import timeline
from dxlrun_analysis.cycles.punctuality import ROUGH_NS, begins, first_deadline_ns
from dxlrun_analysis.cycles.worst_cycles import Cause, CauseShare, WorstCycle
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlrun_analysis.servos.exchanges import Pairing

KEPT = 200
"""Number of the worst late and long cycles whose excess is split by cause."""
WORST = 10
"""Number of the worst late and long cycles that are reported with their packets."""
_MACHINE = (CauseName("late wake-up"), CauseName("own work"))
"""Causes whose time is moved to the machine if a sample of /machine explains it, in this order."""
_TIMES = ("scheduled", "woken", "read", "updated", "written")
Cycles = NDArray[np.void]


@dataclass(frozen=True, slots=True)
class Causes:
    """Result of the cause analysis of a run: late and long cycles, causes, load of the machine."""

    late: int = 0  # Cycles that woke late, including long ones
    long: int = 0  # Cycles longer than their period, or so late that periods were skipped
    excess_ns: int = 0  # Excess of the kept cycles; the sum of all causes
    causes: tuple[Cause, ...] = ()  # Largest first
    worst: tuple[WorstCycle, ...] = ()  # Worst first
    throttled: int = 0  # Samples of the machine with a core that was hot and slow
    load: MachineLoad = field(default_factory=MachineLoad)


NO_CAUSES = Causes()
"""Result for a log without late or long cycles."""


class _WorstCycleCandidate(NamedTuple):
    """One of the worst late or long cycles so far, with the packets from the preceding cycle's read on."""

    cycle: np.void
    before: np.void | None  # The preceding cycle; None for the first
    packets: PacketColumns


class CycleCauses:
    """Accumulator that finds late and long cycles and their causes, fed slice by slice in constant memory."""

    def __init__(self) -> None:
        self._late = self._long = 0
        self._sequential = False
        # Held back: the next cycle declares the periods skipped after this one.
        self._newest: Cycles | None = None
        self._before: Cycles | None = None  # Cycle before `_newest`
        self._packets: list[PacketColumns] = []  # Packets since the read of `_before`
        self._buses: tuple[LoggedBus, ...] = ()
        self._controllers: tuple[str, ...] = ()
        self._machine = MachineHistory()
        self._samples: list[MachineSample] = []
        self._kept: list[_WorstCycleCandidate] = []
        self._begin_ns: int | None = None
        self._end_ns = 0  # End of the last cycle

    def add_slice(self, log: Log) -> None:
        """Add the cycles, packets and machine samples of the next slice of the log.

        Raises:
            LogError: A packet or a machine sample in the slice cannot be read.
        """
        if self._newest is None:
            plan = plan_of(log)
            self._buses = tuple(plan.by_name.get(name, LoggedBus(name)) for name in log.buses)
            self._controllers = tuple(controller.name for controller in log.controllers)
            self._sequential = plan.loop.schedule == "sequential"
        if self._begin_ns is None and begins(log):
            self._begin_ns = first_deadline_ns(log)
        if len(log.packets):
            self._packets.append(log.packets)
        self._samples += self._machine.new(log)
        cycles = cycles_of(log)
        if len(cycles):
            self._end_ns = int(cycles["written"][-1])
        self._advance(cycles if self._newest is None else np.concatenate([self._newest, cycles]))

    def find_causes(self) -> Causes:
        """Split the worst cycles by cause, and return the causes of the whole run."""
        if self._newest is not None:
            self._advance(self._newest, final=True)
        pairing = Pairing(self._buses)
        accounts = [
            Account(one.cycle, one.before, one.packets, pairing, self._controllers) for one in self._kept
        ]
        self._share_with_machine(accounts)
        sums: defaultdict[CauseName, list[tuple[int, bool]]] = defaultdict(list)
        for one, account in zip(self._kept, accounts, strict=True):
            for name, ns in account.shares.items():
                sums[name].append((ns, bool(one.cycle["long"])))
        causes = [self._cause(name, parts) for name, parts in sums.items()]
        causes.sort(key=lambda one: -one.total_ns)
        worst = sorted(zip(self._kept, accounts, strict=True), key=lambda pair: -pair[1].shares.total())
        return Causes(
            self._late,
            self._long,
            sum(one.total_ns for one in causes),
            tuple(causes),
            tuple(self._worst(one, account) for one, account in worst[:WORST]),
            self._machine.slow,
            MachineLoad()
            if self._begin_ns is None
            else self._machine.compute_load(self._begin_ns, self._end_ns),
        )

    def _advance(self, cycles: Cycles, *, final: bool = False) -> None:
        """Count all cycles but the newest; with `final` also the newest.

        The newest cycle waits for its successor, which declares the periods skipped between the two.
        """
        count = len(cycles) if final else max(len(cycles) - 1, 0)
        self._newest = cycles[count:].copy()
        if not count:
            return
        ready, behind = cycles[:count].copy(), cycles[1 : count + 1]
        # The next cycle declares the periods that were skipped after this one.
        followed = len(behind)
        ready["skipped"] = np.append(behind["skipped"], [0] * (count - followed))
        counted_from = ready["woken" if self._sequential else "scheduled"][:followed]
        between = behind["scheduled"] - counted_from
        between //= np.maximum(behind["cycle"] - ready["cycle"][:followed], 1)
        ready["period"][:followed] = np.where(between > 0, between, ready["period"][:followed])
        rows = ready if self._before is None else np.concatenate([self._before, ready])
        self._count_late_cycles(rows, new=len(rows) - count)
        self._before = rows[-1:].copy()
        from_ns = int(rows["read"][-1])
        kept = [part.select_rows(part.last_ns >= from_ns) for part in self._packets]
        self._packets = [part.compact() for part in kept if len(part)]

    def _count_late_cycles(self, rows: Cycles, new: int) -> None:
        """Count late and long cycles from row `new` on, and keep the worst of the run with their packets."""
        begin = np.maximum(rows["scheduled"], np.append(rows["scheduled"][:1], rows["written"][:-1]))
        rows["late"], took = np.maximum(rows["woken"] - begin, 0), rows["written"] - rows["woken"]
        over = rows["written"] > rows["scheduled"] + rows["period"]
        late, long = rows["late"] > ROUGH_NS, (took > rows["period"]) | (over & (rows["skipped"] > 0))
        late[:new] = long[:new] = False
        self._late += int(late.sum())
        self._long += int(long.sum())
        rows["long"] = long
        rows["size"] = size = np.where(late | long, rows["late"], 0) + np.where(long, took, 0)
        least = self._kept[-1].cycle["size"] if len(self._kept) == KEPT else 0
        worst = np.argsort(-size, kind="stable")[:KEPT]
        if not (size[worst] > least).any():
            return
        packets = PacketColumns.joined(self._packets)
        for at in worst[size[worst] > least].tolist():
            since = int(rows["read"][at - 1]) if at else int(rows["scheduled"][at] - rows["period"][at])
            mine = (packets.first_ns > since) & (packets.first_ns <= rows["written"][at])
            part = packets.select_rows(np.flatnonzero(mine)).compact()
            before = rows[at - 1] if at else None
            self._kept.append(_WorstCycleCandidate(rows[at], before, part))
        self._kept = sorted(self._kept, key=lambda one: -one.cycle["size"])[:KEPT]

    def _share_with_machine(self, accounts: Sequence[Account]) -> None:
        """Move late wake-ups and own work to the machine, up to the time that its samples account for."""
        woken = np.array([int(one.cycle["woken"]) for one in self._kept], np.int64)
        for sample in self._samples:
            then = (woken > sample.begin_ns) & (woken <= sample.end_ns)
            mine = [accounts[at].shares for at in np.flatnonzero(then).tolist()]
            left = list(sample.taken_ns)
            for name in _MACHINE:
                total = rest = sum(shares[name] for shares in mine)
                for at, taker in enumerate(TAKERS):
                    given = min(left[at], rest)
                    left[at] -= given
                    rest -= given
                    for shares in mine:
                        shares[CauseName("machine", taker)] += shares[name] * given // max(total, 1)
                for shares in mine:
                    shares[name] = shares[name] * rest // max(total, 1)
        for account in accounts:
            account.shares = +account.shares

    # Names of causes

    def _cause(self, name: CauseName, parts: list[tuple[int, bool]]) -> Cause:
        """Sum one cause over the worst cycles of the run.

        Args:
            name: Key of the cause.
            parts: Time (ns) in each cycle, and whether that cycle was long.
        """
        subject, servo = self._subject(name)
        total, most = sum(ns for ns, _ in parts), max(ns for ns, _ in parts)
        long_ns = sum(ns for ns, long in parts if long)
        return Cause(name.kind, subject, len(parts), total, most, long_ns, servo)

    def _subject(self, name: CauseName) -> tuple[str, str]:
        """Return the subject of a cause as text (`servo 3 (knee)`, `bus main`, a controller), and the
        joint of its servo, empty if the cause is not a servo."""
        if name.bus < 0:
            return name.subject, ""
        bus, servo = self._buses[name.bus], name.servo_id
        if servo < 0:
            return f"bus {bus.name}", ""
        joint = bus.names.get(servo, "")
        return f"servo {servo} ({joint or bus.name})", joint or f"{bus.name} {servo}"

    def _worst(self, one: _WorstCycleCandidate, account: Account) -> WorstCycle:
        """Return a cycle's record for reports: causes, and packets since the preceding cycle ended."""
        cycle, scheduled = one.cycle, int(one.cycle["scheduled"])
        shares = [
            CauseShare(name.kind, self._subject(name)[0], ns / 1e3)
            for name, ns in account.shares.most_common()
            if ns
        ]
        begin = scheduled - int(cycle["period"]) if one.before is None else int(one.before["written"])
        packets = one.packets.select_rows(np.flatnonzero(one.packets.first_ns >= begin))
        woken, read, updated, written = ((int(cycle[name]) - scheduled) / 1e3 for name in _TIMES[1:])
        return WorstCycle(
            int(cycle["cycle"]),
            (scheduled - (self._begin_ns or 0)) / 1e9,
            scheduled,
            int(cycle["period"]) / 1e3,
            woken,
            read,
            updated,
            written,
            skipped=int(cycle["skipped"]),
            excess_us=sum(one.us for one in shares),
            causes=tuple(shares),
            packets=tuple(timeline(packets, self._buses, scheduled)),
        )


def cycles_of(log: Log) -> Cycles:
    """Return the cycles of a log as a table for the cause analysis: times in ns, and the number of periods
    skipped before each cycle.

    The columns `late`, `long` and `size` (the sort key of the worst cycles) are filled in later.
    """
    names = ("cycle", *_TIMES, "period", "skipped", "late", "size")
    shape = log.cycles["controller_ns"].shape[1:]
    dtype = [*((name, "i8") for name in names), ("long", "?"), ("controllers", "i8", shape)]
    found = np.zeros(len(log.cycles), dtype)
    found["period"], found["controllers"] = log.period_ns, log.cycles["controller_ns"]
    for name in ("cycle", "skipped"):
        found[name] = log.cycles[name]
    for name in _TIMES:
        found[name] = log.cycles[f"{name}_ns"]
    return found
