"""Certificates: mutual TLS 1.3 between computers, with the user's own certificate authority.

Certificates and keys are in `keys` of dxlrun's settings directory: `ca.crt`, NAME.crt and NAME.key of each
robot that runs here, client.crt and client.key of this user (`dxlrun keys` makes them). Access without a
certificate is impossible: TLS checks the other end's certificate before any byte of a request is read.
"""

from __future__ import annotations

import os
import ssl
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TypedDict

from dxlrun.errors import InputError

CLIENT = "client"
"""File name, without suffix, of this user's own certificate and key for connections to robots."""


class Certificate(TypedDict, total=False):
    """Fields of a peer's verified certificate that dxlrun reads, from `SSLSocket.getpeercert()`."""

    subject: tuple[tuple[tuple[str, str], ...], ...]
    notAfter: str
    serialNumber: str


def settings() -> Path:
    """Return the directory of this user's dxlrun settings (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "dxlrun"


def keys_place() -> Path:
    """Return the directory of this user's certificates, keys and list of revoked certificates."""
    return settings() / "keys"


def server_context(name: str) -> ssl.SSLContext:
    """Return the TLS context of a robot's gateway, which requires a certificate of each client.

    Raises InputError when a file is missing or readable by others, or clients would refuse the certificate.
    """
    context = _context(ssl.PROTOCOL_TLS_SERVER, name, f"make it by `dxlrun keys robot {name}`")
    # A ticket is sent unasked, and clients take any byte without a request for a closed connection.
    context.num_tickets = 0
    _try(context, name)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def client_context() -> ssl.SSLContext:
    """Return this user's TLS context for connections to robots; raises InputError when a file is missing or
    wrong.
    """
    made = "make it on the robot's computer by `dxlrun keys client NAME --output DIRECTORY`, and copy it here"
    return _context(ssl.PROTOCOL_TLS_CLIENT, CLIENT, made)


def _context(protocol: int, name: str, remedy: str) -> ssl.SSLContext:
    place = keys_place()
    authority, certificate, key = (place / file for file in ("ca.crt", f"{name}.crt", f"{name}.key"))
    for file in (authority, certificate, key):
        if not file.is_file():
            raise InputError(f"{file} is missing; {remedy}")
    if key.stat().st_mode & 0o077:
        raise InputError(f"other users can read {key}; run `chmod 600 {key}`, or renew the key")
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(certificate, key, password="")
        context.load_verify_locations(authority)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{certificate}, its key and {authority} do not match: {error}; make them again"
        ) from error
    return context


def _try(server: ssl.SSLContext, name: str) -> None:
    """Complete a TLS handshake with a robot's certificate in memory; raises InputError if clients would
    refuse it.
    """
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
            f"{certificate}: {error.verify_message}; renew it by `dxlrun keys renew {name}`"
        ) from error


def counts(certificate: Certificate) -> bool:
    """Return True when a certificate that TLS verified earlier has neither expired nor been revoked since."""
    until = ssl.cert_time_to_seconds(certificate["notAfter"])
    return until > time.time() and certificate["serialNumber"] not in revoked()


def revoked() -> frozenset[str]:
    """Return the serial numbers of revoked certificates from the file `revoked`; none without the file."""
    path = keys_place() / "revoked"
    try:
        found = path.stat()
        return _serials(path, found.st_ino, found.st_mtime_ns)
    except FileNotFoundError:
        return frozenset()


@lru_cache(maxsize=1)
def _serials(path: Path, file: int, changed_ns: int) -> frozenset[str]:
    """Return the serial numbers in a file, cached while its inode and modification time stay the same."""
    return frozenset(path.read_text().upper().split())
