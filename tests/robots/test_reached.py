"""When a goal counts as reached: its joints were measured, hold torque, and answer; judged by the servos."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode
from dxlrun.run.virtual_run import VirtualRobot

MODELS = {1.0: ("AX-12A", "150 deg"), 2.0: ("XM430-W350", "180 deg")}
JOINTS = ("hip", "knee", "ankle", "thumb", "neck", "spare")
CONTROLLERS = """
controllers:
  trajectory: {type: joint_trajectory_controller, joints: [hip, spare], command_interface: position}
  strict:
    {type: joint_trajectory_controller, joints: [knee], command_interface: position,
     tolerances: {goal: 2 deg, goal_time: 200 ms}}
  player:
    {type: keyframe_player, joints: [ankle],
     motions: {bow: {steps: [{time: 500 ms, pose: {ankle: 40 deg}}]}}}
  grip: {type: gripper_controller, joint: thumb, stall_time: 200 ms}
  samples: {type: sample_player, joints: [neck], command_interface: position}
"""
TO = {"joints": ["hip"], "points": [{"time": 1.0, "positions": [0.7]}]}
TO_KNEE = {"points": [{"time": 1.0, "positions": [0.7]}]}
ROWS = [[0.7 * row / 50] for row in range(51)]


def robot_file(directory: Path, protocol: float) -> Path:
    model, reference = MODELS[protocol]
    joints = "\n".join(
        f"  {name}: {{bus: main, id: {number}, model: {model}, reference: {reference}, direction: 1}}"
        for number, name in enumerate(JOINTS, 1)
    )
    path = directory / "six.yaml"
    path.write_text(
        f"name: six\nbuses:\n  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000,\n"
        "    return_delay_time: 20 us, adapter: {latency: 0 ms}}\nloop: {rate: 50}\n"
        f"joints:\n{joints}{CONTROLLERS}"
    )
    return path


def ended(run: Any) -> dict[str, tuple[str, str, str]]:
    """Return how the goal of each controller ended: status, joint, text."""
    reports = [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]
    return {one["controller"]: (one["status"], one.get("joint", ""), one.get("text", "")) for one in reports}


def cut_power(robot: VirtualRobot, number: int) -> None:
    """Let a servo lose its supply for 0.1 s while the goals are pursued: it is limp then."""
    bus = robot.buses[0]
    bus.at(300_000_000, lambda: bus.servo(number).cut_power(400_000_000))


def asks() -> list[Any]:
    return [
        Ask(0.2, "trajectory", "trajectory", TO),
        Ask(0.2, "strict", "trajectory", TO_KNEE),
        Ask(0.2, "player", "play", {"motion": "bow"}),
        Ask(0.2, "grip", "grip", {"position": 0.7}),
        Ask(0.2, "samples", "samples", {"period": 0.02, "rows": ROWS}),
    ]


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_limp_joints_reach_nothing(tmp_path, protocol):
    def reset(robot: VirtualRobot) -> None:
        for number in range(1, 6):
            cut_power(robot, number)

    run = steered(tmp_path, robot_file(tmp_path, protocol), 2.5, asks(), before=reset)
    for number, joint in enumerate(JOINTS[:5], 1):
        turned = run.robot.buses[0].servo(number).shaft_angle - (2.618 if protocol == 1.0 else math.pi)
        assert abs(turned) < 0.4, f"{joint} went to its goal without torque"
    for controller, joint in zip(("trajectory", "strict", "player", "grip", "samples"), JOINTS, strict=False):
        status, named, text = ended(run)[controller]
        assert (status, named) == ("aborted", joint), (controller, text)
        assert re.search(rf"joint {joint} \(ID \d on bus \w+\) is limp", text)


def test_a_joint_that_rests_needs_no_torque(tmp_path):
    def reset(robot: VirtualRobot) -> None:
        cut_power(robot, 6)

    run = steered(tmp_path, robot_file(tmp_path, 2.0), 2.5, asks(), before=reset)
    assert {status for status, _, _ in ended(run).values()} == {"reached"}
    assert run.robot.buses[0].servo(1).shaft_angle - math.pi == pytest.approx(0.7, abs=0.01)


def jam(robot: VirtualRobot, number: int) -> None:
    """Block a joint on its last 5 to 10 deg, so that its servo stays on; the gripper sooner."""
    bus = robot.buses[0]
    at_ns = 300_000_000 if JOINTS[number - 1] == "thumb" else 1_000_000_000
    bus.at(at_ns, lambda: bus.servo(number).jam_shaft(True))


def test_jammed_joints_miss_their_goals_and_a_gripper_says_that_it_stalled(tmp_path):
    def begin(robot: VirtualRobot) -> None:
        for number in range(1, 6):
            jam(robot, number)

    robot = robot_file(tmp_path, 2.0)
    robot.write_text(robot.read_text().replace("direction: 1}", "direction: 1, tolerance: {time: 200 ms}}"))
    run = steered(tmp_path, robot, 3.0, asks(), before=begin)
    controllers = ("trajectory", "strict", "player", "grip", "samples")
    for number, (controller, joint) in enumerate(zip(controllers, JOINTS, strict=False), 1):
        status, named, text = ended(run)[controller]
        off = 0.7 - (run.robot.buses[0].servo(number).shaft_angle - math.pi)
        assert named == joint, (controller, status, text)
        if controller == "grip":
            assert (status, text.split(",")[0]) == ("reached", "stalled"), text
        else:
            assert (status, off > 0.08, " deg off" in text) == ("missed", True, True), (controller, text)
