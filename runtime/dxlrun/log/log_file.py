"""Log file: unbuffered file output that reports lost bytes; holds a lock while a log is being written."""

from __future__ import annotations

import errno
import os
import sys
import time
from contextlib import suppress
from pathlib import Path

from dxlrun.output.target import open_empty

try:
    import fcntl
# Windows, where logs are only read.
except ImportError:
    fcntl = None  # type: ignore[assignment]  # a module, or none

LOG_MODE = 0o640
"""Permissions of a new log file: only its user and group can read the clients' commands and names."""
FOLDER_MODE = 0o750
"""Permissions of a log's directory of parts, with the same rights as a log's file."""
# Without locks, a file counts as being written for this time after its last change.
_LATELY_S = 10.0
_HELD = (errno.EWOULDBLOCK, errno.EACCES)


def has_writer(path: Path) -> bool:
    """Return True if a process is writing this file of a log.

    The writer holds a lock (flock(2)), which Linux releases at any end of the process. On a file system
    without locks, a file that changed within 10 s counts as being written.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
    except OSError as error:
        if error.errno in _HELD:
            return True
    finally:
        os.close(descriptor)
    with suppress(OSError):
        return time.time() - path.stat().st_mtime < _LATELY_S
    return False


class LogFile:
    """File of a log, opened for writing and locked; methods raise OSError if the disk refuses bytes."""

    __slots__ = ("_descriptor", "_path", "_size")

    def __init__(self, path: Path) -> None:
        # An empty file reserves the name before the log begins.
        self._descriptor = open_empty(path, LOG_MODE)
        if fcntl is not None:
            # The file system may not support locks.
            with suppress(OSError):
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._path = path
        self._size = 0

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Write all of `data` and return its length. Raises OSError on a full disk or a truncated file."""
        if os.fstat(self._descriptor).st_size < self._size:
            raise OSError(errno.EIO, "another program truncated the file")
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written so far."""
        return self._size

    def flush(self) -> None:
        """Do nothing: required by the MCAP library, but output is not buffered."""

    def sync(self) -> None:
        """Block until the disk has stored all written bytes."""
        (os.fdatasync if sys.platform == "linux" else os.fsync)(self._descriptor)

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes and continue there; a shorter file keeps its length."""
        size = min(size, os.fstat(self._descriptor).st_size)
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self._size = size

    @property
    def gone(self) -> bool:
        """True if another program deleted, moved or replaced the file during the run."""
        ours = os.fstat(self._descriptor)
        try:
            there = self._path.stat()
        except OSError:
            return True
        return (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino)

    def close(self) -> None:
        """Release the lock and close the file; the lock ends even if a forked child has the descriptor."""
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        os.close(self._descriptor)
