"""Lane: the cyclic reads of one bus as they nearly always go, one after the other without a turn aside.

What is sent and what comes is known to the byte, so all of it is prepared, the log's records included. A
lane never waits: it asks, and takes what came, as the bus does that it belongs to, so any number of them go
side by side. It ends where anything is not as it should be: what was read until then counts, and the general
machine of the bus takes over, with the bytes that came.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.burst import Burst
from dxlrun.dynamixel.listening import NEVER
from dxlrun.dynamixel.port import Port
from dxlrun.dynamixel.reply_polling import ReplyPolling
from dxlrun.dynamixel.state_arrays import Counting, Source, StateArrays
from dxlrun.dynamixel.transaction import Transaction
from dxlrun.errors import PortError
from dxlrun.packets import RECORD_HEADER, PacketKind, PacketSink, record

_TIMES = struct.Struct("=qq")
_TIMES_AT = RECORD_HEADER - _TIMES.size
"""The times stand at the end of a record's header."""

Bytes2D = NDArray[np.uint8]
_Chain = tuple[Bytes2D, Bytes2D, NDArray[np.int64]]
_Ask = tuple[bytes, memoryview, int, int, int]
_Kept = tuple[memoryview, slice, int, _Chain | None, tuple[int, ...]]
_Told = tuple[int, int, Callable[[], bool], _Kept]
_stamp = _TIMES.pack_into


class Stretch(NamedTuple):
    """One read of a lane."""

    transaction: Transaction
    burst: Burst
    servos: tuple[int, ...]
    """Who answers, as indices of the plan's servos."""
    data: Bytes2D
    """Where the bytes of all servos of their layout are kept, one row a servo."""
    rows: tuple[int, ...]
    """Their rows there."""


class Lane:
    """All reads of a cycle: `ask` begins it, `take` goes on."""

    __slots__ = (
        "_arrived",
        "_asks",
        "_counts",
        "_ended",
        "_last",
        "_log",
        "_now_ns",
        "_parts",
        "_port",
        "_records",
        "_room",
        "_told",
        "at_ns",
        "awaiting",
        "deadline_ns",
        "done",
        "due_ns",
        "fresh",
        "pieces",
        "sent_ns",
        "stretches",
    )

    def __init__(  # noqa: PLR0917  what a bus and its reads have
        self,
        stretches: Sequence[Stretch],
        bus: int,
        buffer: bytearray,
        byte_ns: int,
        servos: int,
        arrays: StateArrays,
        ended: Callable[[Lane], Transaction | None],
    ) -> None:
        """`bus`: its number in the log; `buffer`: where replies are read to; `byte_ns`: on its wire.

        `servos`: how many the bus has; `arrays`: where what they say belongs; `ended`: see `end`.
        """
        self.stretches = tuple(stretches)
        self._arrived = arrays.arrivals.at_ns.data
        self._ended = ended
        here = {servo for stretch in stretches for servo in stretch.servos}
        self.fresh = bytes(servo in here for servo in range(servos))
        """1 for each servo that is read."""
        self.awaiting = False
        """True once it was begun, while replies are awaited."""
        self.sent_ns = self.due_ns = self.deadline_ns = self.at_ns = 0
        """Of the newest read: when it was sent, its replies are due, given up, and were taken."""
        self.pieces: list[tuple[int, int]] = []
        """What came of a read whose replies did not come at once: how many bytes, and when."""
        self.done = 0
        """How many reads went as they should."""
        self._room = memoryview(buffer)
        self._log, places = _laid(stretches, bus)
        self._asks: list[_Ask] = []
        self._told: list[_Told] = []
        self._last = self._prepare(places, buffer, byte_ns)
        self._parts = [
            [
                (stretch.data, row, at)
                for row, at in zip(stretch.rows, _data_at(stretch.burst, told), strict=True)
            ]
            for stretch, (_, told) in zip(stretches, places, strict=True)
        ]
        self._counts = _counts(self._log, self.stretches, places, arrays)

    def _prepare(
        self, places: Sequence[tuple[int, list[int]]], buffer: bytearray, byte_ns: int
    ) -> memoryview:
        """Prepare how each read is asked and taken; return the records behind the last instruction."""
        view, begin = memoryview(self._log), 0
        for stretch, (asked_at, told_at) in zip(self.stretches, places, strict=True):
            transaction = stretch.transaction
            stretch.burst.bind(buffer)
            end = asked_at + RECORD_HEADER + len(transaction.packet)
            asked = view[begin:end]  # the replies before, and this instruction
            times = (transaction.due_ns, transaction.timeout_ns)
            self._asks.append((transaction.packet, asked, asked_at + _TIMES_AT, *times))
            self._told.append(self._reply(stretch, told_at, buffer, byte_ns))
            begin = end
        return view[begin:]

    def _reply(self, stretch: Stretch, told_at: Sequence[int], buffer: bytearray, byte_ns: int) -> _Told:
        burst, reply_at = stretch.burst, told_at[0] + RECORD_HEADER
        least_ns = (len(stretch.transaction.packet) + burst.first_size) * byte_ns  # sooner is not of now
        kept: _Kept = (
            burst.packets[0][1],
            slice(reply_at, reply_at + burst.first_size),
            told_at[0] + _TIMES_AT,
            None if len(told_at) == 1 else _chain(self._log, buffer, burst, told_at),
            stretch.servos,
        )
        return burst.size, least_ns, burst.clean, kept

    def begin(self, port: Port, now_ns: Callable[[], int], sink: PacketSink) -> None:
        """Begin a cycle."""
        self._port, self._now_ns, self._records = port, now_ns, sink.records
        self.done = 0
        self.awaiting = False
        self.pieces.clear()

    def ask(self, free_ns: int) -> int:
        """Send the next read; return when to give it up.

        `free_ns`: when the line is; until then the read waits in the adapter behind what was sent before.
        Raises PortError when the line is gone; everything that was read until then is recorded.
        """
        packet, asked, asked_at, due_ns, timeout_ns = self._asks[self.done]
        now_ns = self._now_ns
        before = now_ns()
        try:
            self._port.write(packet)
        except PortError:
            self.awaiting = False
            self._records(asked[: -RECORD_HEADER - len(packet)])
            raise
        _stamp(self._log, asked_at, before, now_ns())
        self._records(asked)  # while the servos take it in
        self.awaiting = True
        self.sent_ns = start = free_ns if free_ns > before else before
        self.due_ns = start + due_ns
        self.deadline_ns = deadline_ns = start + timeout_ns
        return deadline_ns

    def take(self, polling: ReplyPolling | None) -> int:
        """Take what the line has, and ask the next when all replies are taken.

        Returns when to give the newest read up; NEVER when it was the last, and 0 where the lane ends before.
        Raises PortError when the line is gone.
        """
        if self.pieces:
            end = sum(count for count, _ in self.pieces)
            return self._take_piece(self._port.read_into(self._room[end:]), self._now_ns(), polling)
        size, least_ns, clean, kept = self._told[self.done]
        count = self._port.read_into(self._room)
        at = self._now_ns()
        if count != size or at < self.sent_ns + least_ns or not clean():
            return self._take_piece(count, at, polling)
        return self._keep(kept, at, at, None, polling)

    def _take_piece(self, count: int, at: int, polling: ReplyPolling | None) -> int:
        """Take some of the replies: the rest is awaited as long as they look like what is awaited."""
        if not count:
            return self.deadline_ns
        pieces, burst = self.pieces, self.stretches[self.done].burst
        pieces.append((count, at))
        ends = [*accumulate(count for count, _ in pieces)]
        if ends[-1] < burst.size and burst.begun(ends[-1]):
            return self.deadline_ns
        _, least_ns, clean, kept = self._told[self.done]
        if ends[-1] == burst.size and clean():
            spans = burst.spans(ends, [at for _, at in pieces])
            first, last = spans[0]
            if last >= self.sent_ns + least_ns:
                pieces.clear()
                return self._keep(kept, first, at, spans, polling)
        return 0

    def _keep(
        self,
        kept: _Kept,
        first: int,
        at: int,
        spans: list[tuple[int, int]] | None,
        polling: ReplyPolling | None,
    ) -> int:
        """Keep all replies of a read and go on; `spans`: of each packet, when they came in pieces."""
        reply, reply_at, told_at, chain, servos = kept
        arrived = self._arrived
        if chain is None:
            self._log[reply_at] = reply
            _stamp(self._log, told_at, first, at)
        else:
            place, replies, times = chain
            place[:] = replies
            times[:] = spans or at
        if chain is None or spans is None:
            for servo in servos:  # a few, so that an array is no quicker
                arrived[servo] = at
        else:
            for servo, (_, last) in zip(servos, spans, strict=True):
                arrived[servo] = last
        if polling is not None:
            polling.came(self.due_ns, at)
        self.done = done = self.done + 1
        if done < len(self._told):
            return self.ask(0)
        self.at_ns = at
        self._records(self._last)
        for counting in self._counts:
            counting.count()
        self._ended(self)
        return NEVER

    @property
    def through(self) -> bool:
        """True when all reads went as they should."""
        return self.done == len(self._told)

    def end(self) -> Transaction | None:
        """Keep what was read before all was; return the read whose replies are still awaited."""
        log = np.frombuffer(self._log, np.uint8)
        for number in range(self.done):
            for place, row, at in self._parts[number]:
                place[row] = log[at : at + place.shape[1]]
        return self._ended(self)


def _laid(stretches: Sequence[Stretch], bus: int) -> tuple[bytearray, list[tuple[int, list[int]]]]:
    """Return the records of a cycle, and where those of each read are: of its instruction, of replies."""
    log, places = bytearray(), []
    for transaction, burst, *_ in stretches:
        asked_at = len(log)
        log += record(bus, PacketKind.INSTRUCTION, transaction.servo_id, transaction.packet)
        told_at = []
        for servo_id, data in burst.packets:
            told_at.append(len(log))
            log += record(bus, PacketKind.STATUS, servo_id, data)
        places.append((asked_at, told_at))
    return log, places


def _chain(log: bytearray, buffer: bytearray, burst: Burst, told_at: Sequence[int]) -> _Chain:
    """Return the places of several replies, which come one behind the other, and of their times."""
    count, size, stride = len(told_at), burst.first_size, RECORD_HEADER + burst.first_size
    return (
        np.ndarray((count, size), np.uint8, log, told_at[0] + RECORD_HEADER, (stride, 1)),
        np.ndarray((count, size), np.uint8, buffer, 0, (size, 1)),
        np.ndarray((count, 2), np.int64, log, told_at[0] + _TIMES_AT, (stride, 8)),
    )


def _data_at(burst: Burst, told_at: Sequence[int]) -> list[int]:
    """Return where in the records the data of each servo are."""
    first = RECORD_HEADER + burst.data_at
    if len(told_at) == burst.count:
        return [at + first for at in told_at]
    return [told_at[0] + first + number * burst.step for number in range(burst.count)]


def _counts(
    log: bytearray,
    stretches: Sequence[Stretch],
    places: Sequence[tuple[int, list[int]]],
    arrays: StateArrays,
) -> list[Counting]:
    """Return how the data leave the records: those of one layout at once, if they are equally far apart."""
    parts = [
        (id(stretch.data), servo, at)
        for stretch, (_, told) in zip(stretches, places, strict=True)
        for servo, at in zip(stretch.servos, _data_at(stretch.burst, told), strict=True)
    ]
    found = []
    for layout in dict.fromkeys(layout for layout, *_ in parts):
        mine = [(servo, at) for one, servo, at in parts if one == layout]
        gaps = {after - before for (_, before), (_, after) in pairwise(mine)} or {0}
        several = [mine] if len(gaps) == 1 else [[one] for one in mine]
        for some in several:
            servos = [servo for servo, _ in some]
            found.append(arrays.counting(servos, Source(log, some[0][1], max(gaps))))
    return found
