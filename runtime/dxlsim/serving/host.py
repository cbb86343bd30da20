"""Protocols of the objects through which a server is asked, and tells how far it has come."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dxlsim.messages import Request, SimulationMessage

ENDLESS_NS = 1 << 62
"""`LineProgress.serve` takes it where nothing is due to the host."""


class Starter(Protocol):
    """The program that started a server, which can be another thread or process."""

    closed: bool
    """True after its last request was received: the server ends."""

    def fileno(self) -> int:
        """Return a descriptor: readable when a request arrived, writable while messages are taken."""

    def receive(self) -> Sequence[Request]:
        """Return the requests that arrived; called when the descriptor is readable."""

    def send(self, message: SimulationMessage) -> None:
        """Take a message; never raises."""


class LineProgress(Protocol):
    """Takes how far one line was served. Times are CLOCK_MONOTONIC, ns."""

    def serve(self, until_ns: int) -> None:
        """Publish that all bytes that reach the host before `until_ns` were handed over."""

    def take(self, off_wire_ns: int) -> None:
        """Publish when the last byte is off the wire that was taken from the host, and executed."""

    def give(self, due_ns: int, now_ns: int) -> None:
        """Publish when the newest bytes for the host were due, and that they are handed over now."""


class Progress(Protocol):
    """Takes how far the server has come, for hosts that distinguish a late server from a silent servo."""

    def note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish a time in which the server did not run although it had to."""

    def line(self, index: int) -> LineProgress:
        """Return the progress on one line."""
