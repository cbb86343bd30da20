"""Exchanges: the instructions of a log paired with their replies, as columns of one table.

The packets are parsed again, by `pairing.c`, so that nothing depends on the interpretation of the run. A
reply belongs to the last instruction before it on its bus.
"""

from __future__ import annotations

from enum import IntEnum, unique
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.cycles.punctuality import DISORDER_NS
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlrun_analysis.servos.compiled_pairing import (
    CompiledPairing,
    DueReplies,
    ExchangeColumns,
    Replies,
    TrafficCounts,
)
from dxlrun_analysis.servos.logged_requests import IDS, DistinctRequests, Flags, Numbers, RequestTable
from dxlwire import BROADCAST_ID, PacketKind

_ROWS = 40  # Low bits of a key hold the index of the exchange; the bits above hold the servo
_LATEST_NS = 100_000_000  # A block of a fast status packet that comes later is treated as noise


class Exchanges(NamedTuple):
    """Instructions with their replies, bus by bus and in order of time; columns of shape (exchanges,).

    The first exchange of each bus has no instruction. It holds packets that arrived before the first
    instruction.
    """

    buses: tuple[LoggedBus, ...]
    requests: DistinctRequests  # Indexed by `request`
    bus: Numbers
    cycle: Numbers  # Cycle of the instruction; -1 for the first exchange of each bus
    request: Numbers  # Index in `requests`
    asked_ns: Numbers  # Before the write() of the instruction
    blocked_ns: Numbers  # Time of the write() beyond the wire time, if the rate is known
    sent_ns: Numbers  # End of the instruction on the wire, from its rate
    last_ns: Numbers  # After the last reply; equals `sent_ns` without replies
    ended: Flags
    """False if the log ends before the next instruction on the bus. A missing reply may then have come
    after the end of the log."""
    noise: Numbers  # Bytes that belong to no intact packet
    answer: Numbers  # Index in `replies` of the last one that was requested; -1: none
    kind: Numbers  # A `ReplyKind`, of the first reply
    extra_ns: Numbers
    """Time of the last reply beyond wire time and return delay; the smallest integer if one is missing."""
    times: Numbers  # Number of exchanges on each bus with each request, shape (buses, requests)
    replies: Replies
    due: DueReplies
    late: LateReplies
    others: PacketColumns  # Instructions of other hosts on the line
    echoes: Numbers  # Bus of each own instruction that was echoed
    unasked: Numbers  # Servo of each intact reply that no instruction of this host requests
    stray: PacketColumns  # Bytes that belong to no intact packet

    def complete(self) -> tuple[Numbers, Numbers]:
        """Return the rows of the exchanges that all servos answered, and their `extra_ns`."""
        rows = np.flatnonzero(self.extra_ns > np.iinfo(np.int64).min)
        return rows, self.extra_ns[rows]

    def first_servos(self, rows: Numbers) -> Numbers:
        """Return the servo that each of the exchanges in `rows` asks first; each asks at least one."""
        begins = self.requests.begins[self.request[rows]]
        return self.bus[rows] * IDS + self.requests.ids[begins]

    def ended_times(self) -> Numbers:
        """Return `times` of the exchanges that have ended."""
        rows, times = np.flatnonzero(~self.ended), self.times.copy()
        np.subtract.at(times, (self.bus[rows], self.request[rows]), 1)
        return times

    def count_due(self, times: Numbers) -> Numbers:
        """Return how often exchanges ask each servo, shape (buses times 256,), by their number `times`."""
        requests, count = self.requests, np.zeros(len(self.buses) * IDS, np.int64)
        for bus, request in np.argwhere(times).tolist():
            begin = requests.begins[request]
            ids = requests.ids[begin : begin + requests.servos[request]]
            count[bus * IDS + ids] += times[bus, request]
        return count

    def count_first(self, times: Numbers, *, alone: bool) -> Numbers:
        """Return how often exchanges ask each servo first of several, or `alone`; by their number `times`."""
        requests, count = self.requests, np.zeros(len(self.buses) * IDS, np.int64)
        which = requests.servos == 1 if alone else requests.servos > 1
        bus, request = np.nonzero(times * which)
        np.add.at(count, bus * IDS + requests.ids[requests.begins[request]], times[bus, request])
        return count


@unique
class ReplyKind(IntEnum):
    """Kind of a reply by which its own time is compared, if it is known."""

    NONE = -1  # Unknown: shared or delivered together with a neighbour, or not in its turn
    CHAINED = 0  # After others in a chain
    FIRST = 1  # First of a chain or of a cycle; not compared
    RESTED = 2  # Asked alone after a rest of the line
    NEXT = 3  # Asked alone right after an exchange


@unique
class Loss(IntEnum):
    """Reason of a missing reply, as far as its exchange shows it."""

    NONE = -1  # Not missing
    OWN = 0  # Of the servo: asked alone, or the first of several without an intact reply
    BEHIND = 1  # Of a preceding servo in the chain or in the fast status packet
    LINE = 2  # No reply of several is intact: the instruction may be lost, or the first reply
    LATE = 3  # Not lost: the reply came after it was given up


class LateReplies(NamedTuple):
    """Intact replies that came after the loop had given them up, as columns of shape (late replies,)."""

    servo: Numbers  # ID 254: the replies of several servos in one fast status packet
    exchange: Numbers  # Newest exchange that lacks the reply; -1: not among these exchanges
    at_ns: Numbers  # After the read() of its last byte
    late_ns: Numbers  # Time since the end of its instruction; 0: unknown


class Pairing:
    """Pairs instructions with their replies, fed slice by slice in constant memory.

    The newest packets are held back, because records of a log are not strictly in order of time.
    """

    def __init__(self, buses: tuple[LoggedBus, ...] = ()) -> None:
        """Create a pairing without packets.

        Args:
            buses: Buses of the log as its plan describes them; without them, those of the first slice.
        """
        self._waiting: list[PacketColumns] = []
        self._oldest_ns: int | None = None  # Time of the first waiting packet
        self._requests = RequestTable()
        self._prepare(buses)

    def _prepare(self, buses: tuple[LoggedBus, ...]) -> None:
        self.buses = buses  # Buses of the log, as its plan describes them
        self.counts = TrafficCounts.for_buses(len(buses))
        self._free_ns = np.zeros(len(buses), np.int64)
        """Time at which the line of each bus has carried everything that was sent."""

    def pair_packets(self, log: Log) -> Exchanges | None:
        """Add the packets of the next slice; return the exchanges that are now complete, or None.

        Raises:
            LogError: A packet cannot be read.
        """
        if not self.buses:
            planned = plan_of(log).by_name
            self._prepare(tuple(planned.get(name, LoggedBus(name)) for name in log.buses))
        if not len(log.packets):
            return None
        self._waiting.append(log.packets)
        newest_ns = int(log.packets.first_ns[-1])
        if self._oldest_ns is None:
            self._oldest_ns = int(log.packets.first_ns[0])
        if newest_ns - self._oldest_ns <= 2 * DISORDER_NS:
            return None
        packets = PacketColumns.joined(self._waiting)
        order = _order(packets)
        bus, certain = packets.bus[order], packets.first_ns[order] < newest_ns - DISORDER_NS
        # Hold back the last instruction of each bus: its replies can still come.
        instructions = np.flatnonzero(certain & (packets.kind[order] == PacketKind.INSTRUCTION))
        last = np.full(IDS, len(packets), np.int64)
        last[bus[instructions]] = instructions
        certain &= np.arange(len(packets)) < last[bus]
        rows, held = order[certain], np.ones(len(packets), np.bool_)
        held[rows] = False
        self._oldest_ns = int(packets.first_ns[order[np.argmin(certain)]])
        each = np.split(held, np.cumsum([len(part) for part in self._waiting[:-1]]))
        parts = zip(self._waiting, each, strict=True)
        self._waiting = [part.select_rows(mine) for part, mine in parts if mine.any()]
        return self._paired(packets, rows)

    def pair_remaining(self) -> Exchanges | None:
        """Return the exchanges of the packets that were held back, or None; no more slices follow."""
        if not self._waiting:
            return None
        packets = PacketColumns.joined(self._waiting)
        self._waiting = []
        return self._paired(packets, _order(packets), final=True)

    def alone(self, packets: PacketColumns) -> Exchanges:
        """Return the exchanges of these packets alone, which are sorted by bus and time, such as those of one
        cycle; all count as ended."""
        self._free_ns[:] = 0
        return self._paired(packets, np.arange(len(packets)))

    def _paired(self, packets: PacketColumns, rows: Numbers, *, final: bool = False) -> Exchanges:
        """Pair the packets in `rows`, which are sorted by bus and time; `final` if no packets follow."""
        buses = len(self.buses)
        compiled = CompiledPairing(packets, rows, self.buses, self._free_ns, self.counts)
        columns, exchange = compiled.split_packets()
        self._requests.replace_samples(packets, columns.row, columns.request)
        replies, due = compiled.pair_replies(columns, exchange, self._requests.all)
        ended = np.ones(len(columns.bus), np.bool_)
        ended[np.searchsorted(columns.bus, np.arange(buses), side="right") - 1] = not final
        kind = packets.kind[rows]
        noise = np.flatnonzero(kind == PacketKind.NOISE)
        stray = packets.select_rows(rows[noise])
        blocks, block_ids = self._late_blocks(stray, exchange[noise], columns, due)
        np.subtract.at(columns.noise, exchange[noise[blocks]], stray.length[blocks])
        due.broken[due.missing[columns.noise[due.exchange[due.missing]] <= 0]] = False
        came = np.flatnonzero(kind == PacketKind.LATE)
        ids = np.append(packets.servo_id[rows[came]], block_ids)
        came = np.append(came, noise[blocks])
        of, at_ns = exchange[came], packets.last_ns[rows[came]]
        late = _late(columns.bus[of] * IDS + ids, of, at_ns, columns.sent_ns, due)
        others = np.flatnonzero(kind == PacketKind.OTHER_HOST)
        back = _came_back(packets, rows[others], columns, exchange[others])
        echoes = columns.bus[exchange[np.append(others[back], np.flatnonzero(kind == PacketKind.ECHO))]]
        kinds = len(self._requests.all.servos)
        times = np.bincount(columns.bus * kinds + columns.request, minlength=buses * kinds)
        return Exchanges(
            self.buses,
            self._requests.all,
            *columns[:7],
            ended,
            *columns[7:11],
            times.reshape(buses, kinds),
            replies,
            due,
            late,
            packets.select_rows(rows[others[~back]]),
            echoes,
            _unasked(replies, due, columns.asked_id),
            stray,
        )

    def _late_blocks(
        self, noise: PacketColumns, exchange: Numbers, exchanges: ExchangeColumns, due: DueReplies
    ) -> tuple[Numbers, NDArray[np.uint8]]:
        """Return the noise packets that are the missing block of a fast status packet and came late: row
        in `noise`, and ID."""
        requests, lacks = self._requests.all, due.missing[due.loss[due.missing] == Loss.OWN]
        lacks = lacks[requests.fast[exchanges.request[due.exchange[lacks]]]]
        at = np.searchsorted(due.exchange[lacks], exchange) - 1
        rows = np.flatnonzero(at >= 0)
        lacks, noise = lacks[at[rows]], noise.select_rows(rows)
        of = due.exchange[lacks]
        block = exchanges.request[of], due.place[lacks]
        waited_ns = noise.first_ns - exchanges.asked_ns[of]
        found = noise.bus.astype(np.int64) * IDS + noise.byte(1) == due.servo[lacks]
        found &= noise.length == requests.block_ends[block] - requests.blocks[block]
        found &= (waited_ns >= 0) & (waited_ns < _LATEST_NS)
        return rows[found], noise.byte(1)[found]


def _unasked(replies: Replies, due: DueReplies, to: Numbers) -> Numbers:
    """Return the servo of each reply that no instruction of this host requests; `to` is the ID of each
    instruction, or -1.

    Two kinds of replies are excluded: acknowledged writes, and the late reply of a servo whose last reply is
    missing.
    """
    rows = np.flatnonzero(replies.strange)
    asked_id = to[replies.exchange[rows]]
    rows = rows[(asked_id >= 0) & (asked_id != replies.servo[rows] % IDS)]
    exchange, servo = replies.exchange[rows], replies.servo[rows]
    if not len(rows):
        return np.zeros(0, np.int64)
    asked = np.append((due.servo << _ROWS) + due.exchange, -1)
    order = np.argsort(asked)
    last = order[np.searchsorted(asked[order], (servo << _ROWS) + exchange, side="right") - 1]
    owed = (asked[last] >> _ROWS == servo) & (np.append(due.reply, -1)[last] < 0)
    unasked: Numbers = servo[~owed]
    return unasked


def _late(
    servo: Numbers, exchange: Numbers, at_ns: Numbers, sent_ns: Numbers, due: DueReplies
) -> LateReplies:
    """Match late replies to the exchanges that lack them, and set `due.loss` there to LATE."""
    missing = due.missing
    # The late reply of a fast status packet covers all its servos; its first one represents them.
    whole = missing[(due.loss[missing] == Loss.LINE) & (due.place[missing] == 0)]
    index = np.append(missing, whole)
    of = np.append(due.servo[missing], due.servo[whole] // IDS * IDS + BROADCAST_ID)
    keys = (of << _ROWS) + due.exchange[index]
    order = np.argsort(keys)
    keys, index = keys[order], index[order]
    at = np.searchsorted(keys, (servo << _ROWS) + exchange, side="right") - 1
    known = at >= 0
    known[known] = keys[at[known]] >> _ROWS == servo[known]
    found = np.full(len(servo), -1, np.int64)
    found[known] = due.exchange[index[at[known]]]
    due.loss[index[at[known]]] = Loss.LATE
    all_late = np.isin(due.exchange[missing], found[servo % IDS == BROADCAST_ID])
    due.loss[missing[all_late & (due.loss[missing] == Loss.LINE)]] = Loss.LATE
    due.broken[missing[due.loss[missing] == Loss.LATE]] = False
    return LateReplies(servo, found, at_ns, np.where(known, at_ns - sent_ns[found], 0))


def _came_back(
    packets: PacketColumns, others: Numbers, exchanges: ExchangeColumns, exchange: Numbers
) -> Flags:
    """Return which foreign instructions are echoes: equal to one of the last two instructions of this host.

    Args:
        packets: All packets.
        others: Rows of instructions of other hosts.
        exchanges: The exchanges.
        exchange: Exchange of each instruction of another host.
    """

    def text(row: int) -> bytes:
        start = int(packets.start[row])
        return packets.data[start : start + int(packets.length[row])].tobytes()

    rows = exchanges.row[exchanges.row >= 0]
    # Each bus begins with an exchange without an instruction.
    sent = exchange - exchanges.bus[exchange]
    last = [rows[max(0, one - 2) : one].tolist() for one in sent.tolist()]
    found = [text(other) in map(text, own) for other, own in zip(others.tolist(), last, strict=True)]
    return np.array(found, np.bool_)


def ordered(packets: PacketColumns) -> PacketColumns:
    """Return the packets sorted by bus, then by time. Packets with equal times keep their order."""
    return packets.select_rows(_order(packets))


def _order(packets: PacketColumns) -> Numbers:
    order = np.argsort(packets.bus, kind="stable")
    bus, first_ns = packets.bus[order], packets.first_ns[order]
    if ((first_ns[1:] < first_ns[:-1]) & (bus[1:] == bus[:-1])).any():
        order = np.lexsort((packets.first_ns, packets.bus))
    return order
