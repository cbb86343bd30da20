"""Ports: the handles of serial lines; bytes out, bytes in before a deadline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Port(Protocol):
    """One serial line; nothing here waits. Raises PortError when the adapter is gone."""

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Hand one whole packet to the line."""
        ...

    def read_into(self, buffer: memoryview) -> int:
        """Copy what has arrived into `buffer`; return the number of bytes, 0 when there is nothing."""
        ...


class Ports(Protocol):
    """All lines of a robot, waited for together."""

    @property
    def ports(self) -> Sequence[Port]:
        """The lines, in the order of the plan's buses."""
        ...

    def wait(self, deadline_ns: int) -> Sequence[int]:
        """Wait for bytes on any line until `deadline_ns`; return the indices of lines with bytes.

        Empty when time is up. Advances virtual time where time is virtual. `deadline_ns` is on the run's
        Clock; a deadline in the past only looks.
        """
        ...
