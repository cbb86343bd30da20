"""The loop's wishes to the operating system, and how fast the buses let it become."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.compile.checks.problems import Problems
from dxlrun.control.loop_plan import MOST_SHARE, SchedulerPlan
from dxlrun.description import Description
from dxlrun.description.robot import Loop
from dxlrun.dynamixel.plan.bus_plan import BusPlan

_HIGHEST = 98
"""The guardian needs one priority above the loop, and 99 is the highest there is (sched(7))."""


def check_scheduler(description: Description, problems: Problems) -> None:
    """Find wishes that contradict each other; whether this machine grants them is seen at the start."""
    loop, marks = description.robot.loop, description.marks
    wish, timeout_ns = loop.scheduler, description.robot.policies.exit_timeout
    if 1e9 / loop.rate >= timeout_ns:
        problems.warning(
            marks.value("loop", "rate"),
            f"at {loop.rate:g} Hz a wish to stop is seen up to {1 / loop.rate:.3g} s late, when the guardian "
            f"has ended the loop, as exit_timeout is {timeout_ns * 1e-9:g} s",
            "raise policies.exit_timeout, or the rate",
        )
    if wish.policy != "other" and wish.priority > _HIGHEST:
        problems.warning(
            marks.value("loop", "scheduler", "priority"),
            f"priority {wish.priority} leaves none above it for the guardian",
            f"write {_HIGHEST} at most",
        )
    if wish.polling != "auto" and wish.polling * MOST_SHARE > round(1e9 / loop.rate):
        problems.error(
            marks.value("loop", "scheduler", "polling"),
            f"polling {wish.polling / 1e6:g} ms is more than half of the period, {1e3 / loop.rate:.3g} ms",
            "write less, or auto",
        )


def scheduler_plan(loop: Loop) -> SchedulerPlan:
    """Return the wishes as the loop's process reads them."""
    wish = loop.scheduler
    return SchedulerPlan(
        policy=wish.policy,
        priority=wish.priority,
        lock_memory=wish.lock_memory,
        cores=wish.cores or (),
        polling_ns=None if wish.polling == "auto" else wish.polling,
        reply_polling_ns=None if wish.reply_polling == "auto" else wish.reply_polling,
        idle_latency=wish.idle_latency,
    )


def least_period_ns(loop: Loop, buses: Sequence[BusPlan]) -> int:
    """Return the shortest period that the slowest bus allows, ns: the buses talk at the same time.

    Never more than the file's own period, which was checked by the same budget.
    """
    slowest = max((bus.budget.total_ns for bus in buses), default=0)
    return min(slowest, round(1e9 / loop.rate))
