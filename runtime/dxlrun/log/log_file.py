"""Log file: unbuffered output with errors for all lost bytes; the writer holds a lock on the file."""

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
"""Mode of a new log: commands and names of clients are only for its user and group."""
# Without locks, a file counts as being written for this time after its last change.
_LATELY_S = 10.0
_HELD = (errno.EWOULDBLOCK, errno.EACCES)


def has_writer(path: Path) -> bool:
    """Return whether a process has this file of a log open for writing.

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
    """Unbuffered file; every method raises OSError when the disk does not accept or keep the bytes."""

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
        """Write all of `data`. Linux may write less than requested; only the rest then shows a full disk."""
        if os.fstat(self._descriptor).st_size < self._size:
            raise OSError(errno.EIO, "the file was cut by another program")
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes that were written."""
        return self._size

    def flush(self) -> None:
        """Do nothing: output is not buffered."""

    def sync(self) -> None:
        """Wait until the disk has all written bytes."""
        (os.fdatasync if sys.platform == "linux" else os.fsync)(self._descriptor)

    def truncate(self, size: int) -> None:
        """Truncate the file to `size`; a shorter file keeps its length."""
        size = min(size, os.fstat(self._descriptor).st_size)
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self._size = size

    @property
    def gone(self) -> bool:
        """True when another program deleted, moved or replaced the file."""
        ours = os.fstat(self._descriptor)
        try:
            there = self._path.stat()
        except OSError:
            return True
        return (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino)

    def close(self) -> None:
        """Release the lock and close the file, even if a forked child still has the file descriptor."""
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        os.close(self._descriptor)
