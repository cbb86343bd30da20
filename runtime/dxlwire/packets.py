"""Packets on a bus: their kinds, the record in which the exchange kernel writes them, and who takes them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, unique

Bytes = bytes | bytearray | memoryview

RECORD = struct.Struct("<BBBxI qq")
"""Header in front of a packet: bus, kind, servo ID, length, time of the first and of the last byte in ns."""
RECORD_HEADER = RECORD.size  # bytes; the two times are the last 16 of them


@unique
class PacketKind(IntEnum):
    """What a run of bytes was; the number is in the log."""

    INSTRUCTION = 1
    STATUS = 2
    """Of a fast form that was cut off or spoilt: its intact parts."""
    NOISE = 3
    """Bytes from the line that belong to no intact packet."""
    LATE = 4
    """An intact status that came after it was given up; nothing was taken from it."""
    OTHER_HOST = 5
    """An intact packet that no servo sends: an instruction of another host on the line."""
    ECHO = 6
    """An instruction of this host, given back by the adapter."""


@dataclass(frozen=True, slots=True)
class Desk:
    """Memory of a batch that is not committed yet."""

    records: memoryview
    """The records, one behind the other."""
    used: memoryview
    """One 64-bit word: how many of these bytes are used."""


class PacketSink:
    """Takes packets; never blocks, never raises. This one forgets them."""

    __slots__ = ()

    def packet(  # noqa: PLR0917  called for every packet in the loop: positional is quickest
        self, bus: int, kind: PacketKind, servo_id: int, first_ns: int, last_ns: int, data: Bytes
    ) -> None:
        """Record bytes that were sent or received; `data` is copied before the call returns."""


class PacketLog(PacketSink):
    """Takes packets of the cyclic exchange, too. This one forgets them: a run without a log."""

    __slots__ = ()

    @property
    def desk(self) -> Desk | None:
        """Where the exchange kernel appends records by itself; None: what it exchanges is not recorded."""
        return None

    def wake(self, cycle: int) -> None:
        """Note that a cycle begins: what follows is of its period."""

    def commit(self) -> object:
        """Hand on what was collected."""
        return None
