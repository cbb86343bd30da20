"""The schedules of a loop, their accounting, and every way in which a loop ends."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.loops import PERIOD_NS, Robot

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.errors import PortError
from dxlrun.plan.loop_plan import ScheduleName


def test_lateness_is_taken_after_the_wake_up(robot):
    robot.build(end_ns=4 * PERIOD_NS)
    late = [0, 300_000, int(1.5 * PERIOD_NS)]
    robot.wake_late(late)
    robot.loop.run()
    assert robot.column("cycle") == [0, 1, 2]
    assert np.subtract(robot.column("woken_ns"), robot.column("scheduled_ns")).tolist() == late
    assert robot.column("period_ns")[1] == PERIOD_NS + 300_000


@pytest.mark.parametrize(
    ("work", "cycles", "skipped", "told"),
    [
        ({1: 1 + 1e-7, 2: 1}, [0, 1, 3, 4], [0, 0, 1, 0], "20.000 ms after its deadline; 1 period skipped"),
        (
            dict.fromkeys(range(9), 1.5),
            [0, 2, 4],
            [0, 1, 1],
            "30.000 ms after its deadline; 1 period skipped",
        ),
    ],
    ids=["a hair", "a row of them"],
)
def test_overruns_skip_periods_and_a_row_of_them_is_told_once(robot, work, cycles, skipped, told):
    result = robot.run(work=work, end_ns=5 * PERIOD_NS)
    assert (robot.column("cycle"), robot.column("skipped")) == (cycles, skipped)
    assert result.cycles + result.skipped in {5, 6}
    (text,) = robot.events.texts(EventCode.OVERRUN)
    assert text.endswith(told)


def test_a_stall_counts_as_five_periods(robot):
    robot.run(work={1: 7.5}, end_ns=12 * PERIOD_NS)
    assert robot.column("period_ns")[:4] == [PERIOD_NS, PERIOD_NS, 5 * PERIOD_NS, PERIOD_NS]


def test_an_end_between_two_deadlines_runs_the_cycles_before_it(robot):
    assert robot.run(end_ns=3 * PERIOD_NS + 1).cycles == 4


def test_the_bus_gets_the_gap_before_each_deadline(robot):
    robot.build(end_ns=3 * PERIOD_NS)
    gaps = []
    robot.hardware.idle = lambda until_ns, time_ns: gaps.append((robot.clock.now_ns(), until_ns, time_ns))
    robot.loop.run()
    assert [until for _, until, _ in gaps] == robot.column("scheduled_ns")
    assert [time for _, _, time in gaps] == [cycle * PERIOD_NS for cycle in range(3)]
    assert all(now < until for now, until, _ in gaps)


def test_a_stop_ends_after_a_whole_cycle(robot):
    result = robot.script("watched").run(3)
    assert (result.reason, result.cycles, result.detail) == ("stopped", 3, "")
    assert len(robot.hardware.written) == 3
    assert [call.step for call in robot.calls] == ["activate", "update", "update", "update", "deactivate"]
    assert robot.events.list[-1][:2] == (EventCode.LOOP_STOPPED, Severity.INFO)


@pytest.mark.parametrize("step", ["read_states", "write_goals", "idle"])
def test_a_lost_port_ends_the_loop_with_a_sentence(robot, step):
    robot.script("idle").build()
    calls = []

    def fail(*_):
        calls.append(step)
        if len(calls) == 3:
            raise PortError("the adapter of bus main is unplugged")

    setattr(robot.hardware, step, fail)
    result = robot.loop.run()
    assert (result.reason, result.cycles) == ("fault", 2)
    assert result.detail == "the adapter of bus main is unplugged"
    assert robot.calls[-1].step == "deactivate"
    assert robot.events.list[-1][:2] == (EventCode.LOOP_STOPPED, Severity.FATAL)


def test_a_fault_while_deactivating_is_a_fault_of_the_run(robot):
    result = robot.script("clinging").run(1, {0: robot.breaks("clinging", "deactivate")})
    assert (result.reason, result.cycles) == ("fault", 1)
    assert "broken" in result.detail


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
