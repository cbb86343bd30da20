"""Sockets of running robots: where they are, which robots run, and a client's connection to one.

A socket is in `$XDG_RUNTIME_DIR/dxlrun` (XDG Base Directory Specification) where this user owns that, else
in `/tmp/dxlrun-<user ID>`; never in both. A service and a login shell that differ in the variable do not find
each other's runs: set it alike.
"""

from __future__ import annotations

import fcntl
import os
import re
import select
import socket
import stat
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, Protocol

from dxlrun.errors import DxlrunError, InputError

SUFFIX = ".sock"
_ADDRESS = re.compile(r"(?:([\w.-]+)@)?(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)
_HEAD = re.compile(rb"HTTP/1\.\d (\d{3}).*?\r\n\r\n", re.DOTALL)
_LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)")
_CHUNK = 65536
MOST_BYTES = 1 << 20
"""The longest body of a request; longer ones are refused before they are read."""
TIMEOUT_S = 10.0
"""How long an answer may take: some two seconds, and six more for a switch that waits for modes."""
_IDLE_S = 20.0
"""The gateway closes silent connections after 30 s; one that was silent for so long is not used again."""
_ENDING_S = 1.0
"""How long a gateway that closed a connection may take to be gone, when the run has ended."""
LONGEST_PATH = 107
"""Bytes; what Linux takes as the name of a Unix socket (unix(7)), without the final zero."""


def place(runtime_directory: str | None = None) -> Path:
    """Return the directory of this user's sockets; it may not exist yet.

    `runtime_directory`: XDG_RUNTIME_DIR of another process; empty without one. None: our own.
    """
    ours = os.environ.get("XDG_RUNTIME_DIR", "")
    runtime = Path(ours if runtime_directory is None else runtime_directory)
    with suppress(OSError):
        # su and sudo may leave that of another user in the environment
        if runtime.is_absolute() and runtime.stat().st_uid == os.getuid():
            return runtime / "dxlrun"
    return Path(f"/tmp/dxlrun-{os.getuid()}")  # noqa: S108  entered only if this user owns it


def owned(directory: Path) -> bool:
    """Return whether a directory belongs to this user and no other may enter it; no link is followed."""
    try:
        found = directory.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077


def listen(robot: str) -> tuple[socket.socket, Path]:
    """Return a listening socket of a robot (mode 0600) and its path.

    A second run of the same robot has its process ID in the name. Raises DxlrunError when there is
    no safe place for a socket.
    """
    directory = place()
    with suppress(OSError):
        directory.mkdir(mode=0o700)
    if not owned(directory):
        raise DxlrunError(
            f"{directory} must be a directory that only you may enter: remove it, or set XDG_RUNTIME_DIR"
        )
    with _locked(directory):
        path = directory / f"{robot}{SUFFIX}"
        if alive(path):
            path = directory / f"{robot}-{os.getpid()}{SUFFIX}"
        if len(os.fsencode(path)) > LONGEST_PATH:
            raise DxlrunError(f"{path} is too long for a socket: give the robot a shorter name")
        path.unlink(missing_ok=True)
        return _bound(path), path


def _bound(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise DxlrunError(f"{path} cannot be opened: {error.strerror or error}") from error
    finally:
        os.umask(before)
    return listener


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Lock the directory: no other process sees a socket before it listens, or removes it then."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def alive(path: Path) -> bool:
    """Return whether a process listens at a socket, also one that is busy or stopped; never waits."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except BlockingIOError:  # its queue of connections is full
            return True
        except OSError:
            return False
        return True


def listener(path: Path) -> int | None:
    """Return the ID of the process that listens at a socket; None when it cannot be connected at once."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        with suppress(OSError):
            probe.connect(str(path))
            credentials = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
            return int(struct.unpack("3i", credentials)[0])
    return None


def running() -> tuple[str, ...]:
    """Return the names of the robots that run and can be steered; sockets without a process are removed."""
    return tuple(sorted(sockets()))


def sockets() -> dict[str, Path]:
    """Return the sockets of running robots by name, and remove those without a process."""
    found: dict[str, Path] = {}
    directory = place()
    if not owned(directory):
        return found
    with _locked(directory):
        for path in directory.glob(f"*{SUFFIX}"):
            if alive(path):
                found[path.stem] = path
            elif path.is_socket():
                path.unlink(missing_ok=True)
    return found


class Address(NamedTuple):
    """Where the gateway of a robot listens."""

    name: str
    """In the robot's certificate."""
    host: str
    port: int

    @classmethod
    def parse(cls, text: str, name: str = "") -> Address:
        """Return the address that `[NAME@]HOST:PORT` means; raises InputError."""
        found = _ADDRESS.fullmatch(text)
        if not found or not 0 < int(found[3]) < 1 << 16 or not (found[1] or name):
            raise InputError(f"{text[:80]!r} is no address; write [NAME@]HOST:PORT, such as torso@lab3:7660")
        return cls(found[1] or name, found[2].strip("[]"), int(found[3]))

    def __str__(self) -> str:
        return f"{self.name}@{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


class RobotLink(Protocol):
    """How a client reaches a robot; everything raises OSError or ValueError when that does not answer."""

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Make one request; return status and answer."""
        ...

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Make a request whose answer goes on; return status, first bytes, and where the others come."""
        ...

    @property
    def alive(self) -> bool:
        """True while the robot can be asked."""
        ...

    def ends(self) -> bool:
        """Return whether a stream that was closed is of a run that has ended."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


class SocketLink:
    """HTTP on the socket of a run: one connection for requests, one at a time, and one for each stream."""

    def __init__(self, path: Path, client: str) -> None:
        self._path = path
        self._end: socket.socket | None = None
        self._used = time.monotonic()
        self.client = "".join(letter for letter in client if letter.isprintable())
        """The name of the client for the log."""

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Ask once; return status and answer. Nothing is sent twice: the first may have been received."""
        content = body or b""
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(content)}\r\nX-Dxlrun-Client: {self.client}\r\n\r\n"
        )
        end = self._end
        if end is None or time.monotonic() - self._used > _IDLE_S or _hung_up(end):
            self.close()
            end = self._end = self._connected()
        try:
            end.sendall(head.encode() + content)
            status, answer, closes = _answer(end)
        except BaseException:  # Ctrl-C between question and answer: the answer must not meet the next one
            self.close()
            raise
        if closes:
            self.close()
        self._used = time.monotonic()
        return status, answer

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Return status, first bytes and the connection of an answer that ends with the connection."""
        end = self._connected()
        try:
            end.sendall(f"GET {path} HTTP/1.0\r\n\r\n".encode())
            status, first, _ = _answer(end)
        except BaseException:
            end.close()
            raise
        return status, first, end

    def _connected(self) -> socket.socket:
        return _connected(self._path)

    def close(self) -> None:
        """Close the connection; the robot keeps running."""
        if self._end is not None:
            self._end.close()
            self._end = None

    @property
    def alive(self) -> bool:
        """True while a gateway listens at the socket."""
        return alive(self._path)

    def ends(self) -> bool:
        """Return whether the run has ended, or ends within a second: its gateway's socket is removed then.

        Of a gateway that was killed it is left, or it listens still.
        """
        until = time.monotonic() + _ENDING_S
        while self._path.exists():
            if time.monotonic() > until:
                return False
            time.sleep(0.02)
        return True


def _connected(path: Path) -> socket.socket:
    """Connect to a socket; where its queue of connections is full, wait in the Linux kernel's.

    Linux serves those that wait in order (a socket with a timeout of Python does not wait: unix(7), EAGAIN),
    so a process that floods the queue only delays this one.
    """
    end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    timeval = struct.pack("@2l", int(TIMEOUT_S), int(TIMEOUT_S % 1 * 1e6))
    end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeval)
    try:
        end.connect(str(path))
    except BlockingIOError:
        end.close()
        raise TimeoutError(f"too many connect to it, its queue was full for {TIMEOUT_S:g} s") from None
    except BaseException:
        end.close()
        raise
    end.settimeout(TIMEOUT_S)
    return end


def _hung_up(end: socket.socket) -> bool:
    """Return whether the other end has closed it; it sends nothing unasked, so any byte means that too."""
    look = select.poll()
    look.register(end, select.POLLIN)
    return bool(look.poll(0))


def _answer(end: socket.socket) -> tuple[int, bytes, bool]:
    """Return status and body of an answer, of one without a length its beginning, and whether it is the last.

    Raises OSError when the connection is closed before, ValueError for what is no answer.
    """
    data = b""
    while not (found := _HEAD.match(data)):
        if not (more := end.recv(_CHUNK)):
            raise ConnectionResetError("the connection was closed without an answer")
        data += more
        if not data.startswith(b"HTTP/1."[: len(data)]):
            raise ValueError(f"{data[:40]!r} is no answer of HTTP")
    head, content = found[0].lower(), bytearray(data[found.end() :])
    length = _LENGTH.search(head)
    while length and len(content) < int(length[1]):
        if not (more := end.recv(_CHUNK)):
            raise ConnectionResetError("the connection was closed in an answer")
        content += more
    return int(found[1]), bytes(content), b"\r\nconnection: close" in head
