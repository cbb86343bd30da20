"""Long runs on an injected clock: memory stays flat, and nothing is collected."""

import gc
import sys

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.loops import PERIOD_NS, Robot, commanding, idle

from dxlrun_controllers.group import JointGroupPosVelController
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster
from dxlrun_controllers.motions.joint_trajectory_controller import (
    JointTrajectoryController,
    TrajectoryParameters,
)

pytestmark = pytest.mark.long


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
