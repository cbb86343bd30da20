"""When the cycles of a loop are due, and what the controllers' time is then; times in ns of the loop's clock.

`absolute` is how robots run. `sequential` is how the library did it that the thesis compares its loop with
(M. A. Araujo, UFU 2017, equation 2.2): it keeps no time, and exists as the yardstick of
`dxlrun experiment tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dxlrun.plan.loop_plan import LoopPlan, OverrunPolicy

MOST_CAUGHT_UP = 5
"""Deadlines that `catch_up` makes up for in a row, what is more is skipped; the guardian waits as long."""


@dataclass(slots=True)
class Schedule:
    """t_d[i] = t_0 + i * T: a grid that keeps its phase, however late a cycle begins.

    Cycle n is due at origin + (n - first) * period, and controllers see the time of its wake-up. A change of
    the period begins a new grid at a deadline of the old one.
    """

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

    def begin(self, cycle: int, woken_ns: int) -> int:
        """Begin a cycle; return the controllers' time in it. A late one moves no deadline."""
        return woken_ns - self.start_ns - self.paused_ns

    def time_ns(self, cycle: int, now_ns: int) -> int:
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


@dataclass(slots=True)
class SequentialSchedule(Schedule):
    """t_d[i+1] = t[i] + T: a cycle is due one period after the one before it *began*, so delays add up.

    Controllers see the number of the cycle times the period, whatever the clock says, so a motion is sent
    pose after pose, by number. No cycle is left out; a late end goes unnoticed.
    """

    _begun: int = field(default=-1, init=False)
    """The cycle that began last, and when; before the first, one period before its deadline."""
    _begun_ns: int = field(default=0, init=False)
    _first_time_ns: int = field(default=0, init=False)
    """The controllers' time in `_first`, the cycle from which the period holds."""

    def start(self, now_ns: int) -> None:
        """Make the first deadline one period from now."""
        self.start_ns = now_ns + self.period_ns
        self._begun, self._begun_ns = -1, now_ns
        self._first = self._first_time_ns = 0
        self.paused_ns = 0

    def deadline_ns(self, cycle: int) -> int:
        """Return when a cycle is due, if all between begin on time."""
        return self._begun_ns + (cycle - self._begun) * self.period_ns

    def begin(self, cycle: int, woken_ns: int) -> int:
        """Count the next deadline from here; return the controllers' time."""
        self._begun, self._begun_ns = cycle, woken_ns
        return self.time_ns(cycle, woken_ns)

    def time_ns(self, cycle: int, now_ns: int) -> int:
        """Return the controllers' time: as many periods as cycles, pauses left out."""
        return self._first_time_ns + (cycle - self._first) * self.period_ns - self.paused_ns

    def change(self, cycle: int, period_ns: int) -> None:
        """Let the cycles after `cycle` follow in another period."""
        self._first_time_ns += (cycle - self._first) * self.period_ns
        self._first = cycle
        self.period_ns = period_ns

    def following(self, cycle: int, now_ns: int, policy: OverrunPolicy) -> int:
        """Return the next one: no pose is left out."""
        return cycle + 1


def schedule_of(plan: LoopPlan) -> Schedule:
    """Return the schedule that a plan has."""
    kind = SequentialSchedule if plan.schedule == "sequential" else Schedule
    return kind(plan.period_ns)
