"""Host protocols: interfaces of the program that sends requests to a server of simulated buses, and that
receives its progress."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dxlsim.messages import SimulationMessage, SimulationRequest


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

    @property
    def words(self) -> memoryview:
        """Four numbers of 64 bits, into which compiled code publishes, each with release semantics:

        - the time at which the newest byte received from the host is off the simulated wire;
        - the time before which all bytes due to the host have been delivered, 1 << 62 while none is due;
        - the time at which bytes were delivered to the host last;
        - the time at which these were due, valid once the time before it is published.
        """


class ServerProgressReceiver(Protocol):
    """Receiver of the server's progress, so that a host can distinguish a late server from a silent servo."""

    def note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish an interval in which the server was ready to run but had no processor core."""

    def line(self, index: int) -> LineProgressReceiver:
        """Return the receiver of the progress on one line, by its index."""
