"""The line to who started the simulation: JSON objects, one a line, and never a reason to wait."""

from __future__ import annotations

import socket
from collections.abc import Mapping

import msgspec

_LONGEST_LINE = 1 << 16
_MOST_UNREAD = 1 << 18


class ControlLine:
    """One end of a socket; what the other end does not read in time is dropped, whole lines of it."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        end.setblocking(False)
        self._received = b""
        self._unsent = bytearray()
        self.closed = False
        """True after the other end hung up."""

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    @property
    def has_unsent(self) -> bool:
        """True when `flush` is to be called as soon as the socket takes something."""
        return bool(self._unsent)

    def receive(self) -> list[bytes]:
        """Return the lines that were completed by what has arrived; sets `closed` at the end."""
        try:
            chunk = self._socket.recv(65536)
        except BlockingIOError:
            return []
        except OSError:  # the other end closed without having read what it was told
            chunk = b""
        if not chunk:
            self.closed = True
        *lines, self._received = (self._received + chunk).split(b"\n")
        if len(self._received) > _LONGEST_LINE:
            self._received = b""
        return lines

    def send(self, message: Mapping[str, object]) -> None:
        """Send an object, now or when the socket takes it; never raises, never waits."""
        line = msgspec.json.encode(message) + b"\n"
        if len(self._unsent) + len(line) <= _MOST_UNREAD:
            self._unsent += line
            self.flush()

    def flush(self) -> None:
        """Send what could not be sent before."""
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            return
        except OSError:  # nobody listens any more; receive tells
            self._unsent.clear()
