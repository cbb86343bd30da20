"""Dialect: what the two protocols have in common, so that bus, plan and start-up know neither of them.

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
    """Packets of one protocol <-> bytes; pure functions, see the modules for what they raise."""

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
        """Return the size of the packet whose header is at `start`: 0 is not known yet, -1 false header."""
        ...

    def intact(self, packet: memoryview) -> bool:
        """Check whether the checksum of a whole packet is right."""
        ...

    def opened(self, packet: memoryview) -> Status | None:
        """Take an intact packet apart; None when it cannot be a status."""
        ...

    def instructs(self, packet: memoryview) -> bool:
        """Check whether an intact packet reads as a host's instruction; in Protocol 1.0 a status may, too."""
        ...

    def refused(self, error: int, length: int, awaited: int) -> bool:
        """Check whether a status reports that the instruction was not executed."""
        ...

    def describe_error(self, error: int) -> str:
        """Return the e-Manual's words for an error byte."""
        ...

    def widest(self, length: int) -> int:
        """Return the most bytes that a status of `length` parameters has on the line."""
        ...

    def status_packet(self, servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
        """Return the status packet that a servo would send."""
        ...

    def ping(self, servo_id: int) -> bytes:
        """Return the packet that asks whether a servo is there."""
        ...

    def read(self, servo_id: int, address: int, length: int) -> bytes:
        """Return the packet that asks for a part of the control table."""
        ...

    def write(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Return the packet that writes a part of the control table."""
        ...

    def read_many(self, requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
        """Return the one packet that asks several servos, each by (ID, address, length)."""
        ...

    def fast_size(self, length: int, count: int) -> int:
        """Return the bytes of the one status by which `count` servos answer a fast form."""
        ...

    def fast_answers(self, packet: Bytes, lengths: Sequence[int]) -> list[Status]:
        """Return the servos' parts of such a status, those before the first broken one."""
        ...

    def sync_write(self, address: int, length: int, data: Mapping[int, bytes]) -> bytes:
        """Return the packet that writes `length` bytes to several servos, by ID."""
        ...


_DIALECTS: Mapping[float, Dialect] = MappingProxyType({1.0: protocol1, 2.0: protocol2})


def dialect_of(protocol: float) -> Dialect:
    """Return the dialect of Protocol 1.0 or 2.0; raises LookupError for another one."""
    return _DIALECTS[protocol]


def sync_writes(dialect: Dialect, writes: Iterable[tuple[int, int, bytes]]) -> list[bytes]:
    """Return the packets that write to servos, each by (ID, address, data): one for each place."""
    places: dict[tuple[int, int], dict[int, bytes]] = {}
    for servo_id, address, data in writes:
        places.setdefault((address, len(data)), {})[servo_id] = data
    return [dialect.sync_write(address, length, data) for (address, length), data in places.items()]
