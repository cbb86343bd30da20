"""Sockets of running robots: where they are, and which robots run; used by gateway and client.

A socket is in `$XDG_RUNTIME_DIR/dxlrun` (XDG Base Directory Specification) where this user owns that, else
in `/tmp/dxlrun-<user ID>`; never in both. A service and a login shell that differ in the variable do not find
each other's runs: set it alike.
"""

from __future__ import annotations

import fcntl
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dxlrun.errors import DxlrunError

SUFFIX = ".sock"
MOST_BYTES = 1 << 20
"""The longest body of a request; longer ones are refused before they are read."""
LONGEST_PATH = 107
"""Bytes; what Linux takes as the name of a Unix socket (unix(7)), without the final zero."""


def place() -> Path:
    """Return the directory of this user's sockets; it may not exist yet."""
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
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
