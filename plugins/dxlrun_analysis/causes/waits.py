"""What a cycle waited for on its buses, against the plan: late and missing replies, retries, slow writes.

A read waits for all lines at once, so the bus that was ready last counts. Its exchanges are planned to take
what wire, return delays and the adapter's latency take; what they took beyond that is split:

- a write() of the instruction that returned later than the wire needs;
- a missing reply: from the last reply, or when it was due, to the next instruction or the end of the read;
  the first servo that did not answer has it, and where nothing of a chain of replies came, the bus;
- a late reply: lateness that the replies behind it do not make up for, of the bus. Whose the latest reply of
  a read was is noted where all others were less than half as late, but for one that came together with the
  next (both had waited), and the first of a chain or of a read: what wakes host and adapter is in it;
- a retry: all of an exchange with a servo that was asked in the same read before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.packets import PacketKind
from dxlrun.dynamixel.plan.line import TIMEOUT_MARGIN_NS
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.causes.shares import CauseName, Shares
from dxlrun_analysis.cycles.latency import ROUGH_NS
from dxlrun_analysis.cycles.worst import CauseKind
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing, ordered

_IDS = 256
_BYTE_NS = 10_000_000_000
_NEVER = np.iinfo(np.int64).max
_LONGEST = 1 << 40
"""ns; no reply is later than some minutes."""
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Times of cycles in their order, ns, shape (cycles,)."""

    cycle: Numbers
    scheduled: Numbers
    woken: Numbers
    read: Numbers
    updated: Numbers
    written: Numbers
    period: Numbers
    skipped: Numbers
    """Periods that were left out behind each."""
    controllers: Numbers
    """Shape (cycles, controllers)."""

    def __len__(self) -> int:
        return len(self.cycle)

    def take(self, rows: Numbers | Flags | slice) -> Rows:
        """Return some of them."""
        return Rows(*(getattr(self, name)[rows] for name in Rows.__slots__))

    @property
    def due(self) -> Numbers:
        """When each could begin: at its deadline, or when the cycle before had ended."""
        before = np.concatenate([self.scheduled[:1], self.written[:-1]])
        due: Numbers = np.maximum(self.scheduled, before)
        return due

    @property
    def late(self) -> Numbers:
        """How late each woke, without what the cycle before took of its time."""
        late: Numbers = np.maximum(self.woken - self.due, 0)
        return late


def joined_rows(parts: Sequence[Rows]) -> Rows:
    """Return cycles of several parts, one behind the other."""
    if len(parts) == 1:
        return parts[0]
    return Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in Rows.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Waits:
    """What some cycles waited for; shape (cycles,), ns."""

    planned: Numbers
    """Of the read: the exchanges of the slowest bus by the plan."""
    exchanged: Numbers
    """Of the read: the same as it was."""
    idle: Numbers
    """Of a late wake-up: an exchange of the idle time that ended behind the deadline."""
    writes: Numbers
    """Of the write: the write() calls of goals."""


class BusWaits:
    """Splits the waits of cycles; keeps what the packets of a log have in common."""

    __slots__ = ("_buses", "_pairing")

    def __init__(self, buses: tuple[LoggedBus, ...]) -> None:
        self._buses = buses
        self._pairing = Pairing()

    def split(self, rows: Rows, long: Flags, late: Flags, packets: PacketColumns, shares: Shares) -> Waits:
        """Split the reads of the `long` cycles and the idle time before the `late` ones into shares."""
        none = np.zeros(len(rows), np.int64)
        if not len(packets):
            return Waits(none, none, none, none)
        packets = ordered(packets)
        one = _Split(rows, self._buses, packets, self._pairing.pair(packets, self._buses), shares)
        planned, exchanged = one.reads(long)
        return Waits(planned, exchanged, one.idle(late), one.writes(long))


class _Split:
    """The exchanges of some cycles; arrays of shape (exchanges,), times in ns."""

    def __init__(
        self,
        rows: Rows,
        buses: tuple[LoggedBus, ...],
        packets: PacketColumns,
        exchanges: Exchanges,
        shares: Shares,
    ) -> None:
        self._rows, self._buses, self._packets, self._shares = rows, buses, packets, shares
        self._exchanges = exchanges
        self._bus, self._asked = exchanges.bus, exchanges.asked_ns
        count = len(self._bus)
        instructs = packets.kind == PacketKind.INSTRUCTION
        at = (np.cumsum(instructs) + packets.bus)[instructs]
        valid = np.zeros(count, np.bool_)
        valid[at] = True
        rates = np.array([bus.baud_rate for bus in buses], np.int64)
        wire = packets.length * _BYTE_NS // np.maximum(rates, 1)[packets.bus]
        self._blocked = np.zeros(count, np.int64)
        """How long the write() of the instruction took beyond the wire's time."""
        self._blocked[at] = np.maximum(packets.last_ns - packets.first_ns - wire, 0)[instructs]
        replies = exchanges.replies
        self._answers = np.flatnonzero(replies.answers)
        of = replies.exchange[self._answers]
        asks = exchanges.asks
        self._asks = asks[exchanges.request] & valid[:, None]
        self._missing = np.bincount(of, minlength=count) < self._asks.sum(axis=1)
        self._last = np.full(count, -1, np.int64)
        np.maximum.at(self._last, of, replies.last_ns[self._answers])
        due = exchanges.sent_ns.copy()
        np.maximum.at(due, of, replies.due_ns[self._answers])
        self._latency = np.array([bus.latency_ns for bus in buses], np.int64)[self._bus]
        self._planned_end = due + self._latency
        self._next = np.append(np.where(self._bus[1:] == self._bus[:-1], self._asked[1:], _NEVER), _NEVER)
        self._row = np.searchsorted(rows.woken, self._asked, side="right") - 1
        self._reads = valid & (self._row >= 0) & self._asks.any(axis=1)
        self._behind = self._reads & (self._asked > rows.read[self._row])
        """Asked behind the read of a cycle, in its idle time."""
        self._following = np.minimum(self._row + 1, len(rows) - 1)

    def reads(self, long: Flags) -> tuple[Numbers, Numbers]:
        """Add the shares of reads; return what their exchanges were planned to take, and what they took."""
        rows, count = self._rows, len(self._rows)
        row = self._row
        within = self._reads & ~self._behind
        within[within] = long[row[within]]
        begin = np.maximum(self._asked, rows.woken[row])
        end = np.minimum(np.where(self._missing, self._next, self._last), rows.read[row])
        lines = len(self._buses)
        ready = np.full(count * lines, -1, np.int64)
        np.maximum.at(ready, row[within] * lines + self._bus[within], end[within])
        slowest = ready.reshape(count, lines).argmax(axis=1)
        at = np.flatnonzero(within & (self._bus == slowest[row]))
        row, begin, end = row[at], begin[at], end[at]
        took = np.maximum(end - begin, 0)
        retried = self._retried(at, row)
        planned = np.where(retried, 0, np.clip(self._planned_end[at] - begin, 0, took))
        beyond = took - planned
        asked = self._asks[at].argmax(axis=1)
        self._add_by_servo("retry", self._bus[at], asked, row, np.where(retried, took, 0))
        beyond[retried] = 0
        blocked = np.minimum(self._blocked[at], beyond)
        self._add_by_bus("write call", self._bus[at], row, blocked)
        beyond -= blocked
        heard = np.maximum(np.maximum(self._last[at], begin), np.minimum(self._planned_end[at], end))
        missed = np.where(self._missing[at], np.clip(end - heard, 0, beyond), 0)
        self._add_missing(at, row, missed)
        beyond -= missed
        beyond -= self._add_replies(at, row, beyond, blocked)
        self._shares.add(CauseName("unexplained"), row, beyond)
        sums = np.zeros((2, count), np.int64)
        np.add.at(sums[0], row, planned)
        np.add.at(sums[1], row, took)
        return sums[0], sums[1]

    def _retried(self, at: Numbers, row: Numbers) -> Flags:
        """Return which exchanges ask a single servo that was asked in the same read before."""
        index, servo = np.nonzero(self._asks[at])
        key = row[index] * _IDS + servo
        _, first = np.unique(key, return_index=True)
        again = np.ones(len(key), np.bool_)
        again[first] = False
        retried = np.zeros(len(at), np.bool_)
        retried[index[again]] = True
        retried &= self._asks[at].sum(axis=1) == 1
        return retried

    def _add_by_bus(self, kind: CauseKind, bus: Numbers, row: Numbers, ns: Numbers) -> None:
        for index in np.unique(bus[ns > 0]).tolist():
            mine = bus == index
            self._shares.add(CauseName(kind, bus=index), row[mine], ns[mine])

    def _add_by_servo(self, kind: CauseKind, bus: Numbers, servo: Numbers, row: Numbers, ns: Numbers) -> None:
        keys = bus * _IDS + servo
        for key in np.unique(keys[ns > 0]).tolist():
            mine = keys == key
            name = CauseName(kind, bus=key // _IDS, servo_id=key % _IDS)
            self._shares.add(name, row[mine], ns[mine])

    def _add_missing(self, at: Numbers, row: Numbers, ns: Numbers) -> None:
        """Add missing replies to the first servo of each exchange that did not answer, or to its bus."""
        for index in np.flatnonzero(ns > 0).tolist():
            self._shares.add(self._unanswered(int(at[index])), row[[index]], ns[[index]])

    def _unanswered(self, exchange: int) -> CauseName:
        """Return the cause of a reply that is missing."""
        bus = int(self._bus[exchange])
        if self._last[exchange] < 0 and self._asks[exchange].sum() > 1:
            return CauseName("missing reply", bus=bus)  # the instruction may be lost, or all of it late
        return CauseName("missing reply", bus=bus, servo_id=self._silent(exchange))

    def _silent(self, exchange: int) -> int:
        """Return the first servo of an exchange that did not answer."""
        replies = self._exchanges.replies
        begin, end = np.searchsorted(replies.exchange, [exchange, exchange + 1])
        answered = set(replies.servo_id[begin:end][replies.answers[begin:end]].tolist())
        request = self._exchanges.requests[self._exchanges.request[exchange]]
        return next((servo for servo in request.servo_ids if servo not in answered), 0)

    def _add_replies(self, at: Numbers, row: Numbers, beyond: Numbers, blocked: Numbers) -> Numbers:
        """Add late replies of exchanges to their bus, and note whose the latest are; return each sum."""
        replies = self._exchanges.replies
        place = np.full(len(self._bus), -1, np.int64)
        place[at] = np.arange(len(at))
        rows = self._answers[place[replies.exchange[self._answers]] >= 0]
        of = place[replies.exchange[rows]]
        order = np.argsort(of, kind="stable")
        rows, of = rows[order], of[order]
        explained = np.zeros(len(at), np.int64)
        if not len(rows):
            return explained
        late = replies.last_ns[rows] - replies.due_ns[rows] - self._latency[at[of]] - blocked[of]
        late = np.clip(late, 0, beyond[of])
        lasting = np.minimum.accumulate((late + of * _LONGEST)[::-1])[::-1] - of * _LONGEST
        first = np.diff(of, prepend=-1) != 0
        added = np.where(first, lasting, lasting - np.roll(lasting, 1))
        explained[of] = lasting  # of each exchange the last reply's stays
        exchange = at[of]
        bus, cycle = self._bus[exchange], row[of]
        self._add_by_bus("late reply", bus, cycle, added)
        gap = np.append(np.diff(replies.last_ns[rows]), _NEVER)
        last = np.append(of[1:] != of[:-1], True)
        untold = ~last & (gap < np.append(replies.wire_ns[rows][1:], 0) // 2)  # it came with the next
        untold |= first & (self._asks[exchange].sum(axis=1) > 1)
        read = cycle * len(self._buses) + bus
        untold[np.flatnonzero(np.diff(read, prepend=-1))] = True
        servo = np.where(untold, -1, replies.servo_id[rows])
        mattered = np.flatnonzero(added > ROUGH_NS)
        mattered = mattered[np.lexsort((-added[mattered], read[mattered]))]
        again = np.diff(read[mattered], prepend=-1) == 0
        alike = np.zeros(len(mattered), np.bool_)
        alike[:-1] = again[1:] & (2 * added[mattered][1:] >= added[mattered][:-1])
        servo[mattered[alike]] = -1
        mine = mattered[~again]
        self._shares.names.latest.update(zip(bus[mine].tolist(), servo[mine].tolist(), strict=True))
        return explained

    def writes(self, long: Flags) -> Numbers:
        """Add the write() calls of goals; return what they took of each cycle."""
        packets, rows = self._packets, self._rows
        row = np.searchsorted(rows.woken, packets.first_ns, side="right") - 1
        goals = (packets.kind == PacketKind.INSTRUCTION) & (row >= 0)
        goals &= long[row] & (packets.first_ns >= rows.updated[row]) & (packets.last_ns <= rows.written[row])
        ns = (packets.last_ns - packets.first_ns)[goals]
        bus = packets.bus[goals].astype(np.int64)
        self._add_by_bus("write call", bus, row[goals], ns)
        took = np.zeros(len(rows), np.int64)
        np.add.at(took, row[goals], ns)
        return took

    def idle(self, late: Flags) -> Numbers:
        """Add exchanges of the idle time that ended behind the next deadline; return what each cycle lost."""
        rows = self._rows
        found = np.zeros(len(rows), np.int64)
        waits = self._behind & (self._following > self._row)
        waits[waits] = late[self._following[waits]]
        given_up = self._planned_end + TIMEOUT_MARGIN_NS
        end = np.where(self._missing, np.minimum(self._next, given_up), self._last)
        over = np.minimum(end - rows.due[self._following], rows.late[self._following])
        for index in np.flatnonzero(waits & (over > 0)).tolist():
            row, ns = int(self._following[index]), int(over[index])
            if ns <= found[row]:
                continue  # of several buses the latest counts
            self._shares.add(self._of_idle(index, ns), np.array([row]), np.array([ns - found[row]]))
            found[row] = ns
        return found

    def _of_idle(self, index: int, ns: int) -> CauseName:
        """Return the cause of an exchange that ended so long behind the deadline."""
        bus = int(self._bus[index])
        if self._missing[index]:
            return self._unanswered(index)
        if self._last[index] - self._planned_end[index] < ns // 2:
            return CauseName("own work")  # it was begun too late
        replies = self._exchanges.replies
        mine = self._answers[replies.exchange[self._answers] == index]
        self._shares.names.latest[bus, int(replies.servo_id[mine[-1]])] += 1
        return CauseName("late reply", bus=bus)
