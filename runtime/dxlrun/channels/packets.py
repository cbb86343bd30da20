"""Packets as the log keeps them: every byte on every bus, with the times at which it was seen."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from dxlrun.channels.ring import RING_SECONDS, Appender, Payload, RecordKind, RingWriter, record_size
from dxlwire.packets import RECORD, RECORD_HEADER, Desk, PacketKind, PacketLog

LONGEST_BATCH = 16 * 1024
"""Bytes: a batch has the packets of one cycle, of a large robot and of noisy lines in pieces of this size."""

_BATCH = struct.Struct("<QQ")
"""In front of a batch, cycles counted from 1, 0: before the first. The cycle of its first packets; then the
cycle of all others, shifted by _MARK_BITS, and where those begin. One word, so that it is never torn."""
_MARK_BITS = 16
_USED, _POSITION, _EARLIER, _CYCLE = range(4)
_WORDS = 4
_DESK_HEADER = 8 * _WORDS
_BATCH_AT = 8 * _EARLIER
DESK_SIZE = _BATCH_AT + LONGEST_BATCH
"""Bytes of memory for a batch that is not finished."""
BEFORE_FIRST_CYCLE = -1
"""Cycle of the packets that set the servos up."""


_KINDS = frozenset(int(kind) for kind in PacketKind)


@dataclass(frozen=True, slots=True)
class LoggedPacket:
    """One packet, or one run of noise, on one bus.

    An instruction's times: before and after the write() that sent it. A status packet's: after the read()
    that brought its first and its last byte. ns of the run's clock.
    """

    bus: int
    """Index in the plan's buses."""
    kind: PacketKind
    servo_id: int
    """Of the servo that is addressed or that answers; 254: all of them, and noise of unknown origin."""
    first_ns: int
    last_ns: int
    data: bytes


class PacketBatch(PacketLog):
    """Collects packets in a buffer made before real time; one `commit` a cycle hands them on together.

    A batch has the packets of one cycle, and in front of them those of the idle time before it, which are of
    the period of an earlier cycle: `wake` marks where the cycle begins.

    A full buffer commits by itself. Bytes longer than the buffer (noise only) become several packets.

    `desk` is the memory where the unfinished batch lies, usually of DESK_SIZE; shared memory lets whichever
    process outlives this one take it up with `salvage`, so that a loop that dies in the middle of a cycle
    does not take that cycle's packets with it. Four 64-bit words lead it: bytes used, the position of its
    ring at which the batch will lie, and the cycles of the batch, with which it begins. Each is one store,
    because a process may be killed between any two.
    """

    __slots__ = ("_batch", "_buffer", "_room", "_words", "_writer", "commit")

    def __init__(
        self, writer: Appender, desk: memoryview | None = None, cycle: int = BEFORE_FIRST_CYCLE
    ) -> None:
        self._writer = writer
        if desk is None:
            desk = memoryview(bytearray(DESK_SIZE))
        self._words = desk[:_DESK_HEADER].cast("Q")
        self._batch = desk[_BATCH_AT:]
        self._buffer = desk[_DESK_HEADER:]
        self._room = len(self._buffer)
        self._words[_USED] = 0
        self._words[_POSITION] = writer.head
        self._words[_CYCLE] = cycle + 1 << _MARK_BITS
        if self._room <= RECORD_HEADER:
            raise ValueError(f"a desk of {self._room} bytes holds no packet")
        self.commit: Callable[[], object] = self._hand_on
        """Hands on what was collected; without packets nothing is."""
        if isinstance(writer, RingWriter):
            self.commit = writer.commits(desk, len(self._batch))

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: int, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Record bytes that were sent or received; times in ns of the run's clock."""
        length = len(data)
        start = self._words[_USED]
        body = start + RECORD_HEADER
        end = body + length
        if end > self._room:
            self._overfull((bus, kind, servo_id, first_ns, last_ns), data)
            return
        RECORD.pack_into(self._buffer, start, bus, kind, servo_id, length, first_ns, last_ns)
        self._buffer[body:end] = data
        self._words[_USED] = end

    @property
    def desk(self) -> Desk:
        """The memory in which the batch is collected."""
        return Desk(self._buffer, self._words[_USED : _USED + 1])

    def _overfull(self, head: tuple[int, int, int, int, int], data: Payload) -> None:
        self.commit()
        most = self._room - RECORD_HEADER
        for start in range(0, len(data), most):
            self.packet(*head, data[start : start + most])

    def wake(self, cycle: int) -> None:
        """Note that a cycle begins: what was collected before was of the idle time of an earlier one."""
        words = self._words
        words[_CYCLE] = cycle + 1 << _MARK_BITS | words[_USED]

    def _hand_on(self) -> None:
        # as dxl_commit in kernel.c does, for a reader in the same process
        words = self._words
        if used := words[_USED]:
            position = self._writer.append(RecordKind.PACKETS, self._batch[: _BATCH.size + used])
            words[_USED] = 0
            words[_POSITION] = position
        number = words[_CYCLE] >> _MARK_BITS
        words[_CYCLE] = number << _MARK_BITS  # from here on the earlier one means nothing
        words[_EARLIER] = number


def salvage(desk: memoryview, head: int, writer: Appender) -> int:
    """Append the batch that a process left unfinished when it died; call it when that process is gone.

    `head`: that of its ring. A process that died after it had appended the batch, and before it had cleared
    the desk, left nothing unfinished. Return the cycle in whose period it died.
    """
    words = desk[:_DESK_HEADER].cast("Q")
    used = words[_USED]
    if words[_POSITION] == head and 0 < used <= len(desk) - _DESK_HEADER:
        writer.append(RecordKind.PACKETS, desk[_BATCH_AT : _DESK_HEADER + used])
        words[_USED] = 0
    return (words[_CYCLE] >> _MARK_BITS) - 1


BatchedPacket = tuple[int, int, int, int, int, int, bytes]
"""Cycle, and the fields of LoggedPacket, as plain values."""


def split_packets(payload: Payload) -> list[BatchedPacket]:
    """Return the packets as plain values: the recorder takes thousands a second.

    Raises ValueError when the payload is not a batch.
    """
    packets: list[BatchedPacket] = []
    start, end = _BATCH.size, len(payload)
    try:
        earlier, now = _BATCH.unpack_from(payload)
    except struct.error as error:
        raise ValueError(f"a batch of packets has no cycle: {error}") from error
    mark = start + now % (1 << _MARK_BITS)
    earlier, number = earlier - 1, (now >> _MARK_BITS) - 1
    while start < end:
        try:
            bus, kind, servo_id, length, first_ns, last_ns = RECORD.unpack_from(payload, start)
        except struct.error as error:
            raise ValueError(f"a batch of packets ends inside a header: {error}") from error
        if kind not in _KINDS:
            raise ValueError(f"a packet is of kind {kind}, which is none")
        cycle = earlier if start < mark else number
        start += RECORD_HEADER
        data = bytes(payload[start : start + length])
        if len(data) != length:
            raise ValueError("a batch of packets ends inside a packet")
        packets.append((cycle, bus, kind, servo_id, first_ns, last_ns, data))
        start += length
    return packets


def packet_capacity(period_ns: int, servos: int) -> int:
    """Return how many bytes of a ring hold 10 s of a robot with `servos` servos in all.

    Per cycle: one instruction and one status a servo (Protocol 1.0 reads), goals, one probe, at most 40
    bytes each beside the header.
    """
    cycle = record_size((2 * servos + 4) * (RECORD_HEADER + 40))
    return max(32 * LONGEST_BATCH, RING_SECONDS * 1_000_000_000 // period_ns * cycle)
