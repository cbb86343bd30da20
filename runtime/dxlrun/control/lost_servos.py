"""Lost servos: which joints have not answered for some cycles, judged by the states alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun.hardware import LOST_CYCLES


class LostServos:
    """Counts the replies that each joint missed in a row."""

    __slots__ = ("_missed", "rows")

    def __init__(self, joints: int) -> None:
        self.rows: frozenset[int] = frozenset()
        """Rows of the joints that are lost now: LOST_CYCLES missed replies, and none since."""
        self._missed = np.zeros(joints, dtype=np.int64)

    def look(self, valid: NDArray[np.bool_]) -> bool:
        """Take the states of a cycle, shape (joints,); return whether `rows` is another one now."""
        if np.count_nonzero(valid) == valid.size and not self._missed.any():
            return False
        self._missed += 1
        self._missed[valid] = 0
        rows = frozenset(np.flatnonzero(self._missed >= LOST_CYCLES).tolist())
        changed = rows != self.rows
        self.rows = rows
        return changed
