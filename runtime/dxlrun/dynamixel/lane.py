"""Lane: the cyclic reads of one bus as they nearly always go, one after the other without a turn aside.

Asked, waited, looked at, recorded: what is sent and what comes is known to the byte, so all of it is
prepared, the log's records included. A lane ends where anything is not as it should be: what was read until
then counts, and the general machine of the bus takes over, with the bytes that came.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.burst import Burst
from dxlrun.dynamixel.port import Port, Ports
from dxlrun.dynamixel.reply_polling import ReplyPolling
from dxlrun.dynamixel.state_arrays import Rows, rows_of
from dxlrun.dynamixel.transaction import Transaction
from dxlrun.errors import PortError
from dxlrun.packets import RECORD_HEADER, PacketKind, PacketSink, record

BEAT_NS = 1_000_000
"""So long, and one read more, a lane goes on without a sign of life."""

_TIMES = struct.Struct("=qq")
_TIMES_AT = RECORD_HEADER - _TIMES.size
"""The times stand at the end of a record's header."""

Bytes2D = NDArray[np.uint8]
_Copy = tuple[NDArray[np.uint8], NDArray[np.uint8]]
_Chain = tuple[Bytes2D, Bytes2D, NDArray[np.int64]]
_Told = tuple[memoryview, slice, int, _Chain | None, Rows]
_Step = tuple[bytes, memoryview, int, int, int, int, int, Callable[[], bool], _Told]
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
    """All reads of a cycle; `run` goes through them."""

    __slots__ = (
        "_arrived_ns",
        "_copies",
        "_ended",
        "_last",
        "_log",
        "_parts",
        "_steps",
        "at_ns",
        "done",
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
        arrived_ns: NDArray[np.int64],
        ended: Callable[[Lane], Transaction | None],
    ) -> None:
        """`bus`: its number in the log; `buffer`: where replies are read to; `byte_ns`: on its wire.

        `servos`: how many the bus has; `arrived_ns`: when their replies came; `ended`: see `end`.
        """
        self.stretches = tuple(stretches)
        self._arrived_ns = arrived_ns
        self._ended = ended
        here = {servo for stretch in stretches for servo in stretch.servos}
        self.fresh = bytes(servo in here for servo in range(servos))
        """1 for each servo that is read."""
        self.sent_ns = self.at_ns = 0
        """When the newest read was sent, and when its replies were taken."""
        self.pieces: list[tuple[int, int]] = []
        """What came of the newest read: how many bytes, and when."""
        self.done = 0
        """How many reads went as they should, the last time."""
        self._log, places = _laid(stretches, bus)
        view, begin = memoryview(self._log), 0
        self._steps: list[_Step] = []
        for stretch, (asked_at, told_at) in zip(stretches, places, strict=True):
            transaction, burst = stretch.transaction, stretch.burst
            burst.bind(buffer)
            end = asked_at + RECORD_HEADER + len(transaction.packet)
            reply_at = told_at[0] + RECORD_HEADER
            self._steps.append(
                (
                    transaction.packet,
                    view[begin:end],  # the replies before, and this instruction
                    asked_at + _TIMES_AT,
                    transaction.timeout_ns,
                    transaction.due_ns,
                    burst.size,
                    (len(transaction.packet) + burst.first_size) * byte_ns,  # sooner is not of now
                    burst.clean,
                    (
                        burst.packets[0][1],
                        slice(reply_at, reply_at + burst.first_size),
                        told_at[0] + _TIMES_AT,
                        None if len(told_at) == 1 else _chain(self._log, buffer, burst, told_at),
                        rows_of(stretch.servos),
                    ),
                )
            )
            begin = end
        self._last = view[begin:]
        self._parts = [
            [
                (stretch.data, row, at)
                for row, at in zip(stretch.rows, _data_at(stretch.burst, told), strict=True)
            ]
            for stretch, (_, told) in zip(stretches, places, strict=True)
        ]
        self._copies = [
            copy
            for data in {id(stretch.data): stretch.data for stretch in stretches}.values()
            for copy in _copies(self._log, data, [part for parts in self._parts for part in parts])
        ]

    def run(  # noqa: PLR0917  the way of one cycle, taken at once
        self,
        port: Port,
        ports: Ports,
        room: memoryview,
        now_ns: Callable[[], int],
        sink: PacketSink,
        beat: Callable[[], None],
    ) -> None:
        """Read as far as all goes as it should: `done` says how far that is; the line must be free.

        Raises PortError when the line is gone; everything that was read until then is recorded.
        """
        log, records, wait, polling = self._log, sink.records, ports.wait, ports.polling
        write, read_into, arrived_ns = port.write, port.read_into, self._arrived_ns
        beat_ns = self.done = 0
        before = now_ns()
        for packet, asked, asked_at, timeout_ns, due_ns, size, least_ns, clean, told in self._steps:
            self.sent_ns = before
            try:
                write(packet)
            except PortError:
                records(asked[: -RECORD_HEADER - len(packet)])
                raise
            _stamp(log, asked_at, before, now_ns())
            records(asked)  # while the servos take it in
            if before >= beat_ns:
                beat()
                beat_ns = before + BEAT_NS
            count = 0
            if polling is not None:
                count = _polled(polling, read_into, room, now_ns, before + due_ns, before + timeout_ns)
            if not count:
                wait(before + timeout_ns)
                count = read_into(room)
            at = now_ns()
            reply, reply_at, told_at, chain, rows = told
            self.pieces = pieces = [(count, at)]
            spans: Sequence[tuple[int, int]] = ((at, at),)
            if 0 < count < size:
                burst = self.stretches[self.done].burst
                _gather(pieces, burst, port, wait, room, now_ns, before + timeout_ns)
                at = pieces[-1][1]
                count = sum(count for count, _ in pieces)
                if count == size:
                    spans = burst.spans([*accumulate(count for count, _ in pieces)], [at for _, at in pieces])
            if count != size or spans[0][1] < before + least_ns or not clean():
                return
            if chain is None:
                log[reply_at] = reply
                _stamp(log, told_at, *spans[0])
            else:
                place, replies, times = chain
                place[:] = replies
                times[:] = spans
            arrived_ns[rows] = at if len(pieces) == 1 or chain is None else [last for _, last in spans]
            if polling is not None:
                polling.came(before + due_ns, at)
            before = at
            self.done += 1
        self.at_ns = before
        records(self._last)

    @property
    def through(self) -> bool:
        """True when all reads went as they should, the last time."""
        return self.done == len(self._steps)

    def end(self) -> Transaction | None:
        """Keep what was read; return the read whose replies are still awaited, None where there is none."""
        if self.done == len(self._steps):
            for place, data in self._copies:
                place[:] = data
        else:
            log = np.frombuffer(self._log, np.uint8)
            for number in range(self.done):
                for place, row, at in self._parts[number]:
                    place[row] = log[at : at + place.shape[1]]
        return self._ended(self)


def _gather(  # noqa: PLR0917  positional is quickest
    pieces: list[tuple[int, int]],
    burst: Burst,
    port: Port,
    wait: Callable[[int], Sequence[int]],
    room: memoryview,
    now_ns: Callable[[], int],
    deadline_ns: int,
) -> None:
    """Await the rest of replies that come in pieces, as long as they look like what is awaited."""
    end = pieces[0][0]
    while end < burst.size and burst.begun(end) and wait(deadline_ns):
        try:
            count = port.read_into(room[end:])
        except PortError:
            return  # whoever looks next is told, and what came until now is not forgotten
        if not count:
            return
        end += count
        pieces.append((count, now_ns()))


def _polled(  # noqa: PLR0917  positional is quickest
    polling: ReplyPolling,
    read_into: Callable[[memoryview], int],
    room: memoryview,
    now_ns: Callable[[], int],
    due_ns: int,
    deadline_ns: int,
) -> int:
    """Sleep until shortly before a reply is due and look for it again and again; return how much came."""
    until_ns = polling.await_until(due_ns, now_ns(), deadline_ns)
    if not until_ns:
        return 0
    since_ns, looks, count = now_ns(), 1, read_into(room)
    at_ns = now_ns()
    while not count and at_ns < until_ns:
        count = read_into(room)
        at_ns = now_ns()
        looks += 1
    polling.spent(at_ns - since_ns, looks)
    return count


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


def _copies(log: bytearray, data: Bytes2D, parts: Sequence[tuple[Bytes2D, int, int]]) -> list[_Copy]:
    """Return how the data of one layout leave the records: at once, where they are equally far apart."""
    mine = [(row, at) for place, row, at in parts if place is data]
    rows = rows_of([row for row, _ in mine])
    gaps = {after - before for (_, before), (_, after) in pairwise(mine)}
    length = data.shape[1]
    if isinstance(rows, slice) and len(gaps) < 2:
        stride = next(iter(gaps), length)
        return [(data[rows], np.ndarray((len(mine), length), np.uint8, log, mine[0][1], (stride, 1)))]
    return [(data[row], np.ndarray((length,), np.uint8, log, at)) for row, at in mine]
