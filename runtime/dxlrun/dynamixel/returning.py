"""Returning: who was lost and comes back goes to its goal slowly, until it has caught up with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_watchdog import RETURN_SPEED
from dxlrun.interfaces import Commands, Floats, States

RETURNED = 0.05
"""rad from the goal: the servo has caught up."""


class Returning:
    """The servos of one bus that catch up with their goals."""

    __slots__ = ("_ceiling", "_rows", "anybody")

    def __init__(self, rows: Sequence[int]) -> None:
        """`rows`: of the servos' joints, in the order of the plan's servos."""
        self._rows = rows
        self._ceiling = np.full(len(rows), np.nan)
        self.anybody: list[int] = []
        """Who they are, by index."""

    def slow_down(self, index: int) -> None:
        """Let a servo go to its goal slowly from now on."""
        if index not in self.anybody:
            self.anybody.append(index)
            self._ceiling[index] = RETURN_SPEED

    def ceiling(self, goals: Commands, states: States, torqued: NDArray[np.bool_]) -> Floats:
        """Return the highest speeds toward positions, rad/s, shape (servos,); NaN: as the goal says."""
        for index in self.anybody[:]:
            row = self._rows[index]
            if torqued[index] and abs(goals.position[row] - states.position[row]) < RETURNED:
                self.anybody.remove(index)
                self._ceiling[index] = np.nan
        return self._ceiling
