"""Exchanges: the instructions of a log paired with their replies, as columns of one table.

Pairing is vectorized, without a loop over packets. The packets are parsed again here, so that nothing depends
on the interpretation of the run. A reply belongs to the last instruction before it on its bus. Sources:
ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction and status packets.
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
from dxlrun_analysis.servos import logged_requests
from dxlrun_analysis.servos.logged_requests import IDS, DistinctRequests, Flags, Numbers, RequestTable
from dxlwire import BROADCAST_ID, PacketKind

_ROWS = 40  # Low bits of a key hold the index of the exchange; the bits above hold the servo
_BYTE_NS = 10_000_000_000  # Wire time of a byte times the rate in bit/s: ten bits a byte
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
    replies: Replies
    due: DueReplies
    late: LateReplies
    others: PacketColumns  # Instructions of other hosts on the line
    echoes: Numbers  # Bus of each own instruction that was echoed
    unasked: Numbers  # Servo of each intact reply that no instruction of this host requests
    stray: PacketColumns  # Bytes that belong to no intact packet

    def complete(self) -> tuple[Numbers, Numbers]:
        """Return the rows of the exchanges that all servos answered, and the time of their last reply beyond
        wire time and return delay, ns."""
        answers, asked = np.flatnonzero(self.replies.answers), self.requests.servos[self.request]
        of, last = self.replies.exchange[answers], np.zeros(len(self.request), np.int64)
        last[of] = answers
        rows = np.flatnonzero((np.bincount(of, minlength=len(asked)) == asked) & (asked > 0))
        return rows, self.replies.last_ns[last[rows]] - self.replies.due_ns[last[rows]]


class Replies(NamedTuple):
    """Replies of single servos as columns, shape (replies,), in order of time. A fast status packet has
    several replies."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # Place in the replies that the instruction requests; -1: not requested
    error: Numbers  # The error byte
    protocol: Numbers
    wire_ns: Numbers  # Wire time of the status packet
    last_ns: Numbers  # After the read() of the status packet's last byte
    before_ns: Numbers
    """`last_ns` of the preceding status packet in the exchange; for the first, end of the instruction."""
    due_ns: Numbers  # Planned time by wire time and return delay, with all replies before it
    """Planned time of the reply's last byte, from the end of the instruction, and wire time and return
    delay of this and the preceding replies."""
    answers: Flags  # True: requested, in time, and the first reply of the servo in the exchange
    strange: Flags  # True: a complete status packet of one servo that the exchange does not request


@unique
class Loss(IntEnum):
    """Reason of a missing reply, as far as its exchange shows it."""

    NONE = -1  # Not missing
    OWN = 0  # Of the servo: asked alone, or the first of several without an intact reply
    BEHIND = 1  # Of a preceding servo in the chain or in the fast status packet
    LINE = 2  # No reply of several is intact: the instruction may be lost, or the first reply
    LATE = 3  # Not lost: the reply came after it was given up


class DueReplies(NamedTuple):
    """Replies that instructions request, as columns of shape (due replies,); ordered by exchange, then by
    place in the chain."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # Place in the replies that the instruction requests
    reply: Numbers  # Index in the replies; -1: missing
    loss: Numbers  # A `Loss`
    broken: Flags
    """True if stray bytes came in place of the reply; always False if `loss` is not OWN."""


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
        self.buses = buses  # Buses of the log, as its plan describes them
        self._waiting: list[PacketColumns] = []
        self._requests = RequestTable()
        self._free_ns = np.zeros(len(buses), np.int64)
        """Time at which the line of each bus has carried everything that was sent."""

    def pair_packets(self, log: Log) -> Exchanges | None:
        """Add the packets of the next slice; return the exchanges that are now complete, or None.

        Raises:
            LogError: A packet cannot be read.
        """
        if not self.buses:
            planned = plan_of(log).by_name
            self.buses = tuple(planned.get(name, LoggedBus(name)) for name in log.buses)
            self._free_ns = np.zeros(len(self.buses), np.int64)
        if not len(log.packets):
            return None
        self._waiting.append(log.packets)
        newest_ns = int(log.packets.first_ns[-1])
        if newest_ns - int(self._waiting[0].first_ns[0]) <= 2 * DISORDER_NS:
            return None
        packets = PacketColumns.joined(self._waiting)
        order = _order(packets)
        bus, certain = packets.bus[order], packets.first_ns[order] < newest_ns - DISORDER_NS
        # Hold back the last instruction of each bus: its replies can still come.
        instructions = np.flatnonzero(certain & (packets.kind[order] == PacketKind.INSTRUCTION))
        last = np.full(IDS, len(packets), np.int64)
        last[bus[instructions]] = instructions
        certain &= np.arange(len(packets)) < last[bus]
        self._waiting = [packets.select_rows(order[~certain]).compact()]
        return self._paired(packets.select_rows(order[certain]))

    def pair_remaining(self) -> Exchanges | None:
        """Return the exchanges of the packets that were held back, or None; no more slices follow."""
        if not self._waiting:
            return None
        packets = ordered(PacketColumns.joined(self._waiting))
        self._waiting = []
        return self._paired(packets, final=True)

    def alone(self, packets: PacketColumns) -> Exchanges:
        """Return the exchanges of these packets alone, such as those of one cycle; all count as ended."""
        self._free_ns[:] = 0
        return self._paired(packets)

    def _paired(self, packets: PacketColumns, *, final: bool = False) -> Exchanges:
        """Pair the next packets, which are sorted by bus and time; `final` if no packets follow."""
        count, kind = len(self.buses), packets.kind
        bus = packets.bus.astype(np.int64)
        instructs = kind == PacketKind.INSTRUCTION
        # Packets are sorted by bus, and each bus begins with an exchange without an instruction. Adding the
        # index of the bus therefore numbers all exchanges.
        exchange, rows = np.cumsum(instructs) + bus, np.flatnonzero(instructs)
        at, size = exchange[rows], len(rows) + count
        heads = np.searchsorted(bus[rows], np.arange(count)) + np.arange(count)
        of_bus = np.repeat(np.arange(count), np.diff(np.append(heads, size)))
        rates = np.array([one.baud_rate for one in self.buses], np.int64)[bus]
        delays = np.array([one.return_delay_ns for one in self.buses], np.int64)[bus]
        wire_ns = np.where(rates > 0, packets.length * _BYTE_NS // np.maximum(rates, 1), 0)
        request, asked_ns, blocked_ns, sent_ns, cycle = (np.zeros(size, np.int64) for _ in range(5))
        request[at], code = self._requests.request_indices(packets.select_rows(rows))
        asked_ns[at] = packets.first_ns[rows]
        took_ns = packets.last_ns[rows] - packets.first_ns[rows]
        blocked_ns[at] = np.where(rates[rows] > 0, np.maximum(took_ns - wire_ns[rows], 0), 0)
        cycle[heads], cycle[at] = -1, packets.cycle[rows]
        sent_ns[heads] = self._free_ns
        for mine in np.split(np.arange(size), heads[1:]):
            sent = rows[mine[1:] - of_bus[mine[0]] - 1]
            sent_ns[mine[1:]] = _free_ns(packets.first_ns[sent], wire_ns[sent], sent_ns[mine[0]])
        self._free_ns = sent_ns[np.append(heads[1:], size) - 1]
        ended = np.ones(size, np.bool_)
        ended[np.append(heads[1:], size) - 1] = not final
        noise = np.flatnonzero(kind == PacketKind.NOISE)
        noise_bytes = np.bincount(exchange[noise], packets.length[noise], size).astype(np.int64)
        replies = self._replies(packets, exchange, wire_ns, delays, request, sent_ns)
        due = self._due(of_bus, request, replies, noise_bytes)
        blocks, block_ids = self._late_blocks(
            packets.select_rows(noise), exchange[noise], request, asked_ns, due
        )
        np.subtract.at(noise_bytes, exchange[noise[blocks]], packets.length[noise[blocks]])
        due.broken[noise_bytes[due.exchange] <= 0] = False
        late = np.append(np.flatnonzero(kind == PacketKind.LATE), noise[blocks])
        ids = np.append(packets.servo_id[late[: len(late) - len(blocks)]], block_ids)
        to = np.full(size, -1, np.int64)
        to[at] = packets.servo_id[rows]
        # Any servo may answer a broadcast ping.
        to[at[(code == logged_requests.PING) & (to[at] == BROADCAST_ID)]] = -1
        others = np.flatnonzero(kind == PacketKind.OTHER_HOST)
        back = _came_back(packets, others, rows, exchange - bus)
        return Exchanges(
            self.buses,
            self._requests.all,
            of_bus,
            cycle,
            request,
            asked_ns,
            blocked_ns,
            sent_ns,
            _last_ns(sent_ns, replies),
            ended,
            noise_bytes,
            replies,
            due,
            _late(bus[late] * IDS + ids, exchange[late], packets.last_ns[late], sent_ns, due),
            packets.select_rows(others[~back]),
            np.append(bus[others[back]], bus[kind == PacketKind.ECHO]),
            _unasked(replies, due, to),
            packets.select_rows(noise),
        )

    def _replies(  # noqa: PLR0917  columns of one table
        self,
        packets: PacketColumns,
        exchange: Numbers,
        wire_ns: Numbers,
        delays: Numbers,
        request: Numbers,
        sent_ns: Numbers,
    ) -> Replies:
        late = (packets.kind == PacketKind.LATE) & (packets.servo_id != BROADCAST_ID)
        rows = np.flatnonzero((packets.kind == PacketKind.STATUS) | late)
        status = packets.select_rows(rows)
        of, wire, last_ns = exchange[rows], wire_ns[rows], status.last_ns
        # Replies of a chain follow one another: each is due its return delay and its wire time after the
        # preceding one.
        took = wire + delays[rows]
        spent = np.cumsum(took)
        begins = np.flatnonzero(np.diff(of, prepend=-1))
        earlier = np.repeat(spent[begins] - took[begins], np.diff(np.append(begins, len(of))))
        due_ns = sent_ns[of] + spent - earlier
        before_ns = np.empty(len(of), np.int64)
        before_ns[1:] = last_ns[:-1]
        before_ns[begins] = sent_ns[of[begins]]
        second = logged_requests.second_of(logged_requests.heads(status))
        joint, table, asked = second & (status.servo_id == BROADCAST_ID), self._requests.all, request[of]
        blocks, count = np.flatnonzero(joint), np.ones(len(of), np.int64)
        # A truncated packet of several servos still has intact blocks.
        count[blocks] = (table.block_ends[asked[blocks]] <= status.length[blocks, None]).sum(axis=1)
        row, begin = np.repeat(np.arange(len(of)), count), np.cumsum(count) - count
        servo_id, error = status.servo_id[row], np.where(second, status.byte(8), status.byte(4))[row]
        blocks = np.flatnonzero(joint[row])
        of_block = row[blocks]
        at = status.start[of_block] + table.blocks[asked[of_block], blocks - begin[of_block]]
        servo_id[blocks], error[blocks] = status.data[at + 1], status.data[at]
        place = table.places[asked[row], servo_id]
        in_time = ~late[rows]
        return Replies(
            of[row],
            status.bus.astype(np.int64)[row] * IDS + servo_id,
            place,
            error.astype(np.int64),
            np.where(second, 2, 1)[row],
            wire[row],
            last_ns[row],
            before_ns[row],
            due_ns[row],
            (place >= 0) & in_time[row],
            (place < 0) & (in_time & ~joint)[row],
        )

    def _due(self, bus: Numbers, request: Numbers, replies: Replies, noise: Numbers) -> DueReplies:
        count = self._requests.all.servos[request]
        exchange, begin = np.repeat(np.arange(len(request)), count), np.cumsum(count) - count
        place = np.arange(len(exchange)) - np.repeat(begin, count)
        servo_id = self._requests.all.ids[np.repeat(self._requests.all.begins[request], count) + place]
        reply = np.full(len(exchange), -1, np.int64)
        # Reversed, so that the first of several replies of a servo counts.
        rows = np.flatnonzero(replies.answers)[::-1]
        reply[begin[replies.exchange[rows]] + replies.place[rows]] = rows
        replies.answers[:] = False
        replies.answers[reply[reply >= 0]] = True
        loss, missing = np.full(len(exchange), Loss.NONE, np.int64), np.flatnonzero(reply < 0)
        # Only the first missing reply of an exchange is the servo's own: the next ones wait for it in vain.
        loss[missing] = np.where(np.diff(exchange[missing], prepend=-1) > 0, Loss.OWN, Loss.BEHIND)
        silent = (np.bincount(exchange[missing], minlength=len(request)) == count) & (count > 1)
        loss[silent[exchange]] = Loss.LINE
        broken = (loss == Loss.OWN) & (noise[exchange] > 0)
        return DueReplies(exchange, np.repeat(bus * IDS, count) + servo_id, place, reply, loss, broken)

    def _late_blocks(
        self, noise: PacketColumns, exchange: Numbers, request: Numbers, asked_ns: Numbers, due: DueReplies
    ) -> tuple[Numbers, NDArray[np.uint8]]:
        """Return the noise packets that are the missing block of a fast status packet and came late: row
        in `noise`, and ID."""
        lacks = np.flatnonzero((due.loss == Loss.OWN) & self._requests.all.fast[request[due.exchange]])
        at = np.searchsorted(due.exchange[lacks], exchange) - 1
        rows = np.flatnonzero(at >= 0)
        lacks, noise = lacks[at[rows]], noise.select_rows(rows)
        of, kinds = due.exchange[lacks], self._requests.all.kinds
        size = [
            kinds[index].sizes[place]
            for index, place in zip(request[of].tolist(), due.place[lacks].tolist(), strict=True)
        ]
        waited_ns = noise.first_ns - asked_ns[of]
        found = noise.bus.astype(np.int64) * IDS + noise.byte(1) == due.servo[lacks]
        found &= noise.length == np.array(size, np.int64) + 4
        found &= (waited_ns >= 0) & (waited_ns < _LATEST_NS)
        return rows[found], noise.byte(1)[found]


def _unasked(replies: Replies, due: DueReplies, to: Numbers) -> Numbers:
    """Return the servo of each reply that no instruction of this host requests; `to` is the ID of each
    instruction, or -1.

    Two kinds of replies are excluded: acknowledged writes, and the late reply of a servo whose last reply is
    missing.
    """
    rows = np.flatnonzero(replies.strange)
    exchange, servo = replies.exchange[rows], replies.servo[rows]
    if not len(rows):
        return servo
    asked = np.append((due.servo << _ROWS) + due.exchange, -1)
    order = np.argsort(asked)
    last = order[np.searchsorted(asked[order], (servo << _ROWS) + exchange, side="right") - 1]
    owed = (asked[last] >> _ROWS == servo) & (np.append(due.reply, -1)[last] < 0)
    unasked: Numbers = servo[(to[exchange] >= 0) & (to[exchange] != servo % IDS) & ~owed]
    return unasked


def _last_ns(sent_ns: Numbers, replies: Replies) -> Numbers:
    last_ns = sent_ns.copy()
    begins = np.flatnonzero(np.diff(replies.exchange, prepend=-1))
    if len(begins):
        of = replies.exchange[begins]
        last_ns[of] = np.maximum(sent_ns[of], np.maximum.reduceat(replies.last_ns, begins))
    return last_ns


def _late(
    servo: Numbers, exchange: Numbers, at_ns: Numbers, sent_ns: Numbers, due: DueReplies
) -> LateReplies:
    """Match late replies to the exchanges that lack them, and set `due.loss` there to LATE."""
    missing = np.flatnonzero(due.reply < 0)
    # The late reply of a fast status packet covers all its servos; its first one represents them.
    whole = np.flatnonzero((due.loss == Loss.LINE) & (due.place == 0))
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
    all_late = np.isin(due.exchange, found[servo % IDS == BROADCAST_ID])
    due.loss[all_late & (due.loss == Loss.LINE)] = Loss.LATE
    due.broken[due.loss == Loss.LATE] = False
    return LateReplies(servo, found, at_ns, np.where(known, at_ns - sent_ns[found], 0))


def _came_back(packets: PacketColumns, others: Numbers, rows: Numbers, sent: Numbers) -> Flags:
    """Return which foreign instructions are echoes: equal to one of the last two instructions of this host.

    Args:
        packets: All packets.
        others: Rows of instructions of other hosts.
        rows: Rows of own instructions.
        sent: Number of own instructions before each packet.
    """

    def text(row: int) -> bytes:
        start = int(packets.start[row])
        return packets.data[start : start + int(packets.length[row])].tobytes()

    last = [rows[max(0, sent[other] - 2) : sent[other]].tolist() for other in others.tolist()]
    found = [text(other) in map(text, own) for other, own in zip(others.tolist(), last, strict=True)]
    return np.array(found, np.bool_)


def _free_ns(first_ns: Numbers, wire_ns: Numbers, free_ns: np.int64) -> Numbers:
    """Return the time at which each instruction of a bus has left the wire, ns: transmission begins when
    it is written and the line is free. `free_ns` is that time for the preceding instruction."""
    sent = np.cumsum(wire_ns)
    begin: Numbers = np.maximum(np.maximum.accumulate(first_ns - sent + wire_ns), free_ns)
    return begin + sent


def ordered(packets: PacketColumns) -> PacketColumns:
    """Return the packets sorted by bus, then by time. Packets with equal times keep their order."""
    return packets.select_rows(_order(packets))


def _order(packets: PacketColumns) -> Numbers:
    order = np.argsort(packets.bus, kind="stable")
    bus, first_ns = packets.bus[order], packets.first_ns[order]
    if ((first_ns[1:] < first_ns[:-1]) & (bus[1:] == bus[:-1])).any():
        order = np.lexsort((packets.first_ns, packets.bus))
    return order
