"""Packets on a bus: their kinds, the format in which the exchange kernel records them, and the interface
of logs."""

from __future__ import annotations

import struct
from enum import IntEnum, unique

import msgspec

Bytes = bytes | bytearray | memoryview

RECORD = struct.Struct("<BBBxI qq")
"""Header of a recorded packet: bus, kind, servo ID, length, time of the first and of the last byte in ns."""
RECORD_HEADER = RECORD.size  # Bytes; the last 16 are the two times


@unique
class PacketKind(IntEnum):
    """Kind of a packet or of other bytes on a line; the number is stored in logs."""

    INSTRUCTION = 1
    STATUS = 2
    """A status packet, the reply of a servo. For a truncated or corrupted fast read only its intact
    entries."""
    NOISE = 3
    """Bytes from the line that belong to no intact packet."""
    LATE = 4
    """An intact status packet that arrived after its timeout and was not used."""
    OTHER_HOST = 5
    """An intact packet that servos do not send: an instruction of another host on the line."""
    ECHO = 6
    """An instruction of this host that came back, echoed by the adapter."""


class Desk(msgspec.Struct, frozen=True):
    """Memory in which the exchange kernel records packets until `PacketLog.commit`."""

    records: memoryview
    """Buffer with the records, header and bytes of each packet, one after the other."""
    used: memoryview
    """One 64-bit word: number of used bytes in the buffer."""


class PacketSink:
    """Receiver of the packets on all lines, such as a log; never blocks, never raises. This base class
    discards them."""

    __slots__ = ()

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Bytes
    ) -> None:
        """Record sent or received bytes with the times of the first and last byte, ns; `data` is copied
        before the call returns."""


class PacketLog(PacketSink):
    """Packet sink that also gets the packets of the cyclic exchange from the kernel. This base class
    discards them: a run without log."""

    __slots__ = ()

    @property
    def desk(self) -> Desk | None:
        """Memory in which the exchange kernel records packets; None: they are not recorded."""
        return None

    def wake(self, cycle: int) -> None:
        """Begin a cycle, by its number: later packets belong to its period."""

    def commit_packets(self) -> object:
        """Add the packets that were recorded in `desk` to the log, and empty the memory."""
        return None
