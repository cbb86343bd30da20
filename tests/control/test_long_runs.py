"""Long runs on an injected clock: the phase, all periods, each controller's own rate, memory."""

import gc
import sys

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.loops import PERIOD_NS, Robot, commanding, idle, on_update

from dxlrun.control.schedule import MOST_CAUGHT_UP
from dxlrun_controllers.group import JointGroupPosVelController
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster
from dxlrun_controllers.motions.joint_trajectory_controller import (
    JointTrajectoryController,
    TrajectoryParameters,
)

pytestmark = pytest.mark.long

RATES = (25.0, 50.0, 100.0, 200.0)
OWN_NS = {"half": 80_000_000, "tenth": 200_000_000}
"""Periods of controllers with rates of their own: 12.5 and 5 Hz divide all of RATES."""


class Grid:
    """The deadlines as arithmetic has them, found again from what the loop says of each cycle."""

    def __init__(self):
        self.period_ns = PERIOD_NS
        self.before = None

    def judge(self, record, policy, paused):
        """Compare one cycle with the one before, and with when that one ended."""
        if self.before is not None:
            cycle, scheduled_ns, written_ns, stood = self.before
            steps = record.cycle - cycle
            assert steps >= 1
            assert record.scheduled_ns == scheduled_ns + steps * self.period_ns, "the phase was lost"
            assert record.skipped == steps - 1
            overdue = max(0, -(-(written_ns - scheduled_ns) // self.period_ns) - 1)  # deadlines that passed
            spared = {MOST_CAUGHT_UP if policy == "catch_up" else 0}
            if stood or paused:
                spared.add(0)  # no sample is late in a pause
            assert record.skipped in {max(0, overdue - most) for most in spared}
        self.before = (record.cycle, record.scheduled_ns, record.written_ns, paused)


@campaign(ci=12_000, night=100_000, release=1_000_000)
@pytest.mark.parametrize("policy", ["skip", "catch_up"])
def test_the_phase_is_kept_exactly_through_overruns_rates_and_pauses(policy, amount, chance):
    robot, last, grid = Robot(joints=3), {}, Grid()
    cycles = int(amount)
    counts = {"cycles": 0, "skipped": 0}

    def judge_period(context, time_ns, period_ns):
        name = context.name
        if name in last:
            nominal = OWN_NS.get(name, robot.loop.schedule.period_ns)
            assert 0 < period_ns == min(time_ns - last[name], 5 * nominal)
        last[name] = time_ns

    look = on_update(judge_period)
    robot.script("each", look, command=()).script("half", look, command=(), every=4, rate=12.5)
    robot.script("tenth", look, command=(), every=10, rate=5.0).build(overrun=policy).keep_nothing()

    def append(record):
        grid.judge(record, policy, robot.loop.steering.paused)
        counts["cycles"] += 1
        counts["skipped"] += record.skipped
        grid.period_ns = robot.loop.schedule.period_ns
        assert record.active == 0b111

    def before(deadline_ns, time_ns):
        dice = chance.random()
        if dice < 0.002:
            robot.ask("rate", rate=chance.choice(RATES))
        elif dice < 0.004:
            robot.ask("resume" if robot.loop.steering.paused else "pause")
        if counts["cycles"] == cycles:
            robot.stop.request()

    robot.sink.append_cycle, robot.hardware.idle = append, before
    robot.hardware.work_ns = lambda: int(chance.expovariate(1 / 3e7)) if chance.random() < 0.05 else 1000
    assert robot.loop.run().cycles == counts["cycles"] == cycles + 1
    assert counts["skipped"] > cycles // 200
    assert grid.before[0] + 1 == counts["cycles"] + counts["skipped"]


def steered():
    """A set-point in each cycle, a switch in every tenth, a pause now and then."""
    robot = Robot().script("a", commanding(position=0.1), joints=("j0",)).script("b", joints=("j1",))

    def before(cycle):
        robot.post("a", "position", b"", 3 * PERIOD_NS)
        if cycle % 10 == 0:
            robot.ask("switch", activate=["b"], deactivate=["b"])
        if cycle % 1000 in (500, 510):
            robot.ask("pause" if cycle % 1000 == 500 else "resume")

    return robot, before


ARM = '{"joints": ["j1", "j2", "j3"]}'


def standard():
    """A broadcaster, a group and a long trajectory."""
    robot = Robot(joints=4, velocity=5.0).add("broadcaster", JointStateBroadcaster, command=(), every=2)
    head, arm = {"joints": ("j0",), "command": ("position", "velocity")}, {"joints": ("j1", "j2", "j3")}
    robot.add("head", JointGroupPosVelController, parameters='{"joints": ["j0"]}', **head)
    robot.add("arm", JointTrajectoryController, parameters=ARM, **arm)
    points = [
        {"time": float(t), "positions": [0.5 * np.sin(t / 9)] * 3, "velocities": [0.1] * 3}
        for t in range(1, 500)
    ]
    command = JointTrajectoryController.Commands["trajectory"].model_validate({"points": points})
    parameters = TrajectoryParameters.model_validate_json(ARM)
    robot.send(0, "arm", "trajectory", *JointTrajectoryController.prepare("trajectory", command, parameters))
    robot.send(PERIOD_NS, "head", "posvel", 0.5, 1.0)
    return robot, idle


@campaign(ci=12_000, night=100_000, release=1_000_000)
@pytest.mark.parametrize("made", [steered, standard])
def test_memory_is_flat_and_nothing_is_collected(made, amount):
    robot, before = made()
    cycles, marks = int(amount), []
    robot.build().keep_nothing()

    def idle_time(deadline_ns, time_ns):
        cycle = robot.record.cycle + 1
        before(cycle)
        if cycle in (1000, cycles - 1):
            marks.append((sys.getallocatedblocks(), sum(one["collections"] for one in gc.get_stats())))
        if cycle == cycles:
            robot.stop.request()

    robot.hardware.idle = idle_time
    gc.collect()
    robot.loop.run()
    (early, collected), (late, collected_late) = marks
    assert collected_late == collected
    assert abs(late - early) < 60
