"""The file of a log: bytes that are on the disk, or an error."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

from dxlrun.output.target import open_empty

LOG_MODE = 0o640
"""Of a new log: commands and the names of clients are for its user and group."""


class LogFile:
    """Unbuffered bytes on a disk; every method raises OSError when the disk does not take or keep them."""

    __slots__ = ("_descriptor", "_path", "_size")

    def __init__(self, path: Path) -> None:
        self._descriptor = open_empty(path, LOG_MODE)  # empty is how a name is taken before a log begins
        self._path = path
        self._size = 0

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Write all of `data`; Linux may take it in pieces, and the last piece shows a full disk."""
        if os.fstat(self._descriptor).st_size < self._size:
            raise OSError(errno.EIO, "the file was cut by another program")
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return how many bytes were written whole."""
        return self._size

    def flush(self) -> None:
        """Nothing is held back here."""

    def sync(self) -> None:
        """Wait until the disk has what was written."""
        (os.fdatasync if sys.platform == "linux" else os.fsync)(self._descriptor)

    def truncate(self, size: int) -> None:
        """Cut what lies behind `size`; a file that is shorter stays so."""
        size = min(size, os.fstat(self._descriptor).st_size)
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self._size = size

    @property
    def gone(self) -> bool:
        """Whether another program deleted, moved or replaced the file."""
        ours = os.fstat(self._descriptor)
        try:
            there = self._path.stat()
        except OSError:
            return True
        return (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino)

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._descriptor)
