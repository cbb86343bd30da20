"""The schedule, its accounting, and every way in which a loop ends."""

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.errors import PortError


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
    assert robot.events.seen[-1][:2] == (EventCode.LOOP_STOPPED, Severity.INFO)


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
    assert robot.events.seen[-1][:2] == (EventCode.LOOP_STOPPED, Severity.FATAL)


def test_a_fault_while_deactivating_is_a_fault_of_the_run(robot):
    result = robot.script("clinging").run(1, {0: robot.breaks("clinging", "deactivate")})
    assert (result.reason, result.cycles) == ("fault", 1)
    assert "broken" in result.detail
