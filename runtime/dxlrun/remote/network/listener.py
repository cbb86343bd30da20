"""Listener: a TCP port whose unproved connections occupy little memory and few file descriptors.

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
"""Upper limit of unproved connections; one more closes the oldest one of the host with the most of them."""
# s; timeout of a TLS handshake or shutdown, after which a half-open connection frees its memory.
HANDSHAKE_S = 5.0


class Listener(socket.socket):
    """Listening TCP socket for an asyncio server, with a limit on unproved connections."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None = None) -> None:
        """Bind to host and port; `tls`: context of each connection, None for plain TCP. Raises OSError."""
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
        """Return a listener at an address whose clients need a certificate (mutual TLS).

        Raises InputError for missing or wrong certificates, OSError for a port that is in use.
        """
        return cls(address.host, address.port, server_context(address.name))

    async def serve_connections(self, make: Callable[[], asyncio.Protocol]) -> None:
        """Start to serve connections; `make` returns a protocol for each one after its TLS handshake."""
        await asyncio.get_running_loop().create_server(
            make, sock=self, ssl=self.tls, ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=HANDSHAKE_S
        )

    def accept(self) -> tuple[socket.socket, tuple[str, int]]:
        """Accept a connection as unproved; above the limit, close the oldest of the host with the most."""
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
        """Take a connection off the unproved ones; `peer` is its address (for IPv6 with two more fields)."""
        self._unproved.pop((peer[0], peer[1]), None)


def in_url(host: str) -> str:
    """Return a host as in a URL: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host


class ListenAddress(NamedTuple):
    """Host and port at which a server listens, as given with `--listen`."""

    host: str = LOOPBACK
    port: int | None = None
    """None: the server's usual port, or a free port when the usual one is in use."""

    @classmethod
    def parse(cls, text: str) -> ListenAddress:
        """Parse `HOST:PORT`, `HOST` or `:PORT`; the default host is LOOPBACK. Raises InputError."""
        found = re.fullmatch(
            r"(\[[^\]]+\]|[^:]*)(?::(\d{1,5}))?|([\da-fA-F]*:[\da-fA-F:]*:[\da-fA-F.]*)", text
        )
        if not text or not found or int(found[2] or 0) > 65535:
            raise InputError(f"--listen {text}: write HOST:PORT, HOST or :PORT, such as :9000, up to :65535")
        host = (found[3] or found[1]).strip("[]")
        return cls(host or LOOPBACK, int(found[2]) if found[2] else None)

    @property
    def is_loopback(self) -> bool:
        """True when the host is a loopback address, so that only this computer can connect."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def listener(self, usual: int, tls: ssl.SSLContext | None = None) -> Listener:
        """Return a socket that listens at this place; `usual` is the port when none is given.

        Raises InputError when the port cannot be listened on.
        """
        port = usual if self.port is None else self.port
        try:
            return Listener(self.host, port, tls)
        except OSError as error:
            if self.port is None and error.errno == errno.EADDRINUSE:
                return ListenAddress(self.host, 0).listener(usual, tls)
            why = f"{in_url(self.host)}:{port} cannot be listened on: {error.strerror or error}"
            raise InputError(f"{why}; give another --listen HOST:PORT") from error
