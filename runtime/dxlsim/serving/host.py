"""Host protocols: interfaces of the program that sends requests to a server of simulated buses, and that
receives its progress."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dxlsim.messages import SimulationMessage, SimulationRequest

ENDLESS_NS = 1 << 62
"""Argument of `LineProgress.publish_served` while nothing is due to the host."""


class Starter(Protocol):
    """Program that started a server of simulated buses, possibly in another thread or process."""

    closed: bool
    """True after the program's last request: the server then ends."""

    def fileno(self) -> int:
        """Return a descriptor that is readable after a request, and writable while messages are accepted."""

    def receive_messages(self) -> Sequence[SimulationRequest]:
        """Return the new requests of the program; called when the descriptor is readable."""

    def send_message(self, message: SimulationMessage) -> None:
        """Send a message to the program; never raises."""


class LineProgressReceiver(Protocol):
    """Receiver of the server's progress on one line. Times are CLOCK_MONOTONIC, ns."""

    def publish_served(self, until_ns: int) -> None:
        """Publish that all bytes due to the host before `until_ns` have been delivered."""

    def publish_received(self, off_wire_ns: int) -> None:
        """Publish the time at which the newest byte received from the host is off the simulated wire."""

    def publish_delivery(self, due_ns: int, now_ns: int) -> None:
        """Publish that bytes which were due at `due_ns` are delivered to the host at `now_ns`."""


class ServerProgressReceiver(Protocol):
    """Receiver of the server's progress, so that a host can distinguish a late server from a silent servo."""

    def note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish an interval in which the server was ready to run but had no processor core."""

    def line(self, index: int) -> LineProgressReceiver:
        """Return the receiver of the progress on one line, by its index."""
