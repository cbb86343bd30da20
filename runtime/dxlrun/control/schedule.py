"""Schedule: deadlines of a loop's cycles and the controllers' time, in ns of the loop's clock.

Robots run with the `absolute` schedule. The `sequential` schedule is that of the library to which the thesis
compares its loop (M. A. Araujo, UFU 2017, equation 2.2). It does not keep time, and serves as the baseline of
`dxlrun experiment tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass

from dxlrun.plan.loop_plan import LoopPlan, OverrunPolicy

MOST_CAUGHT_UP = 5
"""Most missed deadlines that `catch_up` makes up for in a row. The guardian waits for as many periods."""


@dataclass(slots=True)
class Schedule:
    """Deadlines of the loop's cycles, and the controllers' time. Cycles are numbered by period.

    Absolute, t_d[i] = t_0 + i * T: a grid that keeps its phase, even if cycles begin late. Controllers get
    the time of the wake-up.

    Sequential, t_d[i+1] = t[i] + T: a cycle is due one period after the *begin* of the previous one, so
    delays add up. Controllers get the number of the cycle times the period instead of the time of the clock.
    A motion is thus sent pose by pose: no cycle is skipped, and a late end is not noticed.

    A change of `period_ns` applies from the cycle that is due now.
    """

    period_ns: int
    sequential: bool = False
    cycle: int = 0
    due_ns: int = 0
    """Deadline of `cycle`, ns of the clock, if all earlier cycles begin on time."""
    grid_ns: int = 0
    """Controllers' time at the deadline of `cycle`: time since the first deadline, without pauses."""
    time_ns: int = 0
    """Controllers' time in the running cycle: ns since the first deadline, without pauses. It never goes
    back."""

    def start_at(self, now_ns: int) -> None:
        """Reset cycle and controllers' time to 0, and set the first deadline to one period after `now_ns`."""
        self.cycle = self.grid_ns = self.time_ns = 0
        self.due_ns = now_ns + self.period_ns

    def begin_cycle(self, woken_ns: int) -> int:
        """Begin the cycle that is due, and set the controllers' time from its wake-up time.

        Returns:
            Time by which the controllers' time would go back, ns. Positive after a pause that began in a late
            cycle, otherwise at most 0.
        """
        if self.sequential:
            self.due_ns = woken_ns
        time_ns = self.grid_ns + woken_ns - self.due_ns
        behind_ns = self.time_ns - time_ns
        if behind_ns < 0:
            self.time_ns = time_ns
        return behind_ns

    def end_cycles(self, now_ns: int) -> None:
        """Advance the controllers' time to `now_ns`, after the last cycle."""
        passed_ns = 0 if self.sequential else now_ns - self.due_ns
        self.time_ns = max(self.time_ns, self.grid_ns + passed_ns)

    def advance_to_cycle(self, cycle: int) -> None:
        """Make a later cycle the next one, and move the deadline by its periods."""
        passed_ns = (cycle - self.cycle) * self.period_ns
        self.cycle = cycle
        self.due_ns += passed_ns
        self.grid_ns += passed_ns

    def following(self, now_ns: int, policy: OverrunPolicy) -> int:
        """Return the number of the cycle to run next, which may skip periods.

        Args:
            now_ns: End of the current cycle.
            policy: `skip` and `stop` select the first cycle whose deadline has not passed, so that cycles do
                not run in a burst. `catch_up` selects the next cycle, and skips cycles only if more than
                MOST_CAUGHT_UP are due.
        """
        # Floor division of the negative difference rounds up to the first deadline that has not passed.
        first = self.cycle - (self.due_ns - now_ns) // self.period_ns
        if policy == "catch_up":
            first -= MOST_CAUGHT_UP
        return self.cycle + 1 if self.sequential else max(self.cycle + 1, first)


def schedule_of(plan: LoopPlan) -> Schedule:
    """Return a new schedule with the period and kind (absolute or sequential) of a plan."""
    return Schedule(plan.period_ns, plan.schedule == "sequential")
