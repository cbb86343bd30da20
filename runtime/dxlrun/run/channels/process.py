"""Starting dxlrun's own processes, and talking to them in lines of JSON over a socket pair."""

from __future__ import annotations

import io
import mmap
import os
import socket
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress

import msgspec

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Importing numpy alone starts a thread for each core otherwise."""
_LINE_LIMIT = 1 << 20
_MOST_DESCRIPTORS = 64


def spare_core(taken: Collection[int]) -> int:
    """Return the last core that this process may use and that is not taken; the last one if all are."""
    allowed = os.sched_getaffinity(0)
    return max(allowed.difference(taken) or allowed)


def start(
    module: str, arguments: Sequence[str], descriptors: Iterable[int], errors: int
) -> subprocess.Popen[bytes]:
    """Execute `python -m module` in a session of its own, so that a terminal's Ctrl-C does not reach it.

    `descriptors` are inherited; `errors` takes what it prints, which only --debug shows. `-P` keeps the
    working directory out of the import path: a student's `numpy.py` beside the robot file must not be
    imported.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        pass_fds=tuple(descriptors),
        stdin=subprocess.DEVNULL,
        stdout=errors,
        stderr=errors,
        start_new_session=True,
        env=os.environ | _ONE_THREAD,
    )


def memory_file(name: str, content: bytes = b"") -> int:
    """Return the descriptor of a nameless file (memfd) with `content`."""
    descriptor = os.memfd_create(name)
    os.pwrite(descriptor, content, 0)
    return descriptor


def shared_memory(descriptor: int) -> memoryview:
    """Map a nameless file to be written by one process and read by others."""
    return memoryview(mmap.mmap(descriptor, 0))


def whole(descriptor: int) -> bytes:
    """Return everything in a nameless file, wherever its offset stands."""
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


class Printed(io.TextIOBase):
    """Takes what plug-ins print, unbuffered and bounded: a controller that prints each cycle fills no memory.

    `descriptor` is the nameless file that `start` made the process' output; --debug shows it.
    """

    def __init__(self, descriptor: int, most: int = 1 << 20) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._room = most

    def writable(self) -> bool:
        """Say that it can be written."""
        return True

    def fileno(self) -> int:
        """Return the descriptor behind it."""
        return self._descriptor

    def write(self, text: str, /) -> int:
        """Keep the text, as long as there is room; never raises."""
        data = text.encode(errors="replace")[: self._room]
        self._room -= len(data)
        with suppress(OSError):
            os.write(self._descriptor, data)
            if data and not self._room:
                os.write(self._descriptor, b"\n(what was printed after this is left out)\n")
        return len(text)


class Line:
    """One end of a conversation between two processes: JSON objects, one a line."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._pending = b""
        self.closed = False
        """True after the end of what the other end sent was read."""
        self.descriptors: list[int] = []
        """What the other end handed over."""

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    def send(self, message: Mapping[str, object], descriptors: Sequence[int] = ()) -> None:
        """Send one object, and open descriptors with it; never raises.

        An end that is gone is noticed by the next receive, not here: what it said last is still to be read.
        """
        data = msgspec.json.encode(message) + b"\n"
        with suppress(OSError):
            if descriptors:
                socket.send_fds(self._socket, [data], descriptors)
            else:
                self._socket.sendall(data)

    def receive(self) -> list[dict[str, object]]:
        """Return the objects that arrive in one read; waits for one read, sets `closed` at its end."""
        try:
            chunk, descriptors, _, _ = socket.recv_fds(self._socket, 65536, _MOST_DESCRIPTORS)
            self.descriptors += descriptors
        except OSError:
            chunk = b""
        if not chunk or len(self._pending) > _LINE_LIMIT:
            self.closed = True
        *lines, self._pending = (self._pending + chunk).split(b"\n")
        return [msgspec.json.decode(line, type=dict[str, object]) for line in lines]

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def line_pair() -> tuple[Line, socket.socket]:
    """Return our end, and the other one to be inherited by a child (close it here after the start)."""
    ours, theirs = socket.socketpair()
    return Line(ours), theirs
