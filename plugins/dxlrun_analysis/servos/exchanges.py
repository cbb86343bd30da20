"""Pair the instructions of a log with the replies to them: one table, as columns; no loop goes over packets.

The packets are parsed here anew, so that nothing depends on what the run believed. A reply belongs to the
last instruction before it on its bus. Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction
and status packets.
"""

from __future__ import annotations

from enum import IntEnum, unique
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.cycles.latency import DISORDER_NS
from dxlrun_analysis.plan import LoggedBus, plan_of
from dxlrun_analysis.servos import requests
from dxlrun_analysis.servos.requests import IDS, Flags, Numbers, Requests, RequestTable
from dxlwire import BROADCAST_ID, PacketKind

_ROWS = 40  # Bits of an exchange's index in a key; above them the servo
_BYTE_NS = 10_000_000_000  # Ten bits a byte, over the rate in bit/s
_HEAD_2 = 8  # Bytes before error, ID and data of the blocks of a fast status packet
_LATEST_NS = 100_000_000  # A block of a fast status packet that comes later is taken for noise


class Exchanges(NamedTuple):
    """Instructions with their replies, bus by bus and in order of time; columns of shape (exchanges,).

    The first of each bus has no instruction: what arrived before one did.
    """

    buses: tuple[LoggedBus, ...]
    requests: Requests  # By `request`
    bus: Numbers
    cycle: Numbers  # Number of the cycle of the instruction; of the first of each bus -1
    request: Numbers  # Index in `requests`
    asked_ns: Numbers  # Before the write() of the instruction
    blocked_ns: Numbers  # How long the write() took beyond the wire's time, where the rate is known
    sent_ns: Numbers  # When the line had carried it, by its rate
    last_ns: Numbers  # After the last reply; where there is none, `sent_ns`
    ended: Flags
    """False: the log ends before the next instruction, so a missing reply may have come a moment later."""
    noise: Numbers  # Bytes that belong to no intact packet
    replies: Replies
    due: Due
    late: Late
    others: PacketColumns  # Instructions of other hosts on the line
    echoes: Numbers  # The bus of each own instruction that came back
    unasked: Numbers  # The servo of each intact reply that no instruction of this host asks for
    stray: PacketColumns  # Bytes that belong to no intact packet


class Replies(NamedTuple):
    """What came of single servos, of a fast status packet several; shape (replies,), in order of time."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # In the replies that the instruction requests; -1: it does not
    error: Numbers  # The error byte
    protocol: Numbers
    wire_ns: Numbers  # How long the line needs for the status packet
    last_ns: Numbers  # After the read() of the status packet's last byte
    before_ns: Numbers
    """That of the status packet before it in its exchange; when the instruction was sent, for the first."""
    due_ns: Numbers  # When it would have been there by wire and return delay, with all replies before it
    answers: Flags  # True: requested, in time, and the servo's first in the exchange
    strange: Flags  # True: a whole status packet of one servo that its exchange does not request


@unique
class Loss(IntEnum):
    """Whose loss a missing reply is, as far as its exchange shows it."""

    NONE = -1  # It is not missing
    OWN = 0  # The servo's: it was asked alone, or is the first of several without an intact reply
    BEHIND = 1  # That of a servo before it in the chain, or in the fast status packet
    LINE = 2  # Nothing of several replies is intact: the instruction may be lost, or the first of them
    LATE = 3  # None: the reply came, after it was given up


class Due(NamedTuple):
    """Each reply that was requested, exchange by exchange and in order of places; shape (due replies,)."""

    exchange: Numbers  # Index in the exchanges
    servo: Numbers
    place: Numbers  # In the replies that the instruction requests
    reply: Numbers  # The answer, an index in the replies; -1: it is missing
    loss: Numbers  # A Loss each
    broken: Flags
    """Bytes that belong to no intact packet came in its place; always False where the loss is not its own."""


class Late(NamedTuple):
    """Intact replies that came after they were given up; shape (late replies,)."""

    servo: Numbers  # ID 254: those of several in one fast status
    exchange: Numbers  # The newest one that lacks it; -1: that is not among these
    at_ns: Numbers  # After the read() of its last byte
    late_ns: Numbers  # How long after its instruction had been sent; 0: not known


class Pairing:
    """Pairs slice by slice, in memory that does not grow with the log; keeps what may not be in order yet."""

    def __init__(self, buses: tuple[LoggedBus, ...] = ()) -> None:
        """`buses`: of the log; without them those of the first slice."""
        self.buses = buses  # The buses of the log, with what its plan says about them
        self._waiting: list[PacketColumns] = []
        self._requests = RequestTable()
        self._free_ns = np.zeros(len(buses), np.int64)
        """When the line of each bus has carried all that was sent."""

    def take(self, log: Log) -> Exchanges | None:
        """Take the packets of the next slice. Return exchanges that are certain to be whole.

        Raises LogError when a packet cannot be read.
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
        packets = ordered(PacketColumns.joined(self._waiting))
        certain = packets.first_ns < newest_ns - DISORDER_NS
        # the last instruction of each bus is held: its replies may still come
        instructions = np.flatnonzero(certain & (packets.kind == PacketKind.INSTRUCTION))
        last = np.full(IDS, len(packets), np.int64)
        last[packets.bus[instructions]] = instructions
        certain &= np.arange(len(packets)) < last[packets.bus]
        self._waiting = [packets.take(~certain).compact()]
        return self._paired(packets.take(certain))

    def finish(self) -> Exchanges | None:
        """Return the exchanges that are left."""
        if not self._waiting:
            return None
        packets = ordered(PacketColumns.joined(self._waiting))
        self._waiting = []
        return self._paired(packets, final=True)

    def alone(self, packets: PacketColumns) -> Exchanges:
        """Return the exchanges of some packets as if nothing was before them, and each was ended."""
        self._free_ns[:] = 0
        return self._paired(packets)

    def _paired(self, packets: PacketColumns, *, final: bool = False) -> Exchanges:
        """Return the exchanges of the next packets, bus by bus in order of time; `final`: none come after."""
        count, kind = len(self.buses), packets.kind
        bus = packets.bus.astype(np.int64)
        instructs = kind == PacketKind.INSTRUCTION
        exchange, rows = np.cumsum(instructs) + bus, np.flatnonzero(instructs)
        at, size = exchange[rows], len(rows) + count
        heads = np.searchsorted(bus[rows], np.arange(count)) + np.arange(count)
        of_bus = np.repeat(np.arange(count), np.diff(np.append(heads, size)))
        rates = np.array([one.baud_rate for one in self.buses], np.int64)[bus]
        delays = np.array([one.return_delay_ns for one in self.buses], np.int64)[bus]
        wire_ns = np.where(rates > 0, packets.length * _BYTE_NS // np.maximum(rates, 1), 0)
        request, asked_ns, blocked_ns, sent_ns, cycle = (np.zeros(size, np.int64) for _ in range(5))
        request[at] = self._requests.of(packets.take(rows))
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
        blocks, block_ids = self._late_blocks(packets.take(noise), exchange[noise], request, asked_ns, due)
        np.subtract.at(noise_bytes, exchange[noise[blocks]], packets.length[noise[blocks]])
        due.broken[noise_bytes[due.exchange] <= 0] = False
        late = np.append(np.flatnonzero(kind == PacketKind.LATE), noise[blocks])
        ids = np.append(packets.servo_id[late[: len(late) - len(blocks)]], block_ids)
        to = np.full(size, -1, np.int64)
        to[at] = packets.servo_id[rows]
        to[at[(to[at] == BROADCAST_ID) & (requests.instruction_of(packets.take(rows)) == requests.PING)]] = -1
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
            packets.take(others[~back]),
            np.append(bus[others[back]], bus[kind == PacketKind.ECHO]),
            _unasked(replies, due, to),
            packets.take(noise),
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
        status = packets.take(rows)
        of, wire, last_ns = exchange[rows], wire_ns[rows], status.last_ns
        took = wire + delays[rows]
        spent = np.cumsum(took)
        begins = np.flatnonzero(np.diff(of, prepend=-1))
        earlier = np.repeat(spent[begins] - took[begins], np.diff(np.append(begins, len(of))))
        due_ns = sent_ns[of] + spent - earlier
        before_ns = np.empty(len(of), np.int64)
        before_ns[1:] = last_ns[:-1]
        before_ns[begins] = sent_ns[of[begins]]
        second = requests.second_of(status)
        joint = second & (status.servo_id == BROADCAST_ID)
        row = np.flatnonzero(~joint)
        servo_id, error = status.servo_id[row], np.where(second, status.byte(8), status.byte(4))[row]
        if joint.any():
            pieces = [(row, np.zeros(len(row), np.int64), servo_id, error)]
            pieces += self._blocks(status, np.flatnonzero(joint), request[of])
            row, number, servo_id, error = (np.concatenate(column) for column in zip(*pieces, strict=True))
            order = np.lexsort((number, row))
            row, servo_id, error = row[order], servo_id[order], error[order]
        place = self._requests.all.places[request[of[row]], servo_id]
        return Replies(
            of[row],
            status.bus[row].astype(np.int64) * IDS + servo_id,
            place,
            error.astype(np.int64),
            np.where(second, 2, 1)[row],
            wire[row],
            last_ns[row],
            before_ns[row],
            due_ns[row],
            (place >= 0) & ~late[rows[row]],
            (place < 0) & ~late[rows[row]] & ~joint[row],
        )

    def _blocks(
        self, status: PacketColumns, rows: Numbers, request: Numbers
    ) -> list[tuple[Numbers, Numbers, NDArray[np.uint8], NDArray[np.uint8]]]:
        """Return the replies in fast status packets: row, number of the block, servo, error byte."""
        pieces = []
        for index in np.unique(request[rows]).tolist():
            mine = rows[request[rows] == index]
            packets = status.take(mine)
            at = _HEAD_2
            # a block: error, ID, data, CRC
            for number, size in enumerate(self._requests.all.kinds[index].sizes):
                there = at + size + 4 <= packets.length  # one that was cut has its intact blocks
                numbers = np.full(int(there.sum()), number, np.int64)
                pieces.append((mine[there], numbers, packets.byte(at + 1)[there], packets.byte(at)[there]))
                at += size + 4
        return pieces

    def _due(self, bus: Numbers, request: Numbers, replies: Replies, noise: Numbers) -> Due:
        count = self._requests.all.servos[request]
        exchange, begin = np.repeat(np.arange(len(request)), count), np.cumsum(count) - count
        place = np.arange(len(exchange)) - begin[exchange]
        servo_id = self._requests.all.ids[request[exchange], place - count[exchange]]
        reply = np.full(len(exchange), -1, np.int64)
        rows = np.flatnonzero(replies.answers)[::-1]  # of several replies of a servo the first counts
        reply[begin[replies.exchange[rows]] + replies.place[rows]] = rows
        replies.answers[:] = False
        replies.answers[reply[reply >= 0]] = True
        loss, missing = np.full(len(exchange), Loss.NONE, np.int64), np.flatnonzero(reply < 0)
        loss[missing] = np.where(np.diff(exchange[missing], prepend=-1) > 0, Loss.OWN, Loss.BEHIND)
        silent = (np.bincount(exchange[missing], minlength=len(request)) == count) & (count > 1)
        loss[silent[exchange]] = Loss.LINE
        broken = (loss == Loss.OWN) & (noise[exchange] > 0)
        return Due(exchange, bus[exchange] * IDS + servo_id, place, reply, loss, broken)

    def _late_blocks(
        self, noise: PacketColumns, exchange: Numbers, request: Numbers, asked_ns: Numbers, due: Due
    ) -> tuple[Numbers, NDArray[np.uint8]]:
        """Return bytes that are the block that a fast status packet lacks, come later; and its ID."""
        lacks = np.flatnonzero((due.loss == Loss.OWN) & self._requests.all.fast[request[due.exchange]])
        at = np.searchsorted(due.exchange[lacks], exchange) - 1
        rows = np.flatnonzero(at >= 0)
        lacks, noise = lacks[at[rows]], noise.take(rows)
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


def _unasked(replies: Replies, due: Due, to: Numbers) -> Numbers:
    """Return the servo of each reply that nothing asks for; `to`: the ID of each instruction, -1: all.

    A servo may acknowledge what is written to it, and one whose last reply is missing is late with that.
    """
    rows = np.flatnonzero(replies.strange)
    exchange, servo = replies.exchange[rows], replies.servo[rows]
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


def _late(servo: Numbers, exchange: Numbers, at_ns: Numbers, sent_ns: Numbers, due: Due) -> Late:
    """Match late replies to the exchanges that lack them, and note them there."""
    missing = np.flatnonzero(due.reply < 0)
    # of a fast status the first of its servos stands for all
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
    return Late(servo, found, at_ns, np.where(known, at_ns - sent_ns[found], 0))


def _came_back(packets: PacketColumns, others: Numbers, rows: Numbers, sent: Numbers) -> Flags:
    """Return which instructions of `others` are one of the last two of this host: `rows`, `sent` so far."""

    def text(row: int) -> bytes:
        start = int(packets.start[row])
        return packets.data[start : start + int(packets.length[row])].tobytes()

    last = [rows[max(0, sent[other] - 2) : sent[other]].tolist() for other in others.tolist()]
    found = [text(other) in map(text, own) for other, own in zip(others.tolist(), last, strict=True)]
    return np.array(found, np.bool_)


def _free_ns(first_ns: Numbers, wire_ns: Numbers, free_ns: np.int64) -> Numbers:
    """Return when a line has carried each instruction: one begins when it is written and the line is free."""
    sent = np.cumsum(wire_ns)
    begin: Numbers = np.maximum(np.maximum.accumulate(first_ns - sent + wire_ns), free_ns)
    return begin + sent


def ordered(packets: PacketColumns) -> PacketColumns:
    """Return packets bus by bus in order of time; those of one time keep theirs."""
    order = np.argsort(packets.bus, kind="stable")
    bus, first_ns = packets.bus[order], packets.first_ns[order]
    if ((np.diff(first_ns) < 0) & (np.diff(bus) == 0)).any():
        order = np.lexsort((packets.first_ns, packets.bus))
    return packets.take(order)
