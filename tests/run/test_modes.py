"""A run on Protocol 1.0 whose controllers change the modes of its servos, judged by the ledger."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.stories import Clients, send, switch
from tests.kit.wire import BROADCAST, SYNC_WRITE, WRITE, instructions, writes

from dxlrun.channels.answers import Completion
from dxlrun.testing import VirtualRobot, read_log, simulated_robot
from dxlwire.modes import Mode

ROBOT = """\
name: cart
buses:
  wheels: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {latency: 1 ms}}
  arm: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  left: {bus: wheels, id: 1, model: AX-12A, reference: 150 deg, direction: 1, continuous: true}
  right: {bus: wheels, id: 2, model: AX-12A, reference: 150 deg, direction: -1, continuous: true}
  lift: {bus: arm, id: 1, model: MX-64, reference: 180 deg, direction: 1}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [left, right]}
  power: {type: joint_group_pwm_controller, joints: [left, right], active: false}
  lift: {type: joint_group_position_controller, joints: [lift]}
  push: {type: joint_group_effort_controller, joints: [lift], active: false}
  spin: {type: joint_group_velocity_controller, joints: [lift], active: false}
"""
LIFT = 2
TORQUE_ENABLE, CW_LIMIT, CCW_LIMIT, TORQUE_MODE = 24, 6, 8, 70


STORY = {
    5: [send("drive", "velocities", 2.0, 2.0), send("lift", "positions", 0.3)],
    60: [switch(["push"], ["lift"]), switch(["power"], ["drive"])],
    80: [send("push", "efforts", 0.02), send("power", "pwm", 0.2, -0.2)],
    90: [switch(["spin"], ["push"])],
    100: [send("spin", "velocities", 0.5)],
    130: [switch(["lift"], ["spin"])],
}


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("modes")
    (folder / "cart.yaml").write_text(ROBOT)
    robot = simulated_robot(folder / "cart.yaml", log=folder / "run.mcap", duration_s=4.0)
    inbox = Clients(robot, STORY)
    result = robot.run()
    assert (result.reason, result.detail, result.skipped) == ("ended", "", 0)
    answers = inbox.answers.values()
    assert all(isinstance(answer, Completion) for answer in answers), answers
    return robot, read_log(folder / "run.mcap")


def said_to(robot: VirtualRobot, bus: str, servo_id: int) -> list[tuple[int, int, bytes]]:
    """Return what was written to a servo: instruction, first address, data."""
    plan = next(one for one in robot.plan.buses if one.name == bus)
    return [
        (sent.instruction, address, data)
        for sent in instructions([one for one in robot.ledger.entries if one.bus == bus], plan)
        for one, address, data in writes(sent, 1.0)
        if one in {servo_id, BROADCAST}
    ]


@pytest.mark.parametrize(("bus", "servo_id"), [("wheels", 1), ("wheels", 2), ("arm", 1)])
def test_what_selects_a_mode_is_written_without_torque_and_no_goal_comes_meanwhile(ran, bus, servo_id):
    torque, changed = 0, 0
    for instruction, address, data in said_to(ran[0], bus, servo_id):
        if instruction == WRITE and address == TORQUE_ENABLE:
            torque = data[0]
        elif instruction == WRITE and address in {CW_LIMIT, CCW_LIMIT, TORQUE_MODE}:
            assert torque == 0
            changed += 1
        elif instruction == SYNC_WRITE:
            assert torque == 1
    assert changed > 0
    assert torque == 0, "the run ended with torque on"


def test_each_mode_is_followed_on_the_wire_by_its_own_goals(ran):
    lift = [address for instruction, address, _ in said_to(ran[0], "arm", 1) if instruction == SYNC_WRITE]
    blocks = [address for before, address in zip([0, *lift], lift, strict=False) if address != before]
    assert blocks == [30, 71, 32, 30]
    wheels = [
        address for instruction, address, _ in said_to(ran[0], "wheels", 1) if instruction == SYNC_WRITE
    ]
    assert set(wheels) == {32}


def test_the_log_has_the_modes_and_the_joints_follow(ran):
    cycles = ran[1].cycles
    modes = cycles["mode"][:, LIFT]
    changes = [mode for mode in modes[np.flatnonzero(np.diff(modes, prepend=0))].tolist() if mode]
    assert changes == [Mode.POSITION, Mode.EFFORT, Mode.VELOCITY, Mode.POSITION]
    assert cycles["velocity"][55, :2] == pytest.approx([2.0, 2.0], rel=0.1)
    assert cycles["velocity"][120, LIFT] == pytest.approx(0.5, rel=0.1)
    assert set(cycles["mode"][[10, 100], 0].tolist()) == {Mode.VELOCITY, Mode.PWM}
    assert cycles["velocity"][128, :2] == pytest.approx([0.2 * 6.178, -0.2 * 6.178], rel=0.1)
