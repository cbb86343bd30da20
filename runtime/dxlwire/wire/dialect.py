"""Dialect: the functions and constants that the modules `protocol1` and `protocol2` share, so that bus,
plan and start-up are independent of the protocol."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

from dxlwire.exceptions import help_link
from dxlwire.packets import Bytes
from dxlwire.transaction import Status
from dxlwire.wire import protocol1, protocol2

ONE_PROTOCOL = (
    "a servo of Protocol 1.0 executes bytes of Protocol 2.0 replies; "
    f"{help_link('two-protocols-on-one-adapter')}"
)
"""Reason why a line has one protocol, for messages (protocol.md, Line)."""


class Dialect(Protocol):
    """Functions of a protocol that build and parse packets. They are pure; the modules `protocol1` and
    `protocol2` document their exceptions."""

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
        """Return the size of the packet whose header is at `start`; 0: not known yet, -1: not a real
        header."""
        ...

    def intact(self, packet: memoryview) -> bool:
        """Return True if the checksum of a whole packet is correct."""
        ...

    def opened(self, packet: memoryview) -> Status | None:
        """Parse an intact packet as a status, the reply of a servo; return None if it cannot be one."""
        ...

    def instructs(self, packet: memoryview) -> bool:
        """Return True if an intact packet parses as an instruction of a host. In Protocol 1.0 a status
        may, too."""
        ...

    def refused(self, error: int, length: int, awaited: int) -> bool:
        """Return True if a status with this error and `length` parameters, where `awaited` were expected,
        reports that the instruction was not executed."""
        ...

    def describe_error(self, error: int) -> str:
        """Return an error byte of a status in the e-Manual's words."""
        ...

    def widest(self, length: int) -> int:
        """Return the largest size on the line of a status with `length` parameters, bytes."""
        ...

    def status_packet(self, servo_id: int, error: int = 0, parameters: bytes = b"") -> bytes:
        """Return the status packet that a servo would send."""
        ...

    def ping(self, servo_id: int) -> bytes:
        """Return the packet that asks a servo for a reply, to check its presence."""
        ...

    def read_range(self, servo_id: int, address: int, length: int) -> bytes:
        """Return the packet that reads `length` bytes of the control table from `address`."""
        ...

    def write_range(self, servo_id: int, address: int, data: bytes) -> bytes:
        """Return the packet that writes `data` into the control table from `address`."""
        ...

    def read_many(self, requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
        """Return a single packet that reads several servos, given (ID, address, length) for each."""
        ...

    def fast_size(self, length: int, count: int) -> int:
        """Return the size (bytes) of the status that `count` servos share in a fast read of `length` bytes
        in total."""
        ...

    def fast_answers(self, packet: Bytes, lengths: Sequence[int]) -> list[Status]:
        """Return the servos' parts of a shared status of a fast read, up to the first corrupted part;
        `lengths` are the requested bytes."""
        ...

    def sync_write(self, address: int, length: int, data: Mapping[int, bytes]) -> bytes:
        """Return the packet that writes `length` bytes from `address` to several servos; `data` by ID."""
        ...


_DIALECTS: Mapping[float, Dialect] = MappingProxyType({1.0: protocol1, 2.0: protocol2})


def dialect_of(protocol: float) -> Dialect:
    """Return the dialect module of Protocol 1.0 or 2.0. Raises LookupError for another one."""
    return _DIALECTS[protocol]


def sync_writes(dialect: Dialect, writes: Iterable[tuple[int, int, bytes]]) -> list[bytes]:
    """Return sync write packets for writes, given (ID, address, data) for each: one packet per address and
    length."""
    places: dict[tuple[int, int], dict[int, bytes]] = {}
    for servo_id, address, data in writes:
        places.setdefault((address, len(data)), {})[servo_id] = data
    return [dialect.sync_write(address, length, data) for (address, length), data in places.items()]
