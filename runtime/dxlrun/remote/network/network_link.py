"""Network link: a client's connection to a robot of another computer, by HTTP over mutual TLS."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

from dxlrun.remote.network.certificates import CLIENT, client_context, keys_place, settings
from dxlrun.remote.sockets import TIMEOUT_S, Address, SocketLink

# s; timeout of a TCP connection, shorter than that of a reply: a gateway in the local network accepts at
# once.
_CONNECT_S = 3.0
_CHUNK = 1 << 16


class NetworkLink(SocketLink):
    """Connection to the gateway of a robot on another computer. A thread decrypts each stream."""

    def __init__(self, address: Address, client: str) -> None:
        """Raises InputError when this user has no client certificate."""
        super().__init__(Path(), client)
        self._address, self._context = address, client_context()

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Send one request over TLS; return HTTP status and body of the reply."""
        try:
            return super().exchange(method, path, body)
        # In TLS 1.3, the server verifies the client's certificate after the client's handshake has ended, and
        # asyncio does not send the reason.
        except ConnectionResetError as error:
            raise ConnectionResetError(
                f"{error}: the run has ended, or {keys_place() / CLIENT}.crt is expired, revoked "
                "or signed by another authority"
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
        """Send a GET request with a streamed reply; return status, first bytes, and a socket with the
        decrypted rest.
        """
        status, first, end = super().stream(path)
        here, there = socket.socketpair()
        threading.Thread(target=_pass_on, args=(end, there), daemon=True).start()
        return status, first, here

    @property
    def alive(self) -> bool:
        """True while the gateway's port accepts connections."""
        try:
            socket.create_connection((self._address.host, self._address.port), _CONNECT_S).close()
        except OSError:
            return False
        return True

    def ends(self) -> bool:
        """Return True if the gateway's port refuses connections within a second, which means that the run has
        ended.
        """
        for _ in range(20):
            if not self.alive:
                return True
            time.sleep(0.05)
        return False


def _pass_on(end: socket.socket, to: socket.socket) -> None:
    """Forward bytes received from `end` to `to` until one of the sockets is closed, and close both."""
    with end, to, suppress(OSError):
        while data := end.recv(_CHUNK):
            to.sendall(data)


def known_robots() -> dict[str, Address]:
    """Return the addresses of robots on other computers by name, from `robots.yaml` of the settings, if it
    exists.

    Raises InputError with the place of each mistake.
    """
    path = settings() / "robots.yaml"
    if not path.is_file():
        return {}
    # Imported here because it imports YAML, which most clients do not need.
    from dxlrun.remote.network.robots_file import read_robots

    return read_robots(path)
