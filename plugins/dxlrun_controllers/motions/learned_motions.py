"""Learned motions: the corrections of the motions that an ilc_controller remembers, and how they are kept."""

from __future__ import annotations

import struct
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_controllers.laws.learning import MOST_DELAY_S, Table

Key = tuple[float, float]
"""What a motion is known by."""

_MOST_KEPT: Final = 1 << 20
"""Bytes, of `Context.keep`."""
_FORM: Final = 1
_HEAD: Final = struct.Struct("<IqII")
"""Form, period (ns), joints, motions; of each motion:"""
_ENTRY: Final = struct.Struct("<ddIIdd")
"""Key, rows, repetitions, first and smallest error; its delays as float64 and its table as float32 follow."""


def motion_name(key: Key) -> str:
    """Return a short name for people."""
    return f"{int(key[0]):012x}"[:8]


class LearnedMotion(msgspec.Struct):
    """A motion that is remembered."""

    key: Key
    rows: int
    first: float
    """Error without a correction, rad."""
    best: float
    """The smallest one, rad."""
    delay_s: Floats
    repetitions: int = 0
    place: int = -1
    """Of its table; -1: it has none yet."""
    grown: int = 0
    """How many times in a row the error was too large."""

    @property
    def name(self) -> str:
        """A short name for people."""
        return motion_name(self.key)


class LearnedMotions:
    """A bounded number of motions with their tables; all memory is made at once.

    There is one table more than motions: the next one is written while the one before is played.
    """

    def __init__(self, motions: int, rows: int, period_ns: int, most: Floats) -> None:
        """`rows`: of the longest motion; `most`: largest correction, shape (joints,), rad.

        Raises ValueError where that is more than can be kept.
        """
        joints = len(most)
        size = _HEAD.size + motions * (_ENTRY.size + joints * (8 + 4 * rows))
        if size > _MOST_KEPT:
            raise ValueError(
                f"{motions} motions of {rows} cycles are {size} bytes, and {_MOST_KEPT} can be kept; "
                "lower motions or longest"
            )
        self._motions = motions
        self._period_ns = period_ns
        self._most = most
        self._tables: NDArray[np.float32] = np.zeros((motions + 1, joints, rows), np.float32)
        self._free: list[int] = []
        self._known: list[LearnedMotion] = []
        """The one that was played last is the last one."""
        self.clear()

    def clear(self) -> None:
        """Forget all of them."""
        self._known = []
        self._free = list(range(len(self._tables)))

    def found(self, key: Key) -> LearnedMotion | None:
        """Return the motion with this key, if it is remembered."""
        return next((motion for motion in self._known if motion.key == key), None)

    def touch(self, motion: LearnedMotion) -> None:
        """Note that a motion is played: the one for which that is longest ago is forgotten first."""
        self._known.remove(motion)
        self._known.append(motion)

    def row(self, motion: LearnedMotion, row: int) -> Table:
        """Return the correction of a row, shape (joints,), rad; before and behind all rows the nearest."""
        correction: Table = self._tables[motion.place, :, min(max(row, 0), motion.rows - 1)]
        return correction

    def table(self, motion: LearnedMotion) -> Table | None:
        """Return all its rows; None where it has none yet."""
        return None if motion.place < 0 else self._tables[motion.place, :, : motion.rows]

    def next_table(self, motion: LearnedMotion) -> Table:
        """Return where its next table is written, before `learned` puts it in the place of the one before."""
        return self._tables[self._free[0], :, : motion.rows]

    def learned(self, motion: LearnedMotion) -> LearnedMotion | None:
        """Take the next table of a motion; return the motion that was forgotten for it, if one was."""
        forgotten = None
        if motion.place >= 0:
            self._free.append(motion.place)
        else:
            if len(self._known) == self._motions:
                forgotten = self._known[0]
                self.forget(forgotten)
            self._known.append(motion)
        motion.place = self._free.pop(0)
        motion.repetitions += 1
        return forgotten

    def forget(self, motion: LearnedMotion) -> None:
        """Forget a motion."""
        self._known.remove(motion)
        self._free.append(motion.place)

    def packed(self) -> bytes:
        """Return all of them, to be kept."""
        parts = [_HEAD.pack(_FORM, self._period_ns, len(self._most), len(self._known))]
        for one in self._known:
            parts.append(_ENTRY.pack(*one.key, one.rows, one.repetitions, one.first, one.best))
            parts.append(one.delay_s.astype("<f8").tobytes())
            parts.append(self._tables[one.place, :, : one.rows].astype("<f4").tobytes())
        return b"".join(parts)

    def unpack(self, data: bytes) -> None:
        """Take what `packed` returned; what does not fit into `motions` and the longest one is left out.

        Raises ValueError and struct.error for what is not of this controller; then some are taken already.
        """
        form, period_ns, joints, count = _HEAD.unpack_from(data)
        if form != _FORM:
            raise ValueError("it is of another version")
        if period_ns != self._period_ns:
            raise ValueError(f"its period was {period_ns} ns and is {self._period_ns} ns")
        if joints != len(self._most):
            raise ValueError(f"it has {joints} joints")
        at = _HEAD.size
        for _ in range(count):
            low, high, rows, repetitions, first, best = _ENTRY.unpack_from(data, at)
            at += _ENTRY.size
            delay_s = np.frombuffer(data, "<f8", joints, at).copy()
            at += 8 * joints
            table = np.frombuffer(data, "<f4", joints * rows, at).reshape(joints, rows)
            at += 4 * joints * rows
            known = bool(((delay_s >= 0) & (delay_s <= MOST_DELAY_S)).all()) and 0 <= best <= first
            if not known or not rows or not np.isfinite(table).all():
                raise ValueError("its numbers are none that are learned")
            if rows > self._tables.shape[2] or len(self._known) == self._motions:
                continue
            place = self._free.pop(0)
            np.clip(table, -self._most[:, None], self._most[:, None], out=self._tables[place, :, :rows])
            self._known.append(LearnedMotion((low, high), rows, first, best, delay_s, repetitions, place))
