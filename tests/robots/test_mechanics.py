"""robots/mechanics.yaml: what its joints do when servos stall, lose power, or are mounted wrongly."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand

from dxlrun.channels.answers import Completion, Refusal
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.compile.simulation import simulation_of
from dxlrun.errors import DxlrunError
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.robot_plan import Plan
from dxlrun.run import virtual_run
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_analysis.replay import replay_log
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
ROBOT, MOTION = ROBOTS / "mechanics.yaml", ROBOTS / "motions" / "mechanics_reach.yaml"


def plan_of(seconds: float, **arguments: str) -> Plan:
    return compile_files(ROBOT, arguments, [MOTION], round(seconds * 1e9)).plan


def ran(robot: VirtualRobot, log: Path, *faults: str) -> Log:
    FaultScript([parse_fault(fault) for fault in faults]).attach(robot.buses)
    assert robot.run().reason == "ended"
    return read_log(log)


def disagreements(log: Log) -> list[str]:
    return [event.text for event in log.events if event.code == EventCode.SERVOS_DISAGREE]


def request(robot: VirtualRobot, at_ms: int, number: int, kind: str, **data: object) -> None:
    command = CommandMessage(number, "", kind, json.dumps(data).encode(), "anna")
    robot.buses[0].at(at_ms * 1_000_000, lambda: robot.inbox.waiting.append(command))


@pytest.mark.parametrize("physics", ["independent", "mujoco"])
def test_it_is_where_the_motion_wants_it_and_its_replay_is_equal(physics, tmp_path):
    if physics == "mujoco":
        pytest.importorskip("mujoco")
    path = tmp_path / "run.mcap"
    log = ran(VirtualRobot(plan_of(2.2, physics=physics), log=path), path)
    assert disagreements(log) == []
    cycles, joints = log.cycles, log.joints
    at = np.searchsorted(cycles["read_ns"] - cycles["read_ns"][0], 2_100_000_000)
    for joint, degrees in (("hip", 30), ("knee", -40), ("wrist_pitch", 20), ("wrist_roll", 45)):
        off = abs(cycles["position"][at, joints.index(joint)] - math.radians(degrees))
        assert off < math.radians(4), joint
    assert cycles["position"][140, joints.index("gripper")] == pytest.approx(0.020, abs=0.001)
    assert replay_log(path).same


def test_a_servo_that_is_blocked_disagrees_with_its_partner(tmp_path):
    path = tmp_path / "run.mcap"
    log = ran(VirtualRobot(plan_of(2.0), log=path), path, "jam servo=2 at=1s")
    (first, *_) = disagreements(log)
    assert "the servos of hip disagree by " in first
    assert "ID 1 on bus main" in first
    assert "ID 2 on bus main" in first


def test_a_servo_without_power_is_dragged_along_and_agrees(tmp_path):
    path = tmp_path / "run.mcap"
    log = ran(VirtualRobot(plan_of(1.6), log=path), path, "silence servo=2 at=1s")
    assert disagreements(log) == []
    row = log.joints.index("hip")
    assert not log.cycles["valid"][-1, row]
    assert log.cycles["valid"][-1, log.joints.index("knee")], "the others are read"


def test_a_servo_that_is_mounted_the_other_way_round_is_refused_before_any_torque(monkeypatch):
    plan = plan_of(1.0)
    (bus,) = plan.buses
    turned = tuple(replace(one, direction=-1) if one.own_name == "hip/1" else one for one in bus.servos)
    truth = simulation_of(replace(plan, buses=(replace(bus, servos=turned),)))
    monkeypatch.setattr(virtual_run, "simulation_of", lambda plan: truth)
    robot = VirtualRobot(plan)
    turn_by_hand(robot.buses[0].servo(1), math.pi - 0.2)  # the hip is not at 0, or none could see it
    with pytest.raises(DxlrunError, match=r"the servos of hip disagree by 22\.9 deg"):
        robot.run()
    assert not any(servo.torque_on for servo in robot.buses[0].servos)


def test_registers_are_those_of_all_servos_of_a_joint_or_of_the_one_that_is_named(tmp_path):
    plan = plan_of(1.5)
    robot = VirtualRobot(plan)
    second = len(plan.loop.joints) + next(
        servo.row for servo in plan.buses[0].servos if servo.own_name == "hip/2"
    )
    request(robot, 400, 1, "register", joint="hip/2", item="position_p_gain", value=900, row=second)
    request(robot, 700, 2, "get", joint="hip", item="position_p_gain")
    request(robot, 800, 3, "get", joint="hip/2", item="position_p_gain", row=second)
    request(robot, 900, 4, "register", joint="hip", item="position_p_gain", value=850)
    request(robot, 1200, 5, "get", joint="hip", item="position_p_gain")
    robot.run()
    gains = {servo.servo_id: servo.registers["position_p_gain"] for servo in robot.buses[0].servos}
    assert (gains[1], gains[2]) == (850, 850)
    answers = robot.inbox.answers
    assert isinstance(answers[1], Completion)
    assert answers[1].value == 800
    assert isinstance(answers[2], Refusal)
    assert (
        "its servos have different values: ID 1 on bus main has 800, ID 2 on bus main has 900"
        in answers[2].text
    )
    assert [answers[number].value for number in (3, 5)] == [900, 850]


def test_torque_of_one_joint_of_a_wrist_is_that_of_both_its_servos(tmp_path):
    robot = VirtualRobot(plan_of(1.5))
    request(robot, 600, 1, "torque", joints=["wrist_roll"], on=False, release=True)
    seen: list[list[int]] = []
    robot.buses[0].at(
        1_200_000_000,
        lambda: seen.append([one.servo_id for one in robot.buses[0].servos if one.torque_on]),
    )
    robot.run()
    assert seen == [[1, 2, 3, 6]]
    assert isinstance(robot.inbox.answers[1], Completion)
