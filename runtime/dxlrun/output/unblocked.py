"""Output that never waits for its reader: no full pipe or stopped terminal keeps a signal from a robot."""

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
"""That wait for the reader; the oldest ones are left out for newer ones."""
LAST_WRITE_S = 3.0
"""How long the end of a command waits for a reader that takes nothing."""


def leave_real_time() -> None:
    """Give up a real-time policy of the terminal (`chrt -r 31 dxlrun`) for the calling thread.

    Loop, guardian and simulated servos request theirs themselves; nothing else of a run may disturb them.
    """
    with suppress(AttributeError, OSError):  # other systems have no such call; musl refuses it
        if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in {os.SCHED_FIFO, os.SCHED_RR}:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def unblocked() -> Iterator[None]:
    """Let stdout and stderr take text at once, whatever their readers do; what a reader left is ignored.

    A stream without a descriptor (a test's) stays as it is.
    """
    before = sys.stdout, sys.stderr
    writers: dict[tuple[int, int], _Writer] = {}
    sys.stdout, sys.stderr = (_stream(stream, writers) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        with suppress(KeyboardInterrupt):  # that reader is waited for no longer
            for writer in writers.values():
                writer.settle()


def _stream(stream: TextIO, writers: dict[tuple[int, int], _Writer]) -> TextIO:
    try:
        stream.flush()
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return stream
    # of one terminal the lines stay in order
    writer = writers.setdefault((found.st_dev, found.st_ino), _Writer())
    return cast("TextIO", _Unblocked(stream, writer))


class _Unblocked:
    """A stream whose text goes to a writer."""

    def __init__(self, stream: TextIO, writer: _Writer) -> None:
        self._stream, self._writer = stream, writer

    def write(self, text: str) -> int:
        """Take text; it is written soon."""
        self._writer.write(self._stream.fileno(), text.encode(self._stream.encoding or "utf-8", "replace"))
        return len(text)

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


class _Writer:
    """A thread that is the only one to wait for a reader.

    It runs before anything is written: the first print may be that of a controller, which starts no thread.
    O_NONBLOCK would be shared with other processes of the same terminal or pipe, and a poll before each write
    does not tell how much fits.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, bytes]] = deque(maxlen=MOST_WRITES)
        self._changed = threading.Condition()
        self._idle = True
        threading.Thread(target=self._write_for_ever, daemon=True).start()

    def write(self, descriptor: int, data: bytes) -> None:
        """Take what is to be written."""
        with self._changed:
            self._waiting.append((descriptor, data))
            self._changed.notify_all()

    def settle(self) -> None:
        """Wait for the reader to take what was written, if it does."""
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
                except BlockingIOError:  # another process made the pipe non-blocking
                    select.select([], [descriptor], [])
                except OSError:  # the reader is gone, or the disk is full
                    break
