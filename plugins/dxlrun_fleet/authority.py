"""Authority: a private certificate authority for robots and clients (extra `network`).

Its key and all certificates that it signed are in `authority` of the keys' directory. Certificates follow RFC
5280: a robot's is valid only for servers, a client's only for clients (extended key usage). The role of a
client is the organizational unit of its subject.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from dxlrun import InputError
from dxlrun.tooling.live import CLIENT, Role, keys_place, revoked
from dxlrun.tooling.output import unwritable

_AUTHORITY_DAYS = 3650  # A new authority requires new certificates for all robots
_EARLIER = timedelta(minutes=5)
"""Certificates are valid from this long before their creation, because clocks of computers differ."""


class IssuedCertificates(NamedTuple):
    """All certificates that the authority has signed for one robot or client, by its name."""

    name: str
    certificate: x509.Certificate
    """Newest certificate."""
    earlier: tuple[x509.Certificate, ...] = ()
    """Certificates that were signed for this name before, oldest first."""

    @property
    def role(self) -> str:
        """Role in the newest certificate: observe, command or admin of a client; `robot` for a robot."""
        found = self.certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)
        return str(found[0].value) if found else "robot"

    @property
    def serials(self) -> list[str]:
        """Serial numbers, newest first, in the form of TLS: hexadecimal with an even number of digits."""
        found = [f"{one.serial_number:X}" for one in (self.certificate, *self.earlier)]
        return [digits.zfill(len(digits) + len(digits) % 2) for digits in found]


def authority_directory() -> Path:
    """Return the directory with the authority's private key and all certificates that it signed."""
    return keys_place() / "authority"


def issued() -> Iterator[IssuedCertificates]:
    """Yield the certificates of each robot and client, in alphabetical order of their names."""
    for path in sorted(authority_directory().glob("issued/*.crt")):
        *earlier, newest = x509.load_pem_x509_certificates(path.read_bytes())
        yield IssuedCertificates(path.stem, newest, (*earlier,))


def revoke(one: IssuedCertificates) -> None:
    """Add all certificates of a robot or client to the file `revoked`, so that this computer's robots refuse
    them."""
    lines = "".join(f"{serial}\n" for serial in sorted(revoked().union(one.serials)))
    _write(keys_place() / "revoked", lines.encode())


def issue(name: str, role: Role | None, days: int, to: Path) -> IssuedCertificates:
    """Sign a certificate for a new key, and write both with the authority's certificate to a directory.

    Args:
        name: Name of the robot or client.
        role: Role of a client; None for a robot.
        days: Validity from now, days.
        to: Directory of the files, which is created.

    Raises:
        InputError: The directory has files of another name or another authority, or cannot be written.
    """
    file = name if role is None else CLIENT
    try:
        to.mkdir(parents=True, exist_ok=True, mode=0o700)  # Fail before the certificate counts as issued
    except OSError as error:
        raise unwritable(to, error) from error
    issuer, signer = _authority()
    kept = authority_directory() / "issued" / f"{name}.crt"
    there = to / f"{file}.crt"
    root = issuer.public_bytes(Encoding.PEM)
    held = there.exists() and _is_named(there, name)
    if not held and (there.exists() or (kept.exists() and to == keys_place())):
        raise InputError(
            f"{there} is not the certificate of {name}; write it elsewhere with --output DIRECTORY"
        )
    if (to / "ca.crt").exists() and (to / "ca.crt").read_bytes() != root:
        raise InputError(f"{to / 'ca.crt'} belongs to another authority; give another directory")
    key = ec.generate_private_key(ec.SECP256R1())
    unit = [] if role is None else [_attribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role.name.lower())]
    usage = ExtendedKeyUsageOID.SERVER_AUTH if role is None else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        _builder(x509.Name([*unit, _attribute(NameOID.COMMON_NAME, name)]), issuer.subject, key, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=True)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )
    if role is None:
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
    one = IssuedCertificates(name, builder.sign(signer, hashes.SHA256()))
    signed = one.certificate.public_bytes(Encoding.PEM)
    _write(kept, (kept.read_bytes() if kept.exists() else b"") + signed)
    _write_key(to / f"{file}.key", key)
    _write(there, signed)
    _write(to / "ca.crt", root)
    return one


def _is_named(path: Path, name: str) -> bool:
    subject = x509.load_pem_x509_certificate(path.read_bytes()).subject
    return subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == name


def _authority() -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return the authority's certificate and private key. The first call on a computer creates both files."""
    certificate, path = keys_place() / "ca.crt", authority_directory() / "ca.key"
    if not path.exists():
        if certificate.exists():
            raise InputError(
                f"{certificate} belongs to another computer's authority; create certificates there"
            )
        (authority_directory() / "issued").mkdir(parents=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([_attribute(NameOID.COMMON_NAME, "dxlrun")])
        usage = x509.KeyUsage(
            key_cert_sign=True,
            crl_sign=True,
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            encipher_only=False,
            decipher_only=False,
        )
        signed = (
            _builder(name, name, key, _AUTHORITY_DAYS)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(key, hashes.SHA256())
        )
        _write_key(path, key)
        _write(certificate, signed.public_bytes(Encoding.PEM))
    signer = load_pem_private_key(path.read_bytes(), None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey):
        raise InputError(
            f"{path} is not an elliptic-curve key; move {authority_directory()} away to start over"
        )
    return x509.load_pem_x509_certificate(certificate.read_bytes()), signer


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _attribute(kind: x509.ObjectIdentifier, value: str) -> x509.NameAttribute[str]:
    return x509.NameAttribute(kind, value)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    _write(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically and readable only by this user."""
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        stream.write(data)
    part.replace(path)
