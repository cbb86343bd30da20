"""Heartbeat: one page of shared memory by which the guardian and the terminal see that the loop lives.

Single writer (the loop's process). Each field is one aligned 64-bit store, which x86-64 makes whole; that is
where it was tested. On other machines a reader may see a field torn.
"""

from __future__ import annotations

import mmap
import os
import struct
from enum import IntEnum, unique

_SIZE = 4096
_FIELD = struct.Struct("<Q")
_PHASE, _BEATS, _CYCLE, _SKIPPED = 0, 8, 16, 24


@unique
class Phase(IntEnum):
    """How far the loop's process has come; the guardian's patience depends on it."""

    LOADING = 0
    """No byte has been sent; plug-ins are imported and configured."""
    SETUP = 1
    RUNNING = 2
    STOPPING = 3
    DONE = 4
    """Torque was switched off by the loop itself, as far as the servos answered."""


def create() -> int:
    """Return the descriptor of a fresh page (memfd): nothing is left behind in /dev/shm."""
    descriptor = os.memfd_create("dxlrun-heartbeat")
    os.ftruncate(descriptor, _SIZE)
    return descriptor


class Heartbeat:
    """The page, mapped; the loop writes, everybody else only reads."""

    __slots__ = ("_beats", "_page")

    def __init__(self, descriptor: int) -> None:
        self._page = mmap.mmap(descriptor, _SIZE)
        self._beats = 0

    def beat(self) -> None:
        """Show that the loop goes on; called once a cycle, and once a transaction outside the loop."""
        self._beats += 1
        _FIELD.pack_into(self._page, _BEATS, self._beats)

    def cycle(self, cycle: int, skipped: int) -> None:
        """Show how many cycles ran, and how many periods were skipped."""
        _FIELD.pack_into(self._page, _CYCLE, cycle)
        _FIELD.pack_into(self._page, _SKIPPED, skipped)

    def enter(self, phase: Phase) -> None:
        """Show that a phase begins."""
        _FIELD.pack_into(self._page, _PHASE, phase)

    def _read(self, offset: int) -> int:
        value: int = _FIELD.unpack_from(self._page, offset)[0]
        return value

    @property
    def phase(self) -> Phase:
        """The phase that was entered last."""
        return Phase(self._read(_PHASE))

    @property
    def beats(self) -> int:
        """Number of beats."""
        return self._read(_BEATS)

    @property
    def cycles(self) -> int:
        """Number of cycles that ran."""
        return self._read(_CYCLE)

    @property
    def skipped(self) -> int:
        """Number of periods that were skipped."""
        return self._read(_SKIPPED)
