"""The schedule, its accounting, and every way in which a loop ends."""

import gc
import random
import sys

import numpy as np
import pytest

from dxlrun.channels.events import EventCode, Severity
from dxlrun.errors import PortError

PERIOD_NS = 20_000_000


def idle(self, step, time_ns, _):
    pass


def test_the_phase_stays_and_every_period_is_accounted_for(robot):
    """100,000 periods with random overruns: what ran plus what was skipped is what passed."""
    periods = 100_000
    chance = random.Random(7)
    robot.script("idle", idle, joints=("j0",), command=())
    robot.build(end_ns=periods * PERIOD_NS)
    robot.hardware.keep = False
    seen = []
    robot.sink.append = lambda record: seen.append(
        (record.cycle, record.scheduled_ns, record.woken_ns, record.skipped, record.period_ns)
    )
    robot.hardware.work_ns = lambda: int(chance.expovariate(1 / PERIOD_NS)) if chance.random() < 0.2 else 1000
    start_ns = robot.clock.now_ns() + PERIOD_NS
    result = robot.loop.run()
    rows = np.array(seen)
    cycle, scheduled, woken, skipped, period = rows.T
    assert result.reason == "ended"
    assert result.cycles == len(rows) == robot.beats
    assert result.cycles + result.skipped == periods
    assert result.skipped > 5_000
    np.testing.assert_array_equal(scheduled, start_ns + cycle * PERIOD_NS)
    np.testing.assert_array_equal(skipped[1:], np.diff(cycle) - 1)
    np.testing.assert_array_equal(woken, scheduled)  # virtual time wakes nobody late
    assert np.diff(woken).min() >= PERIOD_NS  # never a burst
    np.testing.assert_array_equal(period[1:], np.minimum(np.diff(woken), 5 * PERIOD_NS))


def test_lateness_is_taken_after_the_wake_up(robot):
    robot.build(end_ns=4 * PERIOD_NS)
    wait = robot.clock.wait_until
    late = iter([0, 300_000, int(1.5 * PERIOD_NS), 0])

    class LateClock:
        now_ns = robot.clock.now_ns

        def wait_until(self, deadline_ns):
            return wait(deadline_ns + next(late))

    robot.loop.clock = LateClock()
    robot.loop.run()
    assert [cycle["cycle"] for cycle in robot.sink.cycles] == [0, 1, 2]
    lateness = [cycle["woken_ns"] - cycle["scheduled_ns"] for cycle in robot.sink.cycles]
    assert lateness == [0, 300_000, int(1.5 * PERIOD_NS)]
    assert robot.sink.cycles[1]["period_ns"] == PERIOD_NS + 300_000


def test_an_overrun_of_a_hair_skips_one_period(robot):
    robot.build(end_ns=5 * PERIOD_NS)
    work = iter([0, PERIOD_NS + 1, PERIOD_NS])
    robot.hardware.work_ns = lambda: next(work, 0)
    result = robot.loop.run()
    assert [cycle["cycle"] for cycle in robot.sink.cycles] == [0, 1, 3, 4]
    assert [cycle["skipped"] for cycle in robot.sink.cycles] == [0, 0, 1, 0]
    assert (result.cycles, result.skipped) == (4, 1)
    ((_, text),) = robot.events.of(EventCode.OVERRUN)
    assert text == "cycle 1 ended 20.000 ms after its deadline; 1 period skipped"


def test_a_row_of_overruns_is_told_once(robot):
    robot.build(end_ns=20 * PERIOD_NS)
    robot.hardware.work_ns = lambda: int(1.5 * PERIOD_NS)
    result = robot.loop.run()
    assert (result.cycles, result.skipped) == (10, 10)
    assert len(robot.events.of(EventCode.OVERRUN)) == 1


def test_an_end_between_two_deadlines_runs_the_cycles_before_it(robot):
    robot.build(end_ns=3 * PERIOD_NS + 1)
    assert robot.loop.run().cycles == 4


def test_the_bus_gets_the_gap_before_each_deadline(robot):
    robot.build(end_ns=3 * PERIOD_NS)
    gaps = []
    robot.hardware.idle = lambda until_ns: gaps.append((robot.clock.now_ns(), until_ns))
    robot.loop.run()
    assert [until for _, until in gaps] == [cycle["scheduled_ns"] for cycle in robot.sink.cycles]
    assert all(now < until for now, until in gaps)


def test_a_stop_ends_after_a_whole_cycle(robot):
    told = []

    def act(self, step, time_ns, _):
        told.append(step)
        if step == "update" and time_ns == 2 * PERIOD_NS:
            robot.stop.request()

    robot.script("stopper", act)
    robot.build()
    result = robot.loop.run()
    assert (result.reason, result.cycles, result.detail) == ("stopped", 3, "")
    assert len(robot.hardware.written) == 3
    assert told == ["activate", "update", "update", "update", "deactivate"]
    assert robot.events.seen[-1][:2] == (EventCode.LOOP_STOPPED, Severity.INFO)


@pytest.mark.parametrize("step", ["read", "write", "idle"])
def test_a_lost_port_ends_the_loop_with_a_sentence(robot, step):
    told = []
    robot.script("idle", lambda self, step, *_: told.append(step))
    robot.build()
    calls = []

    def fail(*_):
        calls.append(step)
        if len(calls) == 3:
            raise PortError("the adapter of bus main is gone")

    setattr(robot.hardware, step, fail)
    result = robot.loop.run()
    assert (result.reason, result.cycles) == ("fault", 2)
    assert result.detail == "the adapter of bus main is gone"
    assert told[-1] == "deactivate"
    assert robot.events.seen[-1][:2] == (EventCode.LOOP_STOPPED, Severity.FATAL)


def test_a_fault_while_deactivating_is_a_fault_of_the_run(robot):
    def act(self, step, time_ns, _):
        if step == "deactivate":
            raise RuntimeError("cannot let go")

    robot.script("clinging", act)
    robot.build(end_ns=PERIOD_NS)
    result = robot.loop.run()
    assert (result.reason, result.cycles) == ("fault", 1)
    assert "cannot let go" in result.detail


def test_the_loop_makes_no_garbage_and_no_growth(make_robot):
    """20,000 cycles of the standard controllers: nothing is collected, nothing piles up."""
    from dxlrun_controllers.group import JointGroupPosVelController
    from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster
    from dxlrun_controllers.motions.joint_trajectory_controller import (
        JointTrajectoryController,
        TrajectoryParameters,
    )

    robot = make_robot(joints=4, velocity=5.0)
    robot.add("broadcaster", JointStateBroadcaster, command=(), every=2)
    robot.add("head", JointGroupPosVelController, joints=("j0",), parameters='{"joints": ["j0"]}')
    robot.add(
        "arm", JointTrajectoryController, joints=("j1", "j2", "j3"), command=("position",), parameters=ARM
    )
    points = [
        {"time": float(t), "positions": [0.5 * np.sin(t / 9)] * 3, "velocities": [0.1] * 3}
        for t in range(1, 500)
    ]
    command = JointTrajectoryController.Commands["trajectory"].model_validate({"points": points})
    parameters = TrajectoryParameters.model_validate_json(ARM)
    robot.send(0, "arm", "trajectory", *JointTrajectoryController.prepare("trajectory", command, parameters))
    robot.send(PERIOD_NS, "head", "posvel", 0.5, 1.0)
    robot.build(end_ns=20_000 * PERIOD_NS)
    robot.hardware.keep = robot.sink.keep = False
    marks = []

    def beat():
        robot.beats += 1
        if robot.beats in (2_000, 20_000):
            marks.append((sys.getallocatedblocks(), sum(one["collections"] for one in gc.get_stats())))

    robot.loop.beat = beat
    gc.collect()
    assert robot.loop.run().cycles == 20_000
    (early, collected), (late, collected_late) = marks
    assert collected_late == collected
    assert abs(late - early) < 50  # blocks of memory, in 18,000 cycles
    assert len(robot.events.of(EventCode.GATE)) == 1  # the head's jump in the first, slow second


ARM = '{"joints": ["j1", "j2", "j3"]}'
