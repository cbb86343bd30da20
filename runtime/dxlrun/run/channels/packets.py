"""Packets as the log keeps them: every byte on every bus, with the times at which it was seen."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, unique
from typing import Protocol

from dxlrun.run.channels.ring import RING_SECONDS, Appender, Payload

PACKET_SLOT = 2048
"""Bytes of one slot of the packets' ring: a batch, usually the packets of one cycle."""

_HEADER = struct.Struct("<BBBxI qq")
RECORD_HEADER = _HEADER.size
"""Bytes in front of the packet in its record; its two times, 64-bit each, are the last of them."""
_USED, _NUMBER = 0, 1
_WORDS = 2
_DESK_HEADER = 8 * _WORDS


@unique
class PacketKind(IntEnum):
    """What a run of bytes was; the number is in the log."""

    INSTRUCTION = 1
    STATUS = 2
    NOISE = 3
    """Bytes from the line that belong to no intact packet."""


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
    """Who is addressed or who answers; 254 is everybody, and noise of nobody known."""
    first_ns: int
    last_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Desk:
    """Memory of a batch that is not committed yet."""

    records: memoryview
    """The records, one behind the other."""
    used: memoryview
    """One 64-bit word: how many of these bytes are used."""


class PacketSink(Protocol):
    """Takes packets; never blocks, never raises."""

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Record bytes that were sent or received; `data` is copied before the call returns."""
        ...


class PacketLog(PacketSink, Protocol):
    """Takes packets of the cyclic exchange, too."""

    @property
    def desk(self) -> Desk | None:
        """Where the exchange's kernel appends records by itself; None: what it exchanges is not recorded."""
        ...

    def commit(self) -> None:
        """Hand on what was collected."""
        ...


class PacketBatch:
    """Collects packets in a buffer made before real time; one `commit` a cycle hands them on together.

    A full buffer commits by itself. Bytes that are longer than a slot (noise only) become several records.

    `desk` is memory of `desk_size(writer)` bytes where the unfinished batch lies; shared memory lets whoever
    outlives this process take it up with `salvage`, so that a loop that dies in the middle of a cycle does
    not take that cycle's packets with it. Two 64-bit words lead it: bytes used, and the number that the batch
    gets in its ring. Each is one store, because a process may be killed between any two.
    """

    __slots__ = ("_buffer", "_room", "_words", "_writer")

    def __init__(self, writer: Appender, desk: memoryview | None = None) -> None:
        self._writer = writer
        if desk is None:
            desk = memoryview(bytearray(desk_size(writer)))
        self._words = desk[:_DESK_HEADER].cast("Q")
        self._buffer = desk[_DESK_HEADER : desk_size(writer)]  # shared memory may be larger
        self._room = len(self._buffer)
        self._words[_USED] = 0
        self._words[_NUMBER] = writer.head
        if self._room <= _HEADER.size:
            raise ValueError(f"a slot of {self._room} bytes holds no packet")

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
        _HEADER.pack_into(self._buffer, start, bus, kind, servo_id, length, first_ns, last_ns)
        self._buffer[body:end] = data
        self._words[_USED] = end

    @property
    def desk(self) -> Desk:
        """The memory in which the batch is collected."""
        return Desk(self._buffer, self._words[_USED : _USED + 1])

    def _overfull(self, head: tuple[int, int, int, int, int], data: Payload) -> None:
        self.commit()
        most = self._room - _HEADER.size
        for start in range(0, len(data), most):
            self.packet(*head, data[start : start + most])

    def commit(self) -> None:
        """Hand on what was collected; without packets nothing happens."""
        if used := self._words[_USED]:
            number = self._writer.append(self._buffer[:used])
            self._words[_USED] = 0
            self._words[_NUMBER] = number + 1


def desk_size(writer: Appender) -> int:
    """Return how many bytes of memory the unfinished batch of a writer needs."""
    return _DESK_HEADER + min(writer.slot_size, 1 << 16)


def salvage(desk: memoryview, committed: int, writer: Appender) -> None:
    """Append the batch that a process left unfinished when it died; call it when that process is gone.

    `committed`: how many batches its ring has (`head`). A process that died after it had appended the batch,
    and before it had cleared the desk, left nothing unfinished.
    """
    words = desk[:_DESK_HEADER].cast("Q")
    used = words[_USED]
    if words[_NUMBER] == committed and 0 < used <= min(len(desk) - _DESK_HEADER, writer.slot_size):
        writer.append(desk[_DESK_HEADER : _DESK_HEADER + used])
        words[_USED] = 0


class NoPackets:
    """Takes packets and forgets them: a run without a log."""

    __slots__ = ()

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Payload
    ) -> None:
        """Forget it."""

    @property
    def desk(self) -> None:
        """There is none."""

    def commit(self) -> None:
        """Nothing to hand on."""


def decode_packets(payload: Payload) -> list[LoggedPacket]:
    """Return the packets of one committed batch, oldest first. Raises ValueError when it is not one."""
    return [
        LoggedPacket(bus, PacketKind(kind), servo_id, first_ns, last_ns, data)
        for bus, kind, servo_id, first_ns, last_ns, data in split_packets(payload)
    ]


def split_packets(payload: Payload) -> list[tuple[int, int, int, int, int, bytes]]:
    """Return the fields of LoggedPacket as plain values: the recorder takes thousands a second.

    Raises ValueError when the payload is not a batch.
    """
    packets: list[tuple[int, int, int, int, int, bytes]] = []
    start, end = 0, len(payload)
    while start < end:
        try:
            bus, kind, servo_id, length, first_ns, last_ns = _HEADER.unpack_from(payload, start)
        except struct.error as error:
            raise ValueError(f"a batch of packets ends inside a header: {error}") from error
        if kind not in _KINDS:
            raise ValueError(f"a packet is of kind {kind}, which is none")
        start += _HEADER.size
        data = bytes(payload[start : start + length])
        if len(data) != length:
            raise ValueError("a batch of packets ends inside a packet")
        packets.append((bus, kind, servo_id, first_ns, last_ns, data))
        start += length
    return packets


def packet_slots(period_ns: int, servos: int) -> int:
    """Return how many slots of PACKET_SLOT hold 10 s of a robot with `servos` servos in all.

    Per cycle: one instruction and one status a servo (Protocol 1.0 reads), goals, one probe, at most 40
    bytes each beside the header; plus the unfinished slot of each commit.
    """
    per_cycle = (2 * servos + 4) * (_HEADER.size + 40)
    return max(256, RING_SECONDS * 1_000_000_000 // period_ns * (1 + -(-per_cycle // PACKET_SLOT)))
