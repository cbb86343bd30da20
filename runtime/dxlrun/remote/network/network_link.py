"""Network link: a robot of another computer as a client reaches it, by HTTP on mutual TLS."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

from dxlrun.remote.network.certificates import CLIENT, client_context, keys_place, settings
from dxlrun.remote.sockets import TIMEOUT_S, Address, SocketLink

_CONNECT_S = 3.0
_CHUNK = 1 << 16


class NetworkLink(SocketLink):
    """A robot of another computer, by HTTP on TLS; streams come through a thread that decrypts them."""

    def __init__(self, address: Address, client: str) -> None:
        """Raises InputError when there is no certificate to be shown."""
        super().__init__(Path(), client)
        self._address, self._context = address, client_context()

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Ask once; return status and answer."""
        try:
            return super().exchange(method, path, body)
        except ConnectionResetError as error:  # TLS 1.3 tells a client so late, and asyncio not why
            raise ConnectionResetError(
                f"{error}; the run may be at its end, or {keys_place() / CLIENT}.crt is expired, revoked "
                "or of another authority"
            ) from error

    def _connected(self) -> socket.socket:
        end = socket.create_connection((self._address.host, self._address.port), _CONNECT_S)
        try:
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            secured = self._context.wrap_socket(end, server_hostname=self._address.name)
        except BaseException:
            end.close()
            raise
        secured.settimeout(TIMEOUT_S)
        return secured

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Return status, first bytes, and a socket that gets what goes on."""
        status, first, end = super().stream(path)
        here, there = socket.socketpair()
        threading.Thread(target=_pass_on, args=(end, there), daemon=True).start()
        return status, first, here

    @property
    def alive(self) -> bool:
        """True while the other computer takes connections."""
        try:
            socket.create_connection((self._address.host, self._address.port), _CONNECT_S).close()
        except OSError:
            return False
        return True

    def ends(self) -> bool:
        """Return whether the run has ended, or ends within a second: no connection is taken then."""
        for _ in range(20):
            if not self.alive:
                return True
            time.sleep(0.05)
        return False


def _pass_on(end: socket.socket, to: socket.socket) -> None:
    """Pass on what comes, until one of the two is closed."""
    with end, to, suppress(OSError):
        while data := end.recv(_CHUNK):
            to.sendall(data)


def known_robots() -> dict[str, Address]:
    """Return the robots of other computers that `robots.yaml` of the settings names.

    Raises InputError with the place of each mistake.
    """
    path = settings() / "robots.yaml"
    if not path.is_file():
        return {}
    from dxlrun.remote.network.robots_file import read_robots  # YAML: most clients ask for none

    return read_robots(path)
