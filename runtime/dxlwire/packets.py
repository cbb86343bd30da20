"""Packets on a bus: their kinds, the record format of the exchange kernel, and their receivers."""

from __future__ import annotations

import struct
from enum import IntEnum, unique

import msgspec

Bytes = bytes | bytearray | memoryview

RECORD = struct.Struct("<BBBxI qq")
"""Header before a packet: bus, kind, servo ID, length, time of the first and of the last byte in ns."""
RECORD_HEADER = RECORD.size  # Bytes; the last 16 are the two times


@unique
class PacketKind(IntEnum):
    """Kind of a sequence of bytes; the number is in the log."""

    INSTRUCTION = 1
    STATUS = 2
    """A status packet. For a truncated or corrupted fast form only its intact entries."""
    NOISE = 3
    """Bytes from the line that belong to no intact packet."""
    LATE = 4
    """An intact status that arrived after its timeout and was not used."""
    OTHER_HOST = 5
    """An intact packet that servos do not send: an instruction of another host on the line."""
    ECHO = 6
    """An instruction of this host, echoed by the adapter."""


class Desk(msgspec.Struct, frozen=True):
    """Memory of a log batch that is not committed yet."""

    records: memoryview
    """Buffer with the records, one after the other."""
    used: memoryview
    """One 64-bit word: number of used bytes in the buffer."""


class PacketSink:
    """Receiver of packets; never blocks, never raises. This base class discards them."""

    __slots__ = ()

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Bytes
    ) -> None:
        """Record sent or received bytes; `data` is copied before the call returns."""


class PacketLog(PacketSink):
    """Receiver that also gets the packets of the cyclic exchange. This base class discards them: a run
    without log.
    """

    __slots__ = ()

    @property
    def desk(self) -> Desk | None:
        """Memory for records of the exchange kernel; None: its packets are not recorded."""
        return None

    def wake(self, cycle: int) -> None:
        """Begin a cycle: later packets belong to its period."""

    def commit(self) -> object:
        """Commit the collected packets."""
        return None
