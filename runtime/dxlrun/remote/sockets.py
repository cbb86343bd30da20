"""Where the sockets of running robots are, and which robots run."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

from dxlrun.errors import DxlrunError

SUFFIX = ".sock"


def directory() -> Path:
    """Return the directory of this user's sockets, made when it is missing; nobody else may look into it.

    `$XDG_RUNTIME_DIR/dxlrun` (XDG Base Directory Specification), else `/tmp/dxlrun-<user ID>`. Raises
    DxlrunError when the directory belongs to somebody else, or others may enter it.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    place = Path(runtime, "dxlrun") if runtime else Path(f"/tmp/dxlrun-{os.getuid()}")  # noqa: S108  checked below
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise DxlrunError(
            f"{place} must be a directory that only you may enter: remove it, or set XDG_RUNTIME_DIR"
        )
    return place


def listen(robot: str) -> tuple[socket.socket, Path]:
    """Return a listening socket of a robot (mode 0600) and its path.

    A second run of the same robot gets its process' number into the name.
    """
    place = directory()
    path = place / f"{robot}{SUFFIX}"
    if alive(path):
        path = place / f"{robot}-{os.getpid()}{SUFFIX}"
    path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    listener.listen(64)
    return listener, path


def alive(path: Path) -> bool:
    """Say whether somebody listens at a socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True


def running() -> tuple[str, ...]:
    """Return the names of the robots that run and can be steered; sockets that nobody serves are removed."""
    names = []
    for path in sorted(directory().glob(f"*{SUFFIX}")):
        if alive(path):
            names.append(path.stem)
        else:
            path.unlink(missing_ok=True)
    return tuple(names)
