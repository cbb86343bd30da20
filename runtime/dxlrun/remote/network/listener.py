"""Listener: a TCP port on which half-open connections occupy little memory and few file descriptors.

A connection is unproved until the server admits it: TLS has checked its certificate, or it has sent a token.
"""

from __future__ import annotations

import asyncio
import errno
import gc
import re
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from typing import NamedTuple

from dxlrun.errors import InputError
from dxlrun.remote.network.certificates import server_context
from dxlrun.remote.sockets import Address

LOOPBACK = "127.0.0.1"
MOST_UNPROVED = 64
"""Upper limit of unproved connections; one more closes the oldest one of the host that has the most."""
# s; timeout of a TLS handshake or shutdown, after which a half-open connection frees its memory.
HANDSHAKE_S = 5.0


class Listener(socket.socket):
    """Listening TCP socket for a server of asyncio."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> None:
        """Raises OSError."""
        super().__init__(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self.tls = tls
        self._unproved: dict[tuple[str, int], socket.socket] = {}
        self._accepted = 0
        try:
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind((host, port))
            self.listen(MOST_UNPROVED)
        except BaseException:
            self.close()
            raise
        self.setblocking(False)
        # Freeze the present objects, so that a garbage collection takes 0.1 ms.
        gc.freeze()

    @classmethod
    def secured(cls, address: Address) -> Listener:
        """Return a listener for clients with mutual TLS; raises InputError and OSError."""
        return cls(address.host, address.port, server_context(address.name))

    async def serve(self, make: Callable[[], asyncio.Protocol]) -> None:
        """Serve connections from now on, each with a new protocol after the TLS handshake."""
        await asyncio.get_running_loop().create_server(
            make, sock=self, ssl=self.tls, ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=HANDSHAKE_S
        )

    def accept(self) -> tuple[socket.socket, tuple[str, int]]:
        """Accept a connection, and close another unproved one above the limit."""
        end, peer = super().accept()
        self._accepted += 1
        if not self._accepted % MOST_UNPROVED:
            # asyncio leaves a reference cycle of 256 kB for each TLS connection.
            gc.collect()
        if len(self._unproved) >= MOST_UNPROVED:
            self._unproved = {key: one for key, one in self._unproved.items() if one.fileno() >= 0}
        if len(self._unproved) >= MOST_UNPROVED:
            ((most, _),) = Counter(host for host, _ in self._unproved).most_common(1)
            oldest = next(one for one in self._unproved if one[0] == most)
            # The connection is already closed.
            with suppress(OSError):
                self._unproved.pop(oldest).shutdown(socket.SHUT_RDWR)
        self._unproved[peer[0], peer[1]] = end
        return end, peer

    def admit(self, peer: tuple[str, int]) -> None:
        """Remove a connection from the unproved ones, by its peer address (IPv6: with two more fields)."""
        self._unproved.pop((peer[0], peer[1]), None)


def in_url(host: str) -> str:
    """Return a host as in a URL: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host


class Place(NamedTuple):
    """Host and port of `--listen`."""

    host: str = LOOPBACK
    port: int | None = None
    """None: the default port of the command, or a free port when that is in use."""

    @classmethod
    def parse(cls, text: str) -> Place:
        """Parse `HOST:PORT`, `HOST` or `:PORT`. Raises InputError."""
        found = re.fullmatch(
            r"(\[[^\]]+\]|[^:]*)(?::(\d{1,5}))?|([\da-fA-F]*:[\da-fA-F:]*:[\da-fA-F.]*)", text
        )
        if not text or not found or int(found[2] or 0) > 65535:
            raise InputError(f"--listen {text}: write HOST:PORT, HOST or :PORT, such as :9000, up to :65535")
        host = (found[3] or found[1]).strip("[]")
        return cls(host or LOOPBACK, int(found[2]) if found[2] else None)

    @property
    def is_loopback(self) -> bool:
        """True when only this computer can connect."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def listener(self, usual: int, tls: ssl.SSLContext | None = None) -> Listener:
        """Return a socket that listens here, on port `usual` by default. Raises InputError."""
        port = usual if self.port is None else self.port
        try:
            return Listener(self.host, port, tls)
        except OSError as error:
            if self.port is None and error.errno == errno.EADDRINUSE:
                return Place(self.host, 0).listener(usual, tls)
            why = f"{in_url(self.host)}:{port} cannot be listened on: {error.strerror or error}"
            raise InputError(f"{why}; give another --listen HOST:PORT") from error
