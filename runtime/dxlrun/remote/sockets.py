"""Sockets: the socket files of running robots, their discovery, and a client's connection to a robot.

The sockets are in `$XDG_RUNTIME_DIR/dxlrun` (XDG Base Directory Specification) when this user owns
XDG_RUNTIME_DIR, else in `/tmp/dxlrun-<user ID>`; never in both. A service and a login shell with different
values of the variable do not find each other's runs; set it to the same value.
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
"""Upper limit of a request's body, bytes; the gateway refuses longer ones before it reads them."""
TIMEOUT_S = 10.0
"""Timeout for a reply, s: about two for a command, and six more for a switch that waits for mode changes."""
_IDLE_S = 20.0
"""Longest idle time, s, of a connection that is used again; the gateway closes silent connections after 30 s.
"""
_ENDING_S = 1.0
"""Time, s, within which a gateway that closed a connection at the end of a run removes its socket."""
LONGEST_PATH = 107
"""Longest path of a Unix socket on Linux, bytes without the terminating zero (unix(7))."""
_START_POLL_S = 0.05
LONGEST_START_S = 120.0
"""Longest time, s, for which a client waits for a start, which may take a minute on a busy machine."""


def sockets_directory(runtime_directory: str | None = None) -> Path:
    """Return the directory for the sockets of this user's robots; it may not exist yet.

    `runtime_directory`: XDG_RUNTIME_DIR of another process, empty when unset there; None: of this process.
    """
    ours = os.environ.get("XDG_RUNTIME_DIR", "")
    runtime = Path(ours if runtime_directory is None else runtime_directory)
    with suppress(OSError):
        # su and sudo may leave another user's XDG_RUNTIME_DIR in the environment.
        if runtime.is_absolute() and runtime.stat().st_uid == os.getuid():
            return runtime / "dxlrun"
    return Path(f"/tmp/dxlrun-{os.getuid()}")  # noqa: S108  entered only if this user owns it


def owned(directory: Path) -> bool:
    """Return True when a path is a directory of this user that no other user may enter; a link is not
    followed.
    """
    try:
        found = directory.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077


def create_listener(robot: str) -> tuple[socket.socket, Path]:
    """Create the listening socket of a robot's gateway (mode 0600); return the socket and its path.

    The path of a second run of the same robot contains its process ID. Raises DxlrunError when the directory
    is not safe.
    """
    directory = sockets_directory()
    with suppress(OSError):
        directory.mkdir(mode=0o700)
    if not owned(directory):
        raise DxlrunError(
            f"{directory} is not a private directory of this user; remove it, or set XDG_RUNTIME_DIR"
        )
    with _locked(directory):
        path = directory / f"{robot}{SUFFIX}"
        if alive(path):
            path = directory / f"{robot}-{os.getpid()}{SUFFIX}"
        if len(os.fsencode(path)) > LONGEST_PATH:
            raise DxlrunError(f"{path} is too long for a socket; give the robot a shorter name")
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
    """Lock the directory of sockets, so that no process sees or removes a socket that does not listen yet."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def alive(path: Path) -> bool:
    """Return True when a process listens at a socket file, even if it is busy or stopped; does not block."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        # The queue of connections is full, so a process listens.
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True


def listener(path: Path) -> int | None:
    """Return the ID of the process that listens at a socket; None when it does not accept at once."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        with suppress(OSError):
            probe.connect(str(path))
            credentials = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
            return int(struct.unpack("3i", credentials)[0])
    return None


def running() -> tuple[str, ...]:
    """Return the names of this user's running robots that have a gateway; stale socket files are removed."""
    return tuple(sorted(sockets()))


def sockets() -> dict[str, Path]:
    """Return the socket files of this user's running robots by name; stale socket files are removed."""
    found: dict[str, Path] = {}
    directory = sockets_directory()
    if not owned(directory):
        return found
    with _locked(directory):
        for path in directory.glob(f"*{SUFFIX}"):
            if alive(path):
                found[path.stem] = path
            elif path.is_socket():
                path.unlink(missing_ok=True)
    return found


def await_sockets(robot: str | None) -> dict[str, Path]:
    """Return `sockets()`; wait first, at most two minutes, while a robot starts that is not among them yet.

    A wait is logged once as a warning, which Python prints to stderr where a program configures no logging.

    Args:
        robot: Name of the robot; None: any robot.
    """
    found, is_reported, end_s = sockets(), False, time.monotonic() + LONGEST_START_S
    while not (found if robot is None else robot in found):
        if time.monotonic() >= end_s or not is_awaited(robot):
            return sockets()  # a run that is not starting any more may run by now
        if not is_reported:
            import logging  # a running robot is found without it

            is_reported = True
            logging.getLogger(__name__).warning("waiting for %s, which is starting", robot or "a robot")
        time.sleep(_START_POLL_S)
        found = sockets()
    return found


def is_awaited(robot: str | None) -> bool:
    """Return whether a robot (None: any) is starting on this computer, so that a client waits for it."""
    # Imported here because a running robot is found without it.
    from dxlrun.channels.heartbeat import is_starting
    from dxlrun.process_table import found_runs, start_directories

    ours = sockets_directory()
    return any(sockets_directory(each) == ours for each in start_directories()) or any(
        robot in (None, run.robot) and sockets_directory(run.runtime_directory) == ours and is_starting(run)
        for run in found_runs()
    )


class Address(NamedTuple):
    """Address of a robot's gateway on another computer."""

    name: str
    """Name in the robot's certificate, which the client checks."""
    host: str
    port: int

    @classmethod
    def parse(cls, text: str, name: str = "") -> Address:
        """Parse `[NAME@]HOST:PORT`; `name` is the default for NAME. Raises InputError."""
        found = _ADDRESS.fullmatch(text)
        if not found or not 0 < int(found[3]) < 1 << 16 or not (found[1] or name):
            raise InputError(
                f"{text[:80]!r} is not an address; write [NAME@]HOST:PORT, such as torso@lab3:7660"
            )
        return cls(found[1] or name, found[2].strip("[]"), int(found[3]))

    def __str__(self) -> str:
        return f"{self.name}@{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


class RobotLink(Protocol):
    """A client's connection to a robot's gateway.

    Methods raise OSError or ValueError without a valid reply.
    """

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Send one HTTP request; return status and body of the reply."""
        ...

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Send a GET request with a streamed reply; return status, first bytes and a socket with the rest."""
        ...

    @property
    def alive(self) -> bool:
        """True while the robot's gateway accepts connections."""
        ...

    def ends(self) -> bool:
        """Return True if the run has ended, after the gateway closed a stream; waits up to about a second."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


class SocketLink:
    """HTTP over a gateway's Unix socket: one connection for all requests, and one more for each stream."""

    def __init__(self, path: Path, client: str) -> None:
        self._path = path
        self._end: socket.socket | None = None
        self._used = time.monotonic()
        self.client = "".join(letter for letter in client if letter.isprintable())
        """Name of this client in the robot's log."""

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Send one request; return HTTP status and body.

        It is never sent twice: the gateway may have executed it.
        """
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
        # After Ctrl-C, the pending reply must not be taken for the reply to the next request.
        except BaseException:
            self.close()
            raise
        if closes:
            self.close()
        self._used = time.monotonic()
        return status, answer

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Send a GET request on a new connection; return status, first bytes, and the connection with the
        rest.
        """
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
        """Close the connection for requests; the robot keeps running, and streams stay open."""
        if self._end is not None:
            self._end.close()
            self._end = None

    @property
    def alive(self) -> bool:
        """True while a process listens at the socket."""
        return alive(self._path)

    def ends(self) -> bool:
        """Return True if the gateway removes its socket file within a second, which means that the run has
        ended.

        The file remains while the gateway runs, and after it was killed.
        """
        until = time.monotonic() + _ENDING_S
        while self._path.exists():
            if time.monotonic() > until:
                return False
            time.sleep(0.02)
        return True


def _connected(path: Path) -> socket.socket:
    """Connect to a gateway's socket; wait up to TIMEOUT_S in the Linux kernel's queue when its backlog is
    full.

    Linux serves waiting processes first come, first served, so a process that floods the queue only delays
    this one. A Python timeout would not wait: connect fails with EAGAIN on a non-blocking socket (unix(7)).
    """
    end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    timeval = struct.pack("@2l", int(TIMEOUT_S), int(TIMEOUT_S % 1 * 1e6))
    end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeval)
    try:
        end.connect(str(path))
    except BlockingIOError:
        end.close()
        raise TimeoutError(
            f"too many clients: the queue of connections was full for {TIMEOUT_S:g} s"
        ) from None
    except BaseException:
        end.close()
        raise
    end.settimeout(TIMEOUT_S)
    return end


def _hung_up(end: socket.socket) -> bool:
    """Return True when an idle connection was closed by the gateway; an unrequested byte counts as closed,
    too.
    """
    look = select.poll()
    look.register(end, select.POLLIN)
    return bool(look.poll(0))


def _answer(end: socket.socket) -> tuple[int, bytes, bool]:
    """Read a reply; return status, body, and True if the gateway closes the connection after it.

    The body of a reply without a length is what arrived with its head.

    Raises:
        OSError: The connection was closed before the end of the reply.
        ValueError: The reply is not HTTP.
    """
    data = b""
    while not (found := _HEAD.match(data)):
        if not (more := end.recv(_CHUNK)):
            raise ConnectionResetError("the connection was closed without a reply")
        data += more
        if not data.startswith(b"HTTP/1."[: len(data)]):
            raise ValueError(f"{data[:40]!r} is not an HTTP reply")
    head, content = found[0].lower(), bytearray(data[found.end() :])
    length = _LENGTH.search(head)
    while length and len(content) < int(length[1]):
        if not (more := end.recv(_CHUNK)):
            raise ConnectionResetError("the connection was closed during a reply")
        content += more
    return int(found[1]), bytes(content), b"\r\nconnection: close" in head
