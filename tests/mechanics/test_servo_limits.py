"""A register that limits one of a joint's servos limits the joint."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.stories import replayed, send, tell
from tests.kit.wire import all_writes

from dxlrun.channels.event_records import EventCode
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import VirtualRobot

GOAL_CURRENT, GOAL_VELOCITY = 102, 104
POSITIONS = "  all: {type: joint_group_position_controller, joints: [head, hip, gripper, pitch, roll]}"


def run(
    plan: Callable[..., Plan], tmp_path: Path, controller: str, command: tuple[str, float], **registers: int
) -> tuple[list[str], dict[int, set[int]]]:
    """Command a joint while servos 3 and 5 have these registers; return the events and the goals by servo."""
    plan((POSITIONS, f"  c: {controller}"))
    robots: list[VirtualRobot] = []

    def set_registers(robot: VirtualRobot) -> None:
        robots.append(robot)
        for servo in (3, 5):
            for name, value in registers.items():
                robot.buses[0].servo(servo).registers[name] = value

    story = {number: [send("c", *command)] for number in range(10, 14)}
    log = replayed(tell(tmp_path / "body.yaml", story, tmp_path / "run.mcap", before=set_registers))
    goals: dict[int, set[int]] = {}
    address = GOAL_CURRENT if command[0] == "efforts" else GOAL_VELOCITY
    size = 2 if address == GOAL_CURRENT else 4
    for _, servo, begin, data in all_writes(tuple(robots[0].ledger.entries), robots[0].plan.buses[0]):
        if begin == address and len(data) >= size:
            goals.setdefault(servo, set()).add(int.from_bytes(data[:size], "little", signed=True))
    return [event.text for event in log.events if event.code == EventCode.GATE], goals


def test_two_servos_of_a_joint_give_what_the_weaker_one_may(plan, tmp_path):
    effort = "{type: joint_group_effort_controller, joints: [hip]}"
    texts, goals = run(plan, tmp_path, effort, ("efforts", 0.3), current_limit=20)
    assert max(map(abs, goals[2])) == max(map(abs, goals[3])) == 20
    held = "goal clamped by register Current Limit (38) = 20, 0.0538 A (ID 3 on bus main)"
    assert texts[0] == f"hip, controller c: {held}"


@pytest.mark.parametrize(("speed", "held"), [(80.0, True), (60.0, False)])
def test_a_joint_of_a_differential_is_as_fast_as_the_slower_servo_may(plan, tmp_path, speed, held):
    velocity = "{type: joint_group_velocity_controller, joints: [pitch, roll]}"
    command = ("velocities", math.radians(speed), 0.0)
    texts, goals = run(plan, tmp_path, velocity, command, velocity_limit=50)
    assert (max(map(abs, goals[5])) == 50) == held
    named = [text for text in texts if "Velocity Limit (44) = 50, 68.7 deg/s (ID 5 on bus main)" in text]
    assert len(named) == held
