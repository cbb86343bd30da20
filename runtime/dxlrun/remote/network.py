"""Network: a gateway beyond its own computer, by mutual TLS 1.3 and certificates of a CA of one's own.

Certificates and keys lie in `keys` of dxlrun's directory for settings: `ca.crt`, NAME.crt and NAME.key of
each robot that runs here, client.crt and client.key of this user (`dxlrun keys` makes them). There is no way
without: TLS checks the other end's certificate before any byte of a request is read.
"""

from __future__ import annotations

import os
import socket
import ssl
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from dxlrun.errors import InputError
from dxlrun.remote.sockets import TIMEOUT_S, Address, SocketLink

CLIENT = "client"
"""Name of the files with the certificate and the key of a client."""
_CONNECT_S = 3.0
_CHUNK = 1 << 16


def settings() -> Path:
    """Return the directory of this user's settings (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "dxlrun"


def keys_place() -> Path:
    """Return the directory of certificates and keys."""
    return settings() / "keys"


def server_context(name: str) -> ssl.SSLContext:
    """Return TLS as a robot's gateway has it; raises InputError where its certificate would be refused."""
    context = _context(ssl.PROTOCOL_TLS_SERVER, name)
    context.num_tickets = 0  # no byte is sent that answers no request, and no session is resumed
    _try(context, name)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def client_context() -> ssl.SSLContext:
    """Return TLS as a client has it; raises InputError."""
    return _context(ssl.PROTOCOL_TLS_CLIENT, CLIENT)


def _context(protocol: int, name: str) -> ssl.SSLContext:
    place = keys_place()
    authority, certificate, key = (place / file for file in ("ca.crt", f"{name}.crt", f"{name}.key"))
    for file in (authority, certificate, key):
        if not file.is_file():
            raise InputError(f"{file} is missing; `dxlrun keys` makes certificates")
    if key.stat().st_mode & 0o077:
        raise InputError(f"{key} can be read by other users: chmod 600 {key}, or renew it")
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(certificate, key, password="")
        context.load_verify_locations(authority)
    except (OSError, ValueError) as error:
        raise InputError(f"{certificate}, its key and {authority} do not fit together: {error}") from error
    return context


def _try(server: ssl.SSLContext, name: str) -> None:
    """Shake hands with a robot's certificate as a client would; raises InputError where that refuses it."""
    trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    trusting.load_verify_locations(keys_place() / "ca.crt")
    here, there = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        trusting.wrap_bio(here, there, server_hostname=name),
        server.wrap_bio(there, here, server_side=True),
    )
    try:
        for end in (*ends, *ends):
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLCertVerificationError as error:
        certificate = keys_place() / f"{name}.crt"
        raise InputError(
            f"{certificate}: {error.verify_message}; `dxlrun keys renew {name}` makes a new one"
        ) from error


class Revoked(NamedTuple):
    """Serial numbers of refused certificates, of a file with one a line; read again when it changes."""

    known: dict[int, frozenset[str]]
    """By the time of the file's last change."""

    def has(self, serial: str) -> bool:
        """Return whether a certificate was revoked."""
        path = keys_place() / "revoked"
        try:
            changed = path.stat().st_mtime_ns
        except FileNotFoundError:
            return False
        if changed not in self.known:
            self.known.clear()
            self.known[changed] = frozenset(path.read_text().upper().split())
        return serial in self.known[changed]


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
    from dxlrun.remote.robots_file import read_robots  # YAML: most clients ask for none

    return read_robots(path)
