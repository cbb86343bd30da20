"""Deadlines: the waits of the control loop without a robot, for programs that measure this machine."""

from __future__ import annotations

from dxlrun.control.realtime_grants import Grant, Pacing
from dxlrun.control.schedule import Schedule
from dxlwire.clock import Clock, MonotonicClock


class Deadlines:
    """Periodic deadlines with the clock and schedule of the control loop.

    Deadlines that passed before `wait_for_deadline` was called are skipped, as in a run with `overrun: skip`.
    The first deadline is one period after the first call of `wait_for_deadline`.

    Args:
        period_ns: Period.
        clock: Replaces the machine's clock in tests.
    """

    def __init__(self, period_ns: int, clock: Clock | None = None) -> None:
        self._machine = MonotonicClock()
        self._clock = clock or self._machine
        self._schedule = Schedule(period_ns)
        self._started = False

    def measure_margin(self, most_ns: int | None) -> Grant:
        """Measure how late sleeps wake on this machine, and set the polling time before each deadline.

        Args:
            most_ns: Longest time, as `SchedulerPlan.polling_ns`; None: a share of the period.
        """
        return Pacing(self._machine, most_ns).measure_margin(self._schedule.period_ns, lambda: None)

    @property
    def margin_ns(self) -> int:
        """Time before a deadline for which the clock is polled instead of sleeping, ns."""
        return self._machine.spin_ns

    def wait_for_deadline(self) -> tuple[int, int]:
        """Wait until the next deadline; return that deadline and the wake-up time, ns of the clock."""
        schedule, clock = self._schedule, self._clock
        if self._started:
            schedule.advance_to_cycle(schedule.following(clock.now_ns(), "skip"))
        else:
            schedule.start_at(clock.now_ns())
            self._started = True
        deadline_ns = schedule.due_ns
        return deadline_ns, clock.wait_until(deadline_ns)
