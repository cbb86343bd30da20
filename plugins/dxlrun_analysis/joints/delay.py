"""The delay with which a joint follows the goals as they were sent.

Of 24 delays up to 0.3 s, of 24 cycles where those take longer, the one with the least mean square difference
between position and goal, refined by a parabola through it and its neighbours: to about a tenth of the step
between two of them, 12.5 ms or a cycle. There is none where the goals hardly moved, where it is beyond the
longest, or where it leaves more than a quarter of the worst one's mean square: the joint did not follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from dxlrun import Floats

_LONGEST_S = 0.3
_DELAYS = 24
_EXPLAINED = 0.25


@dataclass(slots=True)
class DelayFit:
    """Mean square differences between positions and goals that were sent earlier, by delay."""

    step: int = 0  # Cycles from one delay to the next
    period_s: float = 0.0
    squares: Floats = field(default_factory=lambda: np.zeros(_DELAYS))
    counts: Floats = field(default_factory=lambda: np.zeros(_DELAYS))
    goals: Floats = field(default_factory=lambda: np.zeros(0))  # The newest, as far back as delays go
    lowest: float = math.inf
    highest: float = -math.inf

    def take(self, times: Floats, goal: Floats, position: Floats, known: int) -> None:
        """Take cycles; the first `known` of them were taken before."""
        if not self.step:
            self.period_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
            self.step = max(1, round(_LONGEST_S / max(self.period_s, 1e-6) / _DELAYS))
        goals = np.concatenate([self.goals, goal[known:]])
        position = position[known:]
        before = len(self.goals)
        finite = goal[known:][np.isfinite(goal[known:])]
        if len(finite):
            self.lowest, self.highest = min(self.lowest, finite.min()), max(self.highest, finite.max())
        for index in range(_DELAYS):
            back = index * self.step + 1  # a goal reaches the servo behind the cycle's read
            first = max(0, back - before)
            if first >= len(position):
                continue
            difference = position[first:] - goals[before + first - back : len(goals) - back]
            difference = difference[np.isfinite(difference)]
            self.squares[index] += np.square(difference).sum()  # a product would start threads
            self.counts[index] += len(difference)
        self.goals = goals[-_DELAYS * self.step - 1 :]

    def best_s(self, least: float) -> float | None:
        """Return the delay that fits best, s; None where none does, see the module."""
        if self.highest - self.lowest < least or not self.counts.all():
            return None
        mean = self.squares / self.counts
        best = int(np.argmin(mean))
        if best == _DELAYS - 1 or mean[best] > _EXPLAINED * mean.max():
            return None
        offset = 0.0
        if best:
            left, middle, right = mean[best - 1 : best + 2]
            bend = left - 2 * middle + right
            offset = 0.5 * float(left - right) / float(bend) if bend > 0 else 0.0
        return ((best + offset) * self.step + 1) * self.period_s
