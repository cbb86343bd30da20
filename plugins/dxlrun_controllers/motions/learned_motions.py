"""Learned motions: store of an ilc_controller's corrections, and their binary format between runs."""

from __future__ import annotations

import struct
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_controllers.laws.learning import MOST_DELAY_S, Table

Key = tuple[float, float]
"""Identity of a motion: two numbers from a hash of its trajectory."""

_MOST_KEPT: Final = 1 << 20
"""Upper limit of the serialized motions, bytes; that of `Context.keep`."""
_FORM: Final = 1
"""Version of the binary format."""
_HEAD: Final = struct.Struct("<IqII")
"""Header of the binary format: version, period (ns), number of joints, number of motions."""
_ENTRY: Final = struct.Struct("<ddIIdd")
"""Entry of a motion: key, rows, repetitions, first and smallest error. Delays (f8) and table (f4) follow."""


def motion_name(key: Key) -> str:
    """Return a short name of a motion for messages, from its key."""
    return f"{int(key[0]):012x}"[:8]


class LearnedMotion(msgspec.Struct):
    """A motion with a learned correction, whose table LearnedMotions stores."""

    key: Key
    rows: int
    first: float
    """Error of the repetition without a correction, rad."""
    best: float
    """Smallest error of all repetitions, rad."""
    delay_s: Floats
    """Tracking delay of each joint, s."""
    repetitions: int = 0
    place: int = -1
    """Index of the motion's table in the store; -1 without one."""
    grown: int = 0
    """Number of repetitions in a row whose error was too large."""

    @property
    def name(self) -> str:
        """Short name of the motion for messages."""
        return motion_name(self.key)


class LearnedMotions:
    """Bounded store of motions and the tables of their corrections, allocated by the constructor.

    There is one table more than motions, because the next table is written while the previous one is played.
    """

    def __init__(self, motions: int, rows: int, period_ns: int, most: Floats) -> None:
        """Allocate the tables.

        Args:
            motions: Largest number of motions.
            rows: Rows of the longest motion.
            period_ns: Time between two rows, ns.
            most: Largest correction, rad, shape (joints,).

        Raises:
            ValueError: The motions would exceed the size that can be kept.
        """
        joints = len(most)
        size = _HEAD.size + motions * (_ENTRY.size + joints * (8 + 4 * rows))
        if size > _MOST_KEPT:
            raise ValueError(
                f"{motions} motions of {rows} cycles are {size} bytes, more than {_MOST_KEPT}; "
                "lower `motions` or `longest`"
            )
        self._motions = motions
        self._period_ns = period_ns
        self._most = most
        self._tables: NDArray[np.float32] = np.zeros((motions + 1, joints, rows), np.float32)
        self._free: list[int] = []
        self._known: list[LearnedMotion] = []
        """Motions in the store, the least recently played one first."""
        self.clear_motions()

    def clear_motions(self) -> None:
        """Forget all motions and their tables."""
        self._known = []
        self._free = list(range(len(self._tables)))

    def found(self, key: Key) -> LearnedMotion | None:
        """Return the motion with this key, or None."""
        return next((motion for motion in self._known if motion.key == key), None)

    def mark_played(self, motion: LearnedMotion) -> None:
        """Mark a motion as played most recently; the least recently played one is replaced first."""
        self._known.remove(motion)
        self._known.append(motion)

    def row(self, motion: LearnedMotion, row: int) -> Table:
        """Return the correction of one row, rad, shape (joints,); `row` is clamped to the motion's rows."""
        correction: Table = self._tables[motion.place, :, min(max(row, 0), motion.rows - 1)]
        return correction

    def table(self, motion: LearnedMotion) -> Table | None:
        """Return the correction of a motion, shape (joints, rows), or None if it has none yet."""
        return None if motion.place < 0 else self._tables[motion.place, :, : motion.rows]

    def next_table(self, motion: LearnedMotion) -> Table:
        """Return a free table of the motion's size, for the next correction; `learned` makes it the
        current one.
        """
        return self._tables[self._free[0], :, : motion.rows]

    def learned(self, motion: LearnedMotion) -> LearnedMotion | None:
        """Make the table that was just written the motion's current one.

        A new motion is added to the store. Returns the motion that it replaced, or None.
        """
        forgotten = None
        if motion.place >= 0:
            self._free.append(motion.place)
        else:
            if len(self._known) == self._motions:
                forgotten = self._known[0]
                self.forget_motion(forgotten)
            self._known.append(motion)
        motion.place = self._free.pop(0)
        motion.repetitions += 1
        return forgotten

    def forget_motion(self, motion: LearnedMotion) -> None:
        """Remove a motion from the store and free its table."""
        self._known.remove(motion)
        self._free.append(motion.place)

    def packed(self) -> bytes:
        """Return all motions with their corrections as bytes, which `unpack` reads."""
        parts = [_HEAD.pack(_FORM, self._period_ns, len(self._most), len(self._known))]
        for one in self._known:
            parts.append(_ENTRY.pack(*one.key, one.rows, one.repetitions, one.first, one.best))
            parts.append(one.delay_s.astype("<f8").tobytes())
            parts.append(self._tables[one.place, :, : one.rows].astype("<f4").tobytes())
        return b"".join(parts)

    def unpack(self, data: bytes) -> None:
        """Load the motions from the bytes that `packed` returned. Motions that do not fit are omitted.

        On an error, some motions are loaded already.

        Raises:
            ValueError: Version, period, joints or values do not fit this controller.
            struct.error: The data is truncated.
        """
        form, period_ns, joints, count = _HEAD.unpack_from(data)
        if form != _FORM:
            raise ValueError("they have another version")
        if period_ns != self._period_ns:
            raise ValueError(f"they have a period of {period_ns} ns instead of {self._period_ns} ns")
        if joints != len(self._most):
            raise ValueError(f"they have {joints} joints")
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
                raise ValueError("they have invalid numbers")
            if rows > self._tables.shape[2] or len(self._known) == self._motions:
                continue
            place = self._free.pop(0)
            np.clip(table, -self._most[:, None], self._most[:, None], out=self._tables[place, :, :rows])
            self._known.append(LearnedMotion((low, high), rows, first, best, delay_s, repetitions, place))
