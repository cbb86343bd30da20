"""The sequential schedule, yardstick of `dxlrun experiment tracking`: its delays add up; a robot's do not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.loops import PERIOD_NS, Robot

from dxlrun.plan.loop_plan import ScheduleName

DELAYS = st.lists(st.just(0) | st.integers(0, 5 * PERIOD_NS), min_size=1, max_size=60)


@dataclass
class Ran:
    """What a loop did whose wake-ups, or whose work, were late by given times."""

    number: np.ndarray
    due_ns: np.ndarray
    woken_ns: np.ndarray
    times_ns: np.ndarray
    """The controllers'."""
    start_ns: int
    """When the first cycle was due."""
    skipped: int

    @property
    def delays_ns(self) -> np.ndarray:
        return self.woken_ns - self.due_ns

    @property
    def behind_ns(self) -> np.ndarray:
        """How long after start + n * T each cycle began."""
        return self.woken_ns - self.start_ns - self.number * PERIOD_NS


def ran(robot: Any, schedule: ScheduleName, periods: int, late: list[int], work: list[int] = ()) -> Ran:
    working = iter(work)
    robot.script("motion").build(end_ns=periods * PERIOD_NS, schedule=schedule)
    robot.hardware.work_ns = lambda: next(working, 0)
    robot.wake_late(late)
    start_ns = robot.clock.now_ns() + PERIOD_NS
    result = robot.loop.run()
    assert result.reason == "ended"
    columns = (robot.column(name) for name in ("cycle", "scheduled_ns", "woken_ns"))
    rows = (np.array(column, np.int64) for column in (*columns, robot.times("motion")))
    return Ran(*rows, start_ns, result.skipped)


@given(late=DELAYS, work=DELAYS)
@settings(deadline=None)
def test_the_sequential_sender_is_behind_by_the_sum_of_its_start_delays(late, work):
    periods = len(late)
    one = ran(Robot(), "sequential", periods, late, work)
    assert one.number.tolist() == list(range(periods))  # no pose is left out
    assert one.times_ns.tolist() == [n * PERIOD_NS for n in range(periods)]  # by number, not by the clock
    assert one.behind_ns.tolist() == np.cumsum(one.delays_ns).tolist()
    if not any(work):
        assert one.delays_ns.tolist() == late


@given(late=DELAYS, work=DELAYS)
@settings(deadline=None)
def test_the_loop_is_behind_by_the_delay_of_that_cycle_alone(late, work):
    periods = len(late)
    one = ran(Robot(), "absolute", periods, late, work)
    assert one.behind_ns.tolist() == one.delays_ns.tolist()
    assert one.times_ns.tolist() == (one.woken_ns - one.start_ns).tolist()
    assert len(one.number) + one.skipped == periods


def test_the_sequential_sender_can_be_paused_and_its_rate_changed(robot):
    """Nothing of the loop goes without: a pause stops the controllers' time, a rate is taken at once."""
    at = {5: robot.asks("pause"), 9: robot.asks("resume"), 13: robot.asks("rate", rate=100.0)}
    robot.script("motion").run(0, at, end_ns=16 * PERIOD_NS, schedule="sequential")
    times = robot.times("motion")
    assert robot.result.reason == "ended"
    assert times[:5] == [n * PERIOD_NS for n in range(5)]
    assert set(np.diff(times)) == {PERIOD_NS, PERIOD_NS // 2}  # the pause of four cycles is left out
    assert times[-1] == 16 * PERIOD_NS - PERIOD_NS // 2
    number, due, woken = (np.array(robot.column(name)) for name in ("cycle", "scheduled_ns", "woken_ns"))
    assert number.tolist() == list(range(len(number)))
    assert set((due[1:] - woken[:-1]).tolist()) == {PERIOD_NS, PERIOD_NS // 2}
