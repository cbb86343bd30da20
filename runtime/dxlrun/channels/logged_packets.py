"""Packets: records of all bytes on all buses with their times, from the loop to the log."""

from __future__ import annotations

import struct
from collections.abc import Callable

import msgspec

from dxlrun.channels.ring import RING_SECONDS, Appender, Payload, RecordKind, RingWriter, record_size
from dxlwire.packets import RECORD, RECORD_HEADER, Desk, PacketKind, PacketLog

LONGEST_BATCH = 16 * 1024
"""Longest batch, bytes. A batch has the packets of one cycle; a large robot or noisy lines need several."""

_BATCH = struct.Struct("<QQ")
"""Header of a batch. First word: cycle of the first packets. Second word: cycle of the following packets,
shifted by _MARK_BITS, and their offset. They share a word so that they change together. Cycles are counted
from 1; 0: before the first cycle."""
_MARK_BITS = 16
_USED, _POSITION, _EARLIER, _CYCLE = range(4)
_WORDS = 4
_DESK_HEADER = 8 * _WORDS
_BATCH_AT = 8 * _EARLIER
DESK_SIZE = _BATCH_AT + LONGEST_BATCH
"""Size of the memory for an unfinished batch of packets, bytes."""
BEFORE_FIRST_CYCLE = -1
"""Cycle number of the packets that configure the servos."""


_KINDS = frozenset(int(kind) for kind in PacketKind)


class LoggedPacket(msgspec.Struct, frozen=True):
    """A packet or a sequence of noise bytes on a bus.

    Times of an instruction packet: before and after the write() that sent it. Times of a status packet: after
    the read() calls that returned its first and its last byte. Unit: ns of the run's clock.
    """

    bus: int
    """Index in the plan's buses."""
    kind: PacketKind
    servo_id: int
    """ID of the addressed or responding servo; 254: broadcast, or noise of unknown origin."""
    first_ns: int
    last_ns: int
    data: bytes


class PacketBatch(PacketLog):
    """Collects packets in a preallocated buffer. One `commit_packets` a cycle appends them to a ring as a
    batch.

    A batch starts with the packets of the idle time before the cycle, which belong to the period of an
    earlier cycle. `wake` marks the begin of the cycle.

    A full buffer is committed automatically. Noise that is longer than the buffer becomes several packets.

    The unfinished batch is in the memory `desk`. If that is shared memory, a process that outlives this one
    can recover the batch with `salvage`, so the packets of a cycle in which the loop is killed are not lost.
    The desk begins with four 64-bit words: bytes used, ring position of the batch, and the two words of the
    batch's header. Each change is a single store, because the process may be killed between two of them.

    Args:
        writer: Ring for the batches.
        desk: Memory for the unfinished batch, usually DESK_SIZE bytes; None: private memory.
        cycle: Cycle of the first packets.
    """

    __slots__ = ("_batch", "_buffer", "_room", "_words", "_writer", "commit_packets")

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
            raise ValueError(f"a buffer of {self._room} bytes cannot hold a packet")
        self.commit_packets: Callable[[], object] = self._hand_on
        """Appends the collected packets as one batch to the ring, if there are any."""
        if isinstance(writer, RingWriter):
            self.commit_packets = writer.commits(desk, len(self._batch))

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: int, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Add bytes that were sent or received on a bus; see `LoggedPacket` for the arguments."""
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
        """Memory in which the unfinished batch is collected."""
        return Desk(self._buffer, self._words[_USED : _USED + 1])

    def _overfull(self, head: tuple[int, int, int, int, int], data: Payload) -> None:
        self.commit_packets()
        most = self._room - RECORD_HEADER
        for start in range(0, len(data), most):
            self.packet(*head, data[start : start + most])

    def wake(self, cycle: int) -> None:
        """Mark the begin of a cycle.

        Earlier packets of the batch belong to the idle time of the cycle before.
        """
        words = self._words
        words[_CYCLE] = cycle + 1 << _MARK_BITS | words[_USED]

    def _hand_on(self) -> None:
        # Same as dxl_commit in shared_memory.c, for a reader in the same process.
        words = self._words
        if used := words[_USED]:
            position = self._writer.append(RecordKind.PACKETS, self._batch[: _BATCH.size + used])
            words[_USED] = 0
            words[_POSITION] = position
        number = words[_CYCLE] >> _MARK_BITS
        words[_CYCLE] = number << _MARK_BITS  # offset 0: the earlier cycle is unused
        words[_EARLIER] = number


def salvage(desk: memoryview, head: int, writer: Appender) -> int:
    """Append the unfinished batch that a process left on its desk when it was killed.

    The batch is ignored if the process exited after it had appended the batch and before it had cleared the
    desk.

    Args:
        desk: The desk of the process.
        head: Head of the ring of the process.
        writer: Ring that receives the batch.

    Returns:
        The cycle in whose period the process exited.
    """
    words = desk[:_DESK_HEADER].cast("Q")
    used = words[_USED]
    if words[_POSITION] == head and 0 < used <= len(desk) - _DESK_HEADER:
        writer.append(RecordKind.PACKETS, desk[_BATCH_AT : _DESK_HEADER + used])
        words[_USED] = 0
    return (words[_CYCLE] >> _MARK_BITS) - 1


BatchedPacket = tuple[int, int, int, int, int, int, bytes]
"""Cycle number and the fields of LoggedPacket (bus, kind, servo ID, two times, data), as a tuple."""


def split_packets(payload: Payload) -> list[BatchedPacket]:
    """Return the packets of a logged batch as tuples, because the recorder handles thousands a second.

    Raises:
        ValueError: The payload is not a complete batch, as in a damaged log.
    """
    packets: list[BatchedPacket] = []
    start, end = _BATCH.size, len(payload)
    try:
        earlier, now = _BATCH.unpack_from(payload)
    except struct.error as error:
        raise ValueError(f"a batch of logged packets has no cycle number: {error}") from error
    mark = start + now % (1 << _MARK_BITS)
    earlier, number = earlier - 1, (now >> _MARK_BITS) - 1
    while start < end:
        try:
            bus, kind, servo_id, length, first_ns, last_ns = RECORD.unpack_from(payload, start)
        except struct.error as error:
            raise ValueError(f"a batch of logged packets ends inside a header: {error}") from error
        if kind not in _KINDS:
            raise ValueError(f"a packet is of the unknown kind {kind}")
        cycle = earlier if start < mark else number
        start += RECORD_HEADER
        data = bytes(payload[start : start + length])
        if len(data) != length:
            raise ValueError("a batch of logged packets ends inside a packet")
        packets.append((cycle, bus, kind, servo_id, first_ns, last_ns, data))
        start += length
    return packets


def packet_capacity(period_ns: int, servos: int) -> int:
    """Return the size of the ring for packet batches, bytes, for 10 s of a robot's packets.

    A cycle has one instruction and one status packet a servo (Protocol 1.0 reads), goals and one probe, each
    of at most 40 bytes plus the header.

    Args:
        period_ns: Period of the loop.
        servos: Number of servos on all buses.
    """
    cycle = record_size((2 * servos + 4) * (RECORD_HEADER + 40))
    return max(32 * LONGEST_BATCH, RING_SECONDS * 1_000_000_000 // period_ns * cycle)
