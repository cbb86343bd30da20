"""Handshakes: TLS connections that begin, few at once, so that half-open ones cost neither memory nor files.

None of them is asked anything before its certificate was checked.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple, TypeAlias

from dxlrun.remote.network.certificates import server_context
from dxlrun.remote.sockets import Address

MOST_HANDSHAKES = 64
"""At once; one more ends the oldest of the computer that has most."""
HANDSHAKE_S = 5.0


class Secured(NamedTuple):
    """A listening TCP socket, and the TLS that is spoken there."""

    listener: socket.socket
    context: ssl.SSLContext

    @classmethod
    def at(cls, address: Address) -> Secured:
        """Return where clients of other computers connect; raises InputError and OSError."""
        context = server_context(address.name)
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        listener = socket.create_server((address.host, address.port), family=family, backlog=MOST_HANDSHAKES)
        listener.setblocking(False)
        return cls(listener, context)


_Shaking: TypeAlias = asyncio.Future[tuple[asyncio.Transport, asyncio.Protocol]]


class _Begun(NamedTuple):
    """A connection that shakes hands, and its computer."""

    end: socket.socket
    host: str


class Handshakes:
    """Takes connections, and makes a protocol for each whose certificate is right."""

    def __init__(self, secured: Secured, make: Callable[[], asyncio.Protocol]) -> None:
        self._secured, self._make = secured, make
        self._begun: dict[_Shaking, _Begun] = {}

    def begin(self) -> None:
        """Take connections from now on."""
        asyncio.get_running_loop().add_reader(self._secured.listener.fileno(), self._accept)

    def _accept(self) -> None:
        try:
            end, (host, *_) = self._secured.listener.accept()
        except OSError:  # it is gone again
            return
        end.setblocking(False)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if len(self._begun) >= MOST_HANDSHAKES:
            self._end_one()
        shaking = asyncio.get_running_loop().connect_accepted_socket(
            self._make,
            end,
            ssl=self._secured.context,
            ssl_handshake_timeout=HANDSHAKE_S,
            ssl_shutdown_timeout=HANDSHAKE_S,
        )
        task = asyncio.ensure_future(shaking)
        self._begun[task] = _Begun(end, host)
        task.add_done_callback(partial(self._ended, end))

    def _end_one(self) -> None:
        """End the oldest handshake of the computer that has most: others keep theirs."""
        ((most, _),) = Counter(one.host for one in self._begun.values()).most_common(1)
        oldest = next(task for task, one in self._begun.items() if one.host == most)
        with suppress(OSError):  # asyncio forgets a cancelled one that has not begun
            self._begun.pop(oldest).end.shutdown(socket.SHUT_RDWR)

    def _ended(self, end: socket.socket, task: _Shaking) -> None:
        """Close a connection of which nothing came: a certificate that is refused, one of too many."""
        self._begun.pop(task, None)
        if task.cancelled() or task.exception() is not None:
            end.close()
