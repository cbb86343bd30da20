"""Dialect: common interface of the two protocols, so that bus, plan and start-up are independent of them.

The modules `protocol1` and `protocol2` are the two dialects.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

from dxlwire.packets import Bytes
from dxlwire.transaction import Status
from dxlwire.wire import protocol1, protocol2


class Dialect(Protocol):
    """Packets of one protocol <-> bytes. Pure functions; the modules document their exceptions."""

    PROTOCOL: float
    HEADER: bytes
    OVERHEAD: int
    CHECKSUM: int
    ID_AT: int
    LONGEST: int
    HIGHEST_ID: int
    PING_LENGTH: int
    MOST_GOAL_BYTES: int
    ALERT: int

    def size_at(self, buffer: Bytes, start: int, end: int) -> int:
        """Return the size of the packet with its header at `start`; 0: not known yet, -1: false header."""
        ...

    def intact(self, packet: memoryview) -> bool:
        """Return True if the checksum of a whole packet is correct."""
        ...

    def opened(self, packet: memoryview) -> Status | None:
        """Parse an intact packet; return None if it cannot be a status."""
        ...

    def instructs(self, packet: memoryview) -> bool:
        """Return True if an intact packet parses as an instruction of a host. In Protocol 1.0 a status may,
        too.
        """
        ...

    def refused(self, error: int, length: int, awaited: int) -> bool:
        """Return True if a status reports that the instruction was not executed."""
        ...

    def describe_error(self, error: int) -> str:
        """Return the e-Manual's words for an error byte."""
        ...

    def widest(self, length: int) -> int:
        """Return the largest size on the line of a status with `length` parameters, bytes."""
        ...

    def status_packet(self, servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
        """Return the status packet that a servo would send."""
        ...

    def ping(self, servo_id: int) -> bytes:
        """Return the packet that checks the presence of a servo."""
        ...

    def read(self, servo_id: int, address: int, length: int) -> bytes:
        """Return the packet that reads a range of the control table."""
        ...

    def write(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Return the packet that writes a range of the control table."""
        ...

    def read_many(self, requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
        """Return a single packet that reads several servos, given ID, address and length for each."""
        ...

    def fast_size(self, length: int, count: int) -> int:
        """Return the size of a fast form's shared status for `count` servos and `length` bytes of data."""
        ...

    def fast_answers(self, packet: Bytes, lengths: Sequence[int]) -> list[Status]:
        """Return the servos' entries in the status of a fast form, up to the first corrupted entry."""
        ...

    def sync_write(self, address: int, length: int, data: Mapping[int, bytes]) -> bytes:
        """Return the packet that writes `length` bytes to several servos, by ID."""
        ...


_DIALECTS: Mapping[float, Dialect] = MappingProxyType({1.0: protocol1, 2.0: protocol2})


def dialect_of(protocol: float) -> Dialect:
    """Return the dialect of Protocol 1.0 or 2.0. Raises LookupError for another one."""
    return _DIALECTS[protocol]


def sync_writes(dialect: Dialect, writes: Iterable[tuple[int, int, bytes]]) -> list[bytes]:
    """Return packets for writes, given ID, address and data for each: one packet per address and length."""
    places: dict[tuple[int, int], dict[int, bytes]] = {}
    for servo_id, address, data in writes:
        places.setdefault((address, len(data)), {})[servo_id] = data
    return [dialect.sync_write(address, length, data) for (address, length), data in places.items()]
