"""robots/mechanics.yaml: a servo mounted wrongly, registers and torque; more in `stories/mechanics.txt`."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand

from dxlrun.channels.answers import Completion, Refusal
from dxlrun.channels.commands import CommandMessage
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.compile.simulation import simulation_of
from dxlrun.errors import DxlrunError
from dxlrun.plan.robot_plan import Plan
from dxlrun.run import virtual_run
from dxlrun.run.virtual_run import VirtualRobot

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
ROBOT, MOTION = ROBOTS / "mechanics.yaml", ROBOTS / "motions" / "mechanics_reach.yaml"


def plan_of(seconds: float, **arguments: str) -> Plan:
    return compile_files(ROBOT, arguments, [MOTION], round(seconds * 1e9)).plan


def request(robot: VirtualRobot, at_ms: int, number: int, kind: str, **data: object) -> None:
    command = CommandMessage(number, "", kind, json.dumps(data).encode(), "anna")
    robot.buses[0].at(at_ms * 1_000_000, lambda: robot.inbox.waiting.append(command))


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
