"""The shared memory of a measuring process: a few numbers about it, then two times of each wake-up.

The process writes, and the front process reads, also while it measures; nothing else passes between them, so
the measurement has neither sentences to make nor pipes to fill. yardstick.c has the same layout.
"""

from __future__ import annotations

import mmap
import os
from contextlib import suppress
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Place(IntEnum):
    """Where the numbers are, in 64-bit integers; the wake-ups follow."""

    DONE = 0
    """Wake-ups that are complete."""
    STOP = 1
    """Not 0: the front process asks for the end."""
    CPU_NS = 2
    """Processor time of the process from the first wait to the last wake-up."""
    WALL_NS = 3
    """The same in time that passed; 0 until it is finished."""
    MARGIN_NS = 4
    """How long the clock is polled before a deadline."""
    WAKE_UPS = 8


SIZE = 8


def create_file(name: str, content: bytes = b"") -> int:
    """Return the descriptor of a nameless file (memfd) with `content`."""
    descriptor = os.memfd_create(name)
    os.pwrite(descriptor, content, 0)
    return descriptor


def read_file(descriptor: int) -> bytes:
    """Return everything in a nameless file, wherever its offset is."""
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


class Buffer:
    """The memory of one block; a nameless file."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._map = mmap.mmap(descriptor, 0)
        self.words = memoryview(self._map).cast("q")
        """Everything, to be read and written by place."""

    @classmethod
    def create(cls, iterations: int) -> Buffer:
        """Return one that has room for so many wake-ups; every page of it is there."""
        descriptor = os.memfd_create("wake_ups")
        size = SIZE * (Place.WAKE_UPS + 2 * iterations)
        os.posix_fallocate(descriptor, 0, size)
        return cls(descriptor)

    def touch(self) -> None:
        """Have each page in this process' table of pages before the measurement begins."""
        for word in range(0, len(self.words), mmap.PAGESIZE // SIZE):
            self.words[word] = self.words[word]

    def wake_ups(self) -> NDArray[np.int64]:
        """Return a copy of what was measured until now: deadline and wake-up, ns; shape (wake-ups, 2)."""
        done = self.words[Place.DONE]
        times = np.frombuffer(self.words, np.int64, 2 * done, Place.WAKE_UPS * SIZE)
        return times.reshape(-1, 2).copy()

    def worst_ns(self, begin: int, end: int) -> int:
        """Return the largest lateness of the wake-ups from `begin` to before `end`, 0 without any."""
        times = np.frombuffer(self.words, np.int64, 2 * (end - begin), (Place.WAKE_UPS + 2 * begin) * SIZE)
        return int((times[1::2] - times[::2]).max(initial=0))

    def close(self) -> None:
        """Let go of it."""
        with suppress(BufferError):  # an interrupted reader still has a view: the memory goes with that
            self.words.release()
            self._map.close()
        os.close(self.descriptor)
