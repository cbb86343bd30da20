"""Schedule: the deadlines of the loop, on a grid that keeps its phase, and what becomes of those that passed.

Cycle n is due at origin + (n - first) * period. A change of the period begins a new grid at a deadline of the
old one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dxlrun.control.loop_plan import OverrunPolicy

MOST_CAUGHT_UP = 5
"""Deadlines that `catch_up` makes up for in a row, what is more is skipped; the guardian waits as long."""


@dataclass(slots=True)
class Schedule:
    """When each cycle is due; times in ns of the loop's clock."""

    period_ns: int
    start_ns: int = 0
    """The first deadline."""
    paused_ns: int = 0
    """For how long the controllers' time stood still."""
    _origin_ns: int = field(default=0, init=False)
    _first: int = field(default=0, init=False)

    def start(self, now_ns: int) -> None:
        """Make the first deadline one period from now."""
        self.start_ns = self._origin_ns = now_ns + self.period_ns
        self._first = 0
        self.paused_ns = 0

    def deadline_ns(self, cycle: int) -> int:
        """Return when a cycle is due."""
        return self._origin_ns + (cycle - self._first) * self.period_ns

    def time_ns(self, now_ns: int) -> int:
        """Return the controllers' time: since the first deadline, pauses left out."""
        return now_ns - self.start_ns - self.paused_ns

    def change(self, cycle: int, period_ns: int) -> None:
        """Let the cycles after `cycle` follow in another period, from its deadline on."""
        self._origin_ns = self.deadline_ns(cycle)
        self._first = cycle
        self.period_ns = period_ns

    def following(self, cycle: int, now_ns: int, policy: OverrunPolicy) -> int:
        """Return the cycle to run after `cycle` that ended at `now_ns`.

        `skip`: the first whose deadline has not passed, so that two cycles never follow each other in a
        burst. `catch_up`: the next one, as long as at most MOST_CAUGHT_UP are due. `stop`: as `skip`.
        """
        passed = now_ns - self._origin_ns
        first = self._first + -(-passed // self.period_ns)
        if policy == "catch_up":
            first -= MOST_CAUGHT_UP
        return max(cycle + 1, first)
