"""Delay between the goals sent to a joint and its measured position, by least squares.

Of 24 delays up to 0.3 s (up to 24 cycles if those take longer), the fit chooses the one with the least mean
square difference between position and goal. A parabola through this delay and its neighbours refines it to
about a tenth of the step between two delays, 12.5 ms or a cycle. The fit has no result if the goals hardly
moved, if the best delay is the longest, or if the remaining mean square is more than a quarter of the worst
one: the joint did not follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from dxlrun import Floats

_LONGEST_S = 0.3  # Longest delay of the search, or 24 cycles if those take longer
_DELAYS = 24
_EXPLAINED = 0.25  # Largest remaining share of the worst mean square


@dataclass(slots=True)
class DelayFit:
    """Accumulator that fits one joint's delay: sums of squared differences between its positions and
    earlier goals, for each of 24 delays."""

    step: int = 0  # Cycles between consecutive delays
    period_s: float = 0.0
    squares: Floats = field(default_factory=lambda: np.zeros(_DELAYS))
    counts: Floats = field(default_factory=lambda: np.zeros(_DELAYS))
    # Newest goals, as far back as the longest delay.
    goals: Floats = field(default_factory=lambda: np.zeros(0))
    lowest: float = math.inf
    highest: float = -math.inf

    def add_cycles(self, times: Floats, goal: Floats, position: Floats, known: int) -> None:
        """Add the cycles from number `known` on; the first `known` were already added.

        Args:
            times: Times of the cycles, s; shape (cycles,).
            goal: Goals sent to the joint, rad; NaN without one.
            position: Measured positions, rad; NaN if not read.
            known: Number of cycles that were added before.
        """
        if not self.step:
            self.period_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
            self.step = max(1, round(_LONGEST_S / max(self.period_s, 1e-6) / _DELAYS))
        goals = np.concatenate([self.goals, goal[known:]])
        position = position[known:]
        before = len(self.goals)
        finite = goal[known:][np.isfinite(goal[known:])]
        if len(finite):
            self.lowest, self.highest = min(self.lowest, finite.min()), max(self.highest, finite.max())
        whole = len(finite) == len(position) and bool(np.isfinite(self.goals).all())
        whole = whole and bool(np.isfinite(position).all())
        constant = whole and before > (_DELAYS - 1) * self.step and bool((goals == goals[0]).all())
        squares, count = 0.0, 0
        for index in range(_DELAYS):
            back = index * self.step + 1  # A goal reaches the servo after the read of its cycle
            first = max(0, back - before)
            if first >= len(position):
                continue
            if not (constant and index):  # A constant goal differs equally at each delay
                difference = position[first:] - goals[before + first - back : len(goals) - back]
                if not whole:
                    difference = difference[np.isfinite(difference)]
                squares = np.square(difference).sum()  # A matrix product would start BLAS threads
                count = len(difference)
            self.squares[index] += squares
            self.counts[index] += count
        self.goals = goals[-_DELAYS * self.step - 1 :]

    def best_s(self, least: float) -> float | None:
        """Return the best delay in s, or None if no delay fits; the module docstring has the conditions.

        Args:
            least: Smallest range of goals for which a delay is determined, rad.
        """
        if self.highest - self.lowest < least or not self.counts.all():
            return None
        mean = self.squares / self.counts
        best = int(np.argmin(mean))
        if best == _DELAYS - 1 or mean[best] > _EXPLAINED * mean.max():
            return None
        offset = 0.0
        if best:
            # The vertex of the parabola refines the delay.
            left, middle, right = mean[best - 1 : best + 2]
            bend = left - 2 * middle + right
            offset = 0.5 * float(left - right) / float(bend) if bend > 0 else 0.0
        return ((best + offset) * self.step + 1) * self.period_s
