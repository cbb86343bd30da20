"""Shared memory of a measuring process: a header, then two times per wake-up.

The measuring process writes while the front process reads. There is no other communication, so the
measurement neither formats text nor writes to pipes. yardstick.c uses the same layout.
"""

from __future__ import annotations

import mmap
import os
from contextlib import suppress
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class BufferOffset(IntEnum):
    """Offsets in the shared memory, in 64-bit integers"""

    DONE = 0
    """Number of complete wake-ups"""
    STOP = 1
    """Set to a value other than 0 by the front process to request the end"""
    CPU_NS = 2
    """Processor time from the first wait to the last wake-up, ns"""
    WALL_NS = 3
    """Elapsed time from the first wait to the last wake-up, ns; 0 until the end"""
    MARGIN_NS = 4
    """Time for which the clock is polled before a deadline, ns"""
    WAKE_UPS = 8
    """Start of the wake-ups: deadline and wake-up time of each, ns"""


SIZE = 8


def create_file(name: str, content: bytes = b"") -> int:
    """Create an anonymous file in memory (memfd) with `content`, and return its descriptor."""
    descriptor = os.memfd_create(name)
    os.pwrite(descriptor, content, 0)
    return descriptor


def read_file(descriptor: int) -> bytes:
    """Return the whole content of an anonymous file, whatever its offset."""
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


class Buffer:
    """Shared memory of one block of wake-ups, an anonymous file that the measuring process inherits"""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._map = mmap.mmap(descriptor, 0)
        self.words = memoryview(self._map).cast("q")
        """Whole memory as 64-bit integers, indexed by Place"""

    @classmethod
    def create(cls, iterations: int) -> Buffer:
        """Create a buffer for a number of wake-ups, with all pages allocated."""
        descriptor = os.memfd_create("wake_ups")
        size = SIZE * (BufferOffset.WAKE_UPS + 2 * iterations)
        os.posix_fallocate(descriptor, 0, size)
        return cls(descriptor)

    def touch_pages(self) -> None:
        """Access each page, so that no page fault occurs during the measurement."""
        for word in range(0, len(self.words), mmap.PAGESIZE // SIZE):
            self.words[word] = self.words[word]

    def wake_ups(self) -> NDArray[np.int64]:
        """Return a copy of the measurements so far: deadline and wake-up, ns; shape (wake-ups, 2)."""
        done = self.words[BufferOffset.DONE]
        times = np.frombuffer(self.words, np.int64, 2 * done, BufferOffset.WAKE_UPS * SIZE)
        return times.reshape(-1, 2).copy()

    def worst_ns(self, begin: int, end: int) -> int:
        """Return the largest lateness of the wake-ups from `begin` to before `end`, ns; 0 without any."""
        times = np.frombuffer(
            self.words, np.int64, 2 * (end - begin), (BufferOffset.WAKE_UPS + 2 * begin) * SIZE
        )
        return int((times[1::2] - times[::2]).max(initial=0))

    def close(self) -> None:
        """Unmap the memory and close the file."""
        with suppress(BufferError):  # an interrupted reader may still hold a view
            self.words.release()
            self._map.close()
        os.close(self.descriptor)
