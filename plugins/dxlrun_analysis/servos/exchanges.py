"""Pair the instructions of a log with the replies to them, as columns: no loop goes over packets.

The packets are parsed here anew, so that nothing depends on what the run believed. A reply belongs to the
last instruction before it on its bus. Sources: ROBOTIS e-Manual, Protocol 1.0 and Protocol 2.0, instruction
and status packets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, unique

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.packets import PacketKind
from dxlrun.log.columns import PacketColumns
from dxlrun.log.reader import Log
from dxlrun_analysis.cycles.latency import DISORDER_NS
from dxlrun_analysis.plan import LoggedBus, plan_of

BROADCAST_ID = 0xFE
_IDS = 256
_ROWS = 40
"""Bits of an exchange's index in a key; above them bus and servo."""
_BYTE_NS = 10_000_000_000
"""Ten bits a byte, over the rate in bit/s."""
_HEADER_2 = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_PING, _READ = 0x01, 0x02
_SYNC_READ, _FAST_SYNC_READ, _BULK_READ, _FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A
_FAST = (_FAST_SYNC_READ, _FAST_BULK_READ)
_HEAD_2 = 8
"""Bytes before error, ID and data of the blocks of a fast status packet."""
_LATEST_NS = 100_000_000
"""A block of a fast status packet that comes later is taken for noise."""
_MIXED = np.random.default_rng(15).integers(1, 2**63, 1 << 17, dtype=np.uint64) | np.uint64(1)
"""Odd weights of a multilinear hash (Dietzfelbinger 1996): two instructions hardly ever have the same."""

Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LoggedRequest:
    """The replies that one instruction requests: from which servos, with how many bytes of data each."""

    servo_ids: tuple[int, ...] = ()
    sizes: tuple[int, ...] = ()
    """Bytes of data a servo; only for reads of several servos."""
    fast: bool = False
    """All answer in one status packet."""


@dataclass(frozen=True, slots=True, eq=False)
class Exchanges:
    """Instructions with their replies, bus by bus and in order of time; shape (exchanges,).

    The first of each bus has no instruction: what arrived before one did.
    """

    buses: tuple[LoggedBus, ...]
    requests: Sequence[LoggedRequest]
    """By `request`."""
    bus: Numbers
    cycle: Numbers
    """Number of the cycle of the instruction; of the first of each bus -1."""
    request: Numbers
    """Index in `requests`."""
    asked_ns: Numbers
    """Before the write() of the instruction."""
    sent_ns: Numbers
    """When the line had carried it, by its rate."""
    ended: Flags
    """False: the log ends before the next instruction, so a missing reply may have come a moment later."""
    noise: Numbers
    """Bytes that belong to no intact packet."""
    replies: Replies
    missing: Missing
    late: Late
    others: PacketColumns
    """Instructions of other hosts on the line."""
    echoes: Numbers
    """The bus of each own instruction that came back."""
    stray: PacketColumns
    """Bytes that belong to no intact packet."""
    asks: Flags
    """Which servos the requests ask, shape (requests, 256)."""
    places: Numbers
    """Each servo's place in the replies to each request, -1: it has none; shape (requests, 256)."""


@dataclass(frozen=True, slots=True, eq=False)
class Replies:
    """The answers of single servos, of a fast status packet several; shape (replies,)."""

    exchange: Numbers
    """Index in the exchanges."""
    servo_id: Numbers
    error: Numbers
    """The error byte."""
    protocol: Numbers
    wire_ns: Numbers
    """How long the line needs for the status packet."""
    last_ns: Numbers
    """After the read() of the status packet's last byte."""
    before_ns: Numbers
    """That of the status packet before it in its exchange; when the instruction was sent, for the first."""
    due_ns: Numbers
    """When it would have been there by wire and return delay, with all replies before it."""
    answers: Flags
    """True: requested, in time, and the servo's first in the exchange."""


@unique
class Loss(IntEnum):
    """Whose loss a missing reply is, as far as its exchange shows it."""

    OWN = 0
    """The servo's: it was asked alone, or is the first of several without an intact reply."""
    BEHIND = 1
    """That of a servo before it in the chain, or in the fast status packet."""
    LINE = 2
    """Nothing of several replies is intact: the instruction may be lost, or the first of them."""
    LATE = 3
    """None: the reply came, after it was given up."""


@dataclass(frozen=True, slots=True, eq=False)
class Missing:
    """Requested replies that are not intact; shape (missing replies,), in order of the requests."""

    exchange: Numbers
    """Index in the exchanges."""
    servo_id: Numbers
    place: Numbers
    """In the replies that the instruction requests."""
    loss: Numbers
    """A Loss each."""
    broken: Flags
    """Bytes that belong to no intact packet came in its place; always False where the loss is not its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """Intact replies that came after they were given up; shape (late replies,)."""

    bus: Numbers
    servo_id: Numbers
    """254: those of several in one fast status."""
    exchange: Numbers
    """The newest one that lacks it; -1: that is not among these."""
    at_ns: Numbers
    """After the read() of its last byte."""
    late_ns: Numbers
    """How long after its instruction had been sent; 0: not known."""


class Pairing:
    """Pairs slice by slice, in memory that does not grow with the log; keeps what may not be in order yet."""

    def __init__(self) -> None:
        self._buses: tuple[LoggedBus, ...] | None = None
        self._waiting: list[PacketColumns] = []
        self._requests = [LoggedRequest(), *(LoggedRequest((servo_id,)) for servo_id in range(_IDS))]
        """No servo, then each by itself, then as found."""
        self._known: dict[bytes, int] = {}
        self._free_ns: list[int] = []
        """When the line of each bus has carried all that was sent."""

    @property
    def buses(self) -> tuple[LoggedBus, ...]:
        """The buses of the log, with what its plan says about them."""
        return self._buses or ()

    def take(self, log: Log) -> Exchanges | None:
        """Take the packets of the next slice. Return exchanges that are certain to be whole.

        Raises LogError when a packet cannot be read.
        """
        if self._buses is None:
            planned = plan_of(log).by_name
            self._buses = tuple(planned.get(name, LoggedBus(name)) for name in log.buses)
            self._free_ns = [0] * len(self._buses)
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
        last = np.full(_IDS, len(packets), np.int64)
        last[packets.bus[instructions]] = instructions
        certain &= np.arange(len(packets)) < last[packets.bus]
        self._waiting = [packets.take(~certain).compact()]
        return self._paired(packets.take(certain), np.zeros(len(self.buses), np.bool_))

    def pair(self, packets: PacketColumns, buses: tuple[LoggedBus, ...]) -> Exchanges:
        """Return the exchanges of some packets alone, as if each was ended; not to be mixed with `take`."""
        self._buses, self._free_ns = buses, [0] * len(buses)
        return self._paired(packets, np.zeros(len(buses), np.bool_))

    def finish(self) -> Exchanges | None:
        """Return the exchanges that are left."""
        if not self._waiting:
            return None
        packets = ordered(PacketColumns.joined(self._waiting))
        self._waiting = []
        return self._paired(packets, np.ones(len(self.buses), np.bool_))

    def _paired(self, packets: PacketColumns, final: Flags) -> Exchanges:
        count = len(self.buses)
        bus = packets.bus.astype(np.int64)
        kind = packets.kind
        instructs = kind == PacketKind.INSTRUCTION
        exchange = np.cumsum(instructs) + bus
        rows = np.flatnonzero(instructs)
        heads = np.concatenate([[0], np.cumsum(np.bincount(bus[rows], minlength=count))])[:-1]
        heads += np.arange(count)
        size = len(rows) + count
        of_bus = np.repeat(np.arange(count), np.diff(np.append(heads, size)))
        at = exchange[rows]
        request, asked_ns, sent_ns, cycle = (np.zeros(size, np.int64) for _ in range(4))
        request[at] = self._requested(packets.take(rows))
        asked_ns[at] = packets.first_ns[rows]
        cycle[heads], cycle[at] = -1, packets.cycle[rows]
        wire_ns = self._wire_ns(bus, packets.length)
        for index, head in enumerate(heads.tolist()):
            mine = rows[bus[rows] == index]
            sent_ns[head] = self._free_ns[index]
            free = _free_ns(packets.first_ns[mine], wire_ns[mine], self._free_ns[index])
            sent_ns[head + 1 : head + 1 + len(free)] = free
            self._free_ns[index] = int(free[-1]) if len(free) else self._free_ns[index]
        ended = np.ones(size, np.bool_)
        ended[(np.append(heads[1:], size) - 1)[final]] = False
        noise = kind == PacketKind.NOISE
        noise_bytes = np.bincount(exchange[noise], packets.length[noise], size).astype(np.int64)
        places = np.full((len(self._requests), _IDS), -1, np.int64)
        for index, each in enumerate(self._requests):
            places[index, list(each.servo_ids[::-1])] = np.arange(len(each.servo_ids))[::-1]
        replies = self._replies(packets, exchange, wire_ns, request, sent_ns, places >= 0)
        missing = self._missing(request, replies, noise_bytes)
        blocks, block_ids = self._late_blocks(packets, exchange, request, asked_ns, of_bus, missing)
        np.subtract.at(noise_bytes, exchange[blocks], packets.length[blocks])
        missing.broken[noise_bytes[missing.exchange] <= 0] = False
        whole = np.flatnonzero(kind == PacketKind.LATE)
        ids = np.concatenate([packets.servo_id[whole].astype(np.int64), block_ids])
        late = self._late(packets, np.concatenate([whole, blocks]), ids, exchange, sent_ns, of_bus, missing)
        others = np.flatnonzero(kind == PacketKind.OTHER_HOST)
        back = _came_back(packets, others, rows, exchange - bus)
        echoes = np.concatenate([bus[others[back]], bus[kind == PacketKind.ECHO]])
        return Exchanges(
            self.buses,
            self._requests,
            of_bus,
            cycle,
            request,
            asked_ns,
            sent_ns,
            ended,
            noise_bytes,
            replies,
            missing,
            late,
            packets.take(others[~back]),
            echoes,
            packets.take(np.flatnonzero(noise)),
            places >= 0,
            places,
        )

    def _wire_ns(self, bus: Numbers, length: Numbers) -> Numbers:
        rates = np.array([plan.baud_rate for plan in self.buses], np.int64)
        return np.where(rates[bus] > 0, length * _BYTE_NS // np.maximum(rates[bus], 1), 0)

    def _requested(self, packets: PacketColumns) -> Numbers:
        """Return which request each instruction is."""
        second, code = _second(packets), instruction_of(packets)
        servo_id = np.where(second, packets.byte(4), packets.byte(2)).astype(np.int64)
        found = np.zeros(len(packets), np.int64)
        single = np.isin(code, (_PING, _READ)) & (servo_id != BROADCAST_ID)
        found[single] = servo_id[single] + 1
        many = np.where(second, np.isin(code, (_SYNC_READ, _BULK_READ, *_FAST)), code == _BULK_READ)
        for length in np.unique(packets.length[many]).tolist():
            rows = np.flatnonzero(many & (packets.length == length))
            text = packets.data[packets.start[rows][:, None] + np.arange(length)]
            mixed = text.astype(np.uint64) @ _MIXED[:length]
            _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
            found[rows] = np.array([self._index(text[row].tobytes()) for row in first.tolist()])[inverse]
        return found

    def _index(self, data: bytes) -> int:
        index = self._known.get(data)
        if index is None:
            index = self._known[data] = len(self._requests)
            self._requests.append(request_of(data))
        return index

    def _replies(  # noqa: PLR0917  columns of one table
        self,
        packets: PacketColumns,
        exchange: Numbers,
        wire_ns: Numbers,
        request: Numbers,
        sent_ns: Numbers,
        asks: Flags,
    ) -> Replies:
        late = (packets.kind == PacketKind.LATE) & (packets.servo_id != BROADCAST_ID)
        rows = np.flatnonzero((packets.kind == PacketKind.STATUS) | late)
        status = packets.take(rows)
        of, wire, last_ns = exchange[rows], wire_ns[rows], status.last_ns
        delay = np.array([plan.return_delay_ns for plan in self.buses], np.int64)[status.bus]
        spent = np.cumsum(wire + delay)
        begins = np.flatnonzero(np.diff(of, prepend=-1))
        earlier = np.repeat(spent[begins] - (wire + delay)[begins], np.diff(np.append(begins, len(of))))
        due_ns = sent_ns[of] + spent - earlier
        before_ns = np.empty(len(of), np.int64)
        before_ns[1:] = last_ns[:-1]
        before_ns[begins] = sent_ns[of[begins]]
        second = _second(status)
        joint = second & (status.servo_id == BROADCAST_ID)
        row = np.flatnonzero(~joint)
        servo_id = status.servo_id[row].astype(np.int64)
        error = np.where(second, status.byte(8), status.byte(4))[row].astype(np.int64)
        if joint.any():
            pieces = [(row, np.zeros(len(row), np.int64), servo_id, error)]
            pieces += self._blocks(status, np.flatnonzero(joint), request[of])
            row, number, servo_id, error = (np.concatenate(column) for column in zip(*pieces, strict=True))
            order = np.lexsort((number, row))
            row, servo_id, error = row[order], servo_id[order], error[order]
        return Replies(
            of[row],
            servo_id,
            error,
            np.where(second, 2, 1)[row],
            wire[row],
            last_ns[row],
            before_ns[row],
            due_ns[row],
            _answers(of[row], servo_id, asks[request[of[row]], servo_id] & ~late[rows][row]),
        )

    def _blocks(
        self, status: PacketColumns, rows: Numbers, request: Numbers
    ) -> list[tuple[Numbers, Numbers, Numbers, Numbers]]:
        """Return the replies in fast status packets: row, number of the block, servo, error byte."""
        pieces = []
        for index in np.unique(request[rows]).tolist():
            mine = rows[request[rows] == index]
            packets = status.take(mine)
            at = _HEAD_2
            for number, size in enumerate(self._requests[index].sizes):  # a block: error, ID, data, CRC
                there = at + size + 4 <= packets.length  # one that was cut has its intact blocks
                piece = (
                    mine[there],
                    np.full(int(there.sum()), number, np.int64),
                    packets.byte(at + 1)[there].astype(np.int64),
                    packets.byte(at)[there].astype(np.int64),
                )
                pieces.append(piece)
                at += size + 4
        return pieces

    def _missing(self, request: Numbers, replies: Replies, noise: Numbers) -> Missing:
        answered_by = np.bincount(replies.exchange[replies.answers], minlength=len(request))
        local = np.full(len(request), -1, np.int64)
        place = np.full(_IDS, -1, np.int64)
        parts = [(*np.zeros((4, 0), np.int64), np.zeros(0, np.bool_))]
        for index in np.unique(request).tolist():
            ids = np.array(list(dict.fromkeys(self._requests[index].servo_ids)), np.int64)
            rows = np.flatnonzero((request == index) & (answered_by < len(ids)))
            if not len(rows):
                continue
            local[rows], place[ids] = np.arange(len(rows)), np.arange(len(ids))
            mine = np.flatnonzero(replies.answers & (local[replies.exchange] >= 0))
            missing = np.ones((len(rows), len(ids)), np.bool_)
            missing[local[replies.exchange[mine]], place[replies.servo_id[mine]]] = False
            local[rows] = -1
            row, at = np.nonzero(missing)
            loss = np.where(at == missing.argmax(axis=1)[row], Loss.OWN, Loss.BEHIND)
            if len(ids) > 1:
                loss[missing.sum(axis=1)[row] == len(ids)] = Loss.LINE
            parts.append((rows[row], ids[at], at, loss, (loss == Loss.OWN) & (noise[rows[row]] > 0)))
        exchange, servo_id, at, loss, broken = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Missing(exchange, servo_id, at, loss, broken)

    def _late_blocks(  # noqa: PLR0917  columns of one table
        self,
        packets: PacketColumns,
        exchange: Numbers,
        request: Numbers,
        asked_ns: Numbers,
        of_bus: Numbers,
        missing: Missing,
    ) -> tuple[Numbers, Numbers]:
        """Return bytes that are the block that a fast status packet lacks, come later; and its ID."""
        rows = np.flatnonzero(packets.kind == PacketKind.NOISE)
        fast = np.array([one.fast for one in self._requests])
        lacks = np.flatnonzero((missing.loss == Loss.OWN) & fast[request[missing.exchange]])
        if not len(rows) or not len(lacks):
            return rows[:0], rows[:0]
        lacks = lacks[np.argsort(missing.exchange[lacks])]
        at = np.searchsorted(missing.exchange[lacks], exchange[rows]) - 1
        rows, lacks = rows[at >= 0], lacks[at[at >= 0]]
        of, noise = missing.exchange[lacks], packets.take(rows)
        sizes = [self._requests[request[one]].sizes for one in of.tolist()]
        size = np.array(
            [some[place] for some, place in zip(sizes, missing.place[lacks], strict=True)], np.int64
        )
        waited_ns = noise.first_ns - asked_ns[of]
        found = (noise.byte(1) == missing.servo_id[lacks]) & (noise.length == size + 4)
        found &= (waited_ns >= 0) & (waited_ns < _LATEST_NS)
        found &= of_bus[of] == noise.bus
        return rows[found], missing.servo_id[lacks][found]

    @staticmethod
    def _late(  # noqa: PLR0917  columns of one table
        packets: PacketColumns,
        rows: Numbers,
        servo_id: Numbers,
        exchange: Numbers,
        sent_ns: Numbers,
        bus: Numbers,
        missing: Missing,
    ) -> Late:
        """Match late replies to the exchanges that lack them, and note them there."""
        at_ns = packets.last_ns[rows]
        # of a fast status the first of its servos stands for all
        whole = np.flatnonzero((missing.loss == Loss.LINE) & (missing.place == 0))
        each = np.arange(len(missing.exchange))
        index = np.concatenate([each, whole])
        lacks = missing.exchange[index]
        of = np.concatenate([missing.servo_id, np.full(len(whole), BROADCAST_ID)])
        keys = ((bus[lacks] * _IDS + of) << _ROWS) + lacks
        order = np.argsort(keys)
        key = ((packets.bus[rows].astype(np.int64) * _IDS + servo_id) << _ROWS) + exchange[rows]
        at = np.searchsorted(keys[order], key, side="right") - 1
        known = at >= 0
        known[known] = keys[order][at[known]] >> _ROWS == key[known] >> _ROWS
        found = np.full(len(rows), -1, np.int64)
        found[known] = lacks[order][at[known]]
        missing.loss[index[order][at[known]]] = Loss.LATE
        missing.loss[
            (missing.loss == Loss.LINE) & np.isin(missing.exchange, found[servo_id == BROADCAST_ID])
        ] = Loss.LATE
        missing.broken[missing.loss == Loss.LATE] = False
        late_ns = np.where(known, at_ns - sent_ns[found], 0) if len(found) else found
        return Late(packets.bus[rows].astype(np.int64), servo_id, found, at_ns, late_ns)


def _came_back(packets: PacketColumns, others: Numbers, rows: Numbers, sent: Numbers) -> Flags:
    """Return which instructions of `others` are one of the last two of this host: `rows`, `sent` so far."""

    def text(row: int) -> bytes:
        start = int(packets.start[row])
        return packets.data[start : start + int(packets.length[row])].tobytes()

    last = [rows[max(0, sent[other] - 2) : sent[other]].tolist() for other in others.tolist()]
    found = [text(other) in map(text, own) for other, own in zip(others.tolist(), last, strict=True)]
    return np.array(found, np.bool_)


def _answers(of: Numbers, servo_id: Numbers, awaited: Flags) -> Flags:
    """Return which replies are the first of their servos in their exchanges that are `awaited`."""
    rows = np.flatnonzero(awaited)
    _, first = np.unique(of[rows] * _IDS + servo_id[rows], return_index=True)
    answers = np.zeros(len(of), np.bool_)
    answers[rows[first]] = True
    return answers


def _free_ns(first_ns: Numbers, wire_ns: Numbers, free_ns: int) -> Numbers:
    """Return when a line has carried each instruction: one begins when it is written and the line is free."""
    sent = np.cumsum(wire_ns)
    begin: Numbers = np.maximum(np.maximum.accumulate(first_ns - sent + wire_ns), free_ns)
    return begin + sent


def instruction_of(packets: PacketColumns) -> Numbers:
    """Return the code of each instruction packet."""
    return np.where(_second(packets), packets.byte(7), packets.byte(4)).astype(np.int64)


def _second(packets: PacketColumns) -> Flags:
    """Return the protocol by the header; a Protocol 1.0 packet of ID 253 has no length 0."""
    second = packets.length >= len(_HEADER_2)
    for index, byte in enumerate(_HEADER_2):
        second &= packets.byte(index) == byte
    return second


def ordered(packets: PacketColumns) -> PacketColumns:
    """Return packets bus by bus in order of time; those of one time keep theirs."""
    order = np.argsort(packets.bus, kind="stable")
    bus, first_ns = packets.bus[order], packets.first_ns[order]
    if ((np.diff(first_ns) < 0) & (np.diff(bus) == 0)).any():
        order = np.lexsort((packets.first_ns, packets.bus))
    return packets.take(order)


def request_of(data: bytes) -> LoggedRequest:
    """Return the servos that answer an instruction at every status return level: pings and reads."""
    second = data.startswith(_HEADER_2)
    servo_id, code = (_byte(data, 4), _byte(data, 7)) if second else (_byte(data, 2), _byte(data, 4))
    if code in (_PING, _READ):
        return LoggedRequest() if servo_id == BROADCAST_ID else LoggedRequest((servo_id,))
    if not second:
        return _entries(data[6:-1], 3, 1, fast=False) if code == _BULK_READ else LoggedRequest()
    body = data[8:-2].replace(_STUFFED, _PLAIN)
    fast = code in _FAST
    if code in (_SYNC_READ, _FAST_SYNC_READ):
        sizes = (int.from_bytes(body[2:4], "little"),) * len(body[4:])
        return LoggedRequest(tuple(body[4:]), sizes, fast)
    return _entries(body, 5, 0, fast=fast) if code in (_BULK_READ, _FAST_BULK_READ) else LoggedRequest()


def _entries(body: bytes, width: int, at: int, *, fast: bool) -> LoggedRequest:
    """Return the servos of a bulk read: entries of `width` bytes, the ID at `at`, the size first or last."""
    entries = [body[start : start + width] for start in range(0, len(body) - width + 1, width)]
    sizes = (entry[0] if at else int.from_bytes(entry[3:5], "little") for entry in entries)
    return LoggedRequest(tuple(entry[at] for entry in entries), tuple(sizes), fast)


def _byte(data: bytes, index: int) -> int:
    return data[index] if index < len(data) else 0
