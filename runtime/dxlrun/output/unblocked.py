"""Unblocked output: stdout and stderr that never wait, so that a full pipe delays no signal."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO, cast

MOST_WRITES = 1000
"""Most writes that wait for a slow reader; beyond it, the oldest are dropped."""
LAST_WRITE_S = 3.0
"""Longest time to wait for the reader of the last output at the end of a command, s."""


def leave_real_time() -> None:
    """Reset a real-time scheduling policy (`chrt -r 31 dxlrun`) of the calling thread to the usual one.

    Loop, guardian and simulated servos request their own; no other process of a run may disturb them.
    """
    # Other systems do not have these calls; musl refuses them.
    with suppress(AttributeError, OSError):
        if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in {os.SCHED_FIFO, os.SCHED_RR}:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def unblocked() -> Iterator[None]:
    """Context manager in which stdout and stderr never block; text that no reader takes is dropped.

    A stream without a file descriptor (of a test) stays as it is.
    """
    before = sys.stdout, sys.stderr
    writers: dict[tuple[int, int], _Writer] = {}
    sys.stdout, sys.stderr = (_stream(stream, writers) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        # Ctrl-C ends the wait for a reader.
        with suppress(KeyboardInterrupt):
            for writer in writers.values():
                writer.wait_until_written()


def _stream(stream: TextIO, writers: dict[tuple[int, int], _Writer]) -> TextIO:
    try:
        stream.flush()
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return stream
    # Both streams of one terminal share a writer, which keeps the sequence of lines.
    writer = writers.setdefault((found.st_dev, found.st_ino), _Writer())
    return cast("TextIO", _UnblockedStream(stream, writer))


class _UnblockedStream:
    """Replaces stdout or stderr: passes all text to a writer thread."""

    def __init__(self, stream: TextIO, writer: _Writer) -> None:
        self._stream, self._writer = stream, writer

    def write(self, text: str) -> int:
        """Queue text for the writer thread and return its length."""
        self._writer.queue_bytes(
            self._stream.fileno(), text.encode(self._stream.encoding or "utf-8", "replace")
        )
        return len(text)

    def flush(self) -> None:
        """Do nothing: the writer thread writes without buffering."""

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


class _Writer:
    """Thread that writes queued text to file descriptors, the only one that waits for their readers.

    It starts before anything is written: the first print may be that of a controller, which must not start a
    thread. O_NONBLOCK would also affect other processes of the same terminal or pipe, and a poll before a
    write does not show how many bytes fit.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, bytes]] = deque(maxlen=MOST_WRITES)
        self._changed = threading.Condition()
        self._idle = True
        threading.Thread(target=self._write_for_ever, daemon=True).start()

    def queue_bytes(self, descriptor: int, data: bytes) -> None:
        """Queue bytes for a file descriptor and return at once."""
        with self._changed:
            self._waiting.append((descriptor, data))
            self._changed.notify_all()

    def wait_until_written(self) -> None:
        """Wait until all queued bytes are written, at most LAST_WRITE_S."""
        with self._changed:
            self._changed.wait_for(lambda: self._idle and not self._waiting, LAST_WRITE_S)

    def _write_for_ever(self) -> None:
        leave_real_time()
        while True:
            with self._changed:
                self._idle = not self._waiting
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting)
                self._idle, (descriptor, data) = False, self._waiting.popleft()
            while data:
                try:
                    data = data[os.write(descriptor, data) :]
                # Another process has made the pipe non-blocking.
                except BlockingIOError:
                    select.select([], [descriptor], [])
                # The reader is gone, or the disk is full.
                except OSError:
                    break
