"""Returning: who was lost and comes back goes to its goal slowly, until it has caught up with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.registers.bus_watchdog import RETURN_SPEED
from dxlrun.interfaces import Commands, Floats, States

RETURNED = 0.05
"""rad from the goal: the servo has caught up."""


class Returning:
    """The servos of one bus that catch up with their goals."""

    __slots__ = ("_rows", "anybody", "ceiling")

    def __init__(self, rows: Sequence[int]) -> None:
        """`rows`: of the servos' joints, in the order of the plan's servos."""
        self._rows = rows
        self.ceiling: Floats = np.full(len(rows), np.nan)
        """The highest speeds toward positions, rad/s, shape (servos,); NaN: as the goal says."""
        self.anybody: list[int] = []
        """Who they are, by index."""

    def slow_down(self, index: int) -> None:
        """Let a servo go to its goal slowly from now on."""
        if index not in self.anybody:
            self.anybody.append(index)
            self.ceiling[index] = RETURN_SPEED

    def follow(self, goals: Commands, states: States, torqued: NDArray[np.bool_]) -> None:
        """Let the servos that have caught up go as fast as their goals say."""
        for index in self.anybody[:]:
            row = self._rows[index]
            if torqued[index] and abs(goals.position[row] - states.position[row]) < RETURNED:
                self.anybody.remove(index)
                self.ceiling[index] = np.nan
