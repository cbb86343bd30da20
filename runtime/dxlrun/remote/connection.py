"""Connections of the gateway: a timeout for each of them, a limit for each process and for all together.

A client may hang in the middle of a request, never read its answer, or open connections without end. A
process above its limit loses that connection of its own which was silent longest, so a flood closes none of
another process, whose `stop` is served. The process ID comes from the kernel (SO_PEERCRED, unix(7)).
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from collections import Counter

from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS = 64
MOST_OF_PROCESS = 16
"""Connections of one process: three processes that flood leave a quarter of all to others."""
SILENCE_S = 30.0
"""After so long without a byte from the other side, whatever it waits for, a connection is closed."""

_CREDENTIALS = struct.Struct("3i")


class Connection(H11Protocol):
    """HTTP/1.1 on one connection, closed when it is silent for too long, or one of too many."""

    def connection_made(  # type: ignore[override]  # uvicorn leaves its type open
        self, transport: asyncio.Transport
    ) -> None:
        """Begin, unless it is somebody else's; let another one go when there are too many."""
        super().connection_made(transport)
        self.heard = self.loop.time()
        self._timer = self.loop.call_later(SILENCE_S, self._look)
        process, user = _peer(transport)
        if user not in (0, os.getuid()):  # the socket's mode says the same; twice is not too often
            transport.abort()
            return
        self.client = (f"process {process}", 0)
        crowd = self._crowd()
        if crowd:
            min(crowd, key=lambda one: (one.busy, one.heard)).transport.abort()

    def _crowd(self) -> list[Connection]:
        """Return the connections of which one must be closed because of this one: those of its process when
        that has too many, of the process that has most when there are too many; none otherwise."""
        others = [
            one
            for one in self.connections
            if isinstance(one, Connection) and one is not self and not one.transport.is_closing()
        ]
        process = self.client
        counts = Counter(one.client for one in others)
        if counts[process] < MOST_OF_PROCESS:
            if len(others) < MOST_CONNECTIONS:
                return []
            ((process, _),) = counts.most_common(1)
        return [one for one in others if one.client == process]

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave nothing behind: a timer would keep all of it for as long as the patience lasts."""
        self._timer.cancel()
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what came."""
        self.heard = self.loop.time()
        super().data_received(data)

    @property
    def busy(self) -> bool:
        """True while a request of it is answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def _look(self) -> None:
        """Close it when it was silent for too long, else look again when that may be."""
        silent = self.loop.time() - self.heard
        if silent >= SILENCE_S:
            self.transport.abort()  # not close: that would wait for a reader that may never read
        else:
            self._timer = self.loop.call_later(SILENCE_S - silent + 0.01, self._look)


def _peer(transport: asyncio.Transport) -> tuple[int, int]:
    """Return process ID and user ID of who connected."""
    end = transport.get_extra_info("socket")
    process, user, _ = _CREDENTIALS.unpack(
        end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    )
    return process, user
