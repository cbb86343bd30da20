"""When the cycles of a loop are due, and what the controllers' time is then; times in ns of the loop's clock.

`absolute` is how robots run. `sequential` is how the library did it that the thesis compares its loop with
(M. A. Araujo, UFU 2017, equation 2.2): it keeps no time, and exists as the yardstick of
`dxlrun experiment tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass

from dxlrun.plan.loop_plan import LoopPlan, OverrunPolicy

MOST_CAUGHT_UP = 5
"""Deadlines that `catch_up` makes up for in a row, what is more is skipped; the guardian waits as long."""


@dataclass(slots=True)
class Schedule:
    """When the next cycle is due, and the controllers' time then; a cycle is numbered by its period.

    Absolute, t_d[i] = t_0 + i * T: a grid that keeps its phase, however late a cycle begins; controllers see
    the time of the wake-up. Sequential, t_d[i+1] = t[i] + T: a cycle is due one period after the one before
    it *began*, so delays add up; controllers see the number of the cycle times the period, whatever the clock
    says, so a motion is sent pose after pose, by number: no cycle is left out, a late end goes unnoticed.
    A change of `period_ns` counts from the cycle on that is due now.
    """

    period_ns: int
    sequential: bool = False
    cycle: int = 0
    due_ns: int = 0
    """When `cycle` is due, if all before it begin on time."""
    grid_ns: int = 0
    """The controllers' time in `cycle`, if that begins on time: since the first deadline, pauses left out."""
    time_ns: int = 0
    """The controllers' time in the cycle that runs; it never goes back."""

    def start(self, now_ns: int) -> None:
        """Make the first deadline one period from now."""
        self.cycle = self.grid_ns = self.time_ns = 0
        self.due_ns = now_ns + self.period_ns

    def begin_cycle(self, woken_ns: int) -> int:
        """Begin the cycle that is due; return by how much its time would go back.

        That is more than 0 after a pause that a cycle began late.
        """
        if self.sequential:
            self.due_ns = woken_ns
        time_ns = self.grid_ns + woken_ns - self.due_ns
        behind_ns = self.time_ns - time_ns
        if behind_ns < 0:
            self.time_ns = time_ns
        return behind_ns

    def end_cycles(self, now_ns: int) -> None:
        """Let the controllers' time pass until now, after the last cycle."""
        passed_ns = 0 if self.sequential else now_ns - self.due_ns
        self.time_ns = max(self.time_ns, self.grid_ns + passed_ns)

    def advance(self, cycle: int) -> None:
        """Go to a later cycle."""
        passed_ns = (cycle - self.cycle) * self.period_ns
        self.cycle = cycle
        self.due_ns += passed_ns
        self.grid_ns += passed_ns

    def following(self, now_ns: int, policy: OverrunPolicy) -> int:
        """Return the cycle to run after the one that ended now.

        `skip`: the first whose deadline has not passed, so that two cycles never follow each other in a
        burst. `catch_up`: the next one, as long as at most MOST_CAUGHT_UP are due. `stop`: as `skip`.
        """
        first = self.cycle - (self.due_ns - now_ns) // self.period_ns
        if policy == "catch_up":
            first -= MOST_CAUGHT_UP
        return self.cycle + 1 if self.sequential else max(self.cycle + 1, first)


def schedule_of(plan: LoopPlan) -> Schedule:
    """Return the schedule that a plan has."""
    return Schedule(plan.period_ns, plan.schedule == "sequential")
