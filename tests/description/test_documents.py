# ruff: noqa: E501 (what is written and what is read stand side by side)

from __future__ import annotations

import re

import pytest
from tests.kit import desk
from tests.kit.desk import TORSO
from tests.kit.pages import page_text

from dxlrun.description.bus import Adapter, Bus, BusSimulation, SlowRegisters
from dxlrun.description.form import Form
from dxlrun.description.joints.joints import Joint, JointSimulation, SharedJoint
from dxlrun.description.joints.mechanics import (
    Limits,
    OneOfServos,
    Transmission,
    TransmissionServo,
)
from dxlrun.description.joints.motor_file import MotorForm, read_motor
from dxlrun.description.motion import Formula, FormulaPart, Motion, Point, PointsPart, Target
from dxlrun.description.robot import (
    ControllerEntry,
    Gateway,
    Group,
    GroupPolicies,
    Loop,
    Policies,
    PoseStep,
    Processes,
    Recording,
    Robot,
    RobotModel,
    Scheduler,
    Simulation,
    TorqueStep,
)

PAGE = page_text("robot-file.md")
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
ROWS = {
    row[0]: row
    for row in (
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in PAGE.splitlines()
        if line.startswith("| `")
    )
}


def test_the_examples_of_the_page_are_read() -> None:
    robot, variant, groups, slide, shared, wrist, chain, motor, motion = EXAMPLES
    assert set(desk.robot(robot, {"port": "/dev/ttyUSB0"}).robot.joints) == {
        "head_pitch_joint",
        "head_yaw_joint",
    }
    desk.write(robot, "two_joints.yaml")
    assert (desk.robot(variant).robot.name, desk.robot(variant).robot.loop.rate) == ("two_joints_slow", 10)
    without = robot[: robot.index("controllers:")]
    assert desk.robot(without + chain).robot.controllers["arm"].into == ("arm_pid",)
    head = robot[: robot.index("joints:")]
    for example, joint in (
        (groups, "left_elbow"),
        (slide, "gripper"),
        (shared, "hip"),
        (wrist, "wrist_roll"),
    ):
        assert joint in desk.robot(head + example).robot.joints
    assert len(desk.motion(motion).motion.motions) == 2
    assert read_motor(desk.write(motor, "elbow.motor.yaml")).motor.p_gain == 32


@pytest.mark.parametrize(
    ("prefix", "part"),
    [("", Robot), ("", Bus), ("adapter.", Adapter), ("", Joint), ("limits.", Limits), ("", SharedJoint), ("servos[].", OneOfServos), ("", Transmission), ("servos.*.", TransmissionServo), ("groups.*.", Group), ("", Loop), ("", Policies), ("", PoseStep), ("", TorqueStep),
     ("scheduler.", Scheduler), ("slow_registers.", SlowRegisters), ("groups.*.", GroupPolicies), ("simulation.", BusSimulation), ("simulation.", JointSimulation), ("simulation.", Simulation), ("", ControllerEntry), ("", Recording), ("", Processes), ("gateway.", Gateway), ("", RobotModel), ("", Motion), ("", PointsPart),
     ("", FormulaPart), ("points[].", Point), ("", MotorForm)],
)  # fmt: skip
def test_every_key_is_on_the_page(prefix: str, part: type[Form]) -> None:
    for key, field in part.model_fields.items():
        if key == "parameters" or (isinstance(field.default, Form) and key != "adapter"):
            continue  # parts of their own, whose keys are on the page
        assert prefix + key in ROWS
    for key in Robot.read_before:
        assert key in ROWS


@pytest.mark.parametrize(
    ("row", "text"),
    [("adapter.latency", "{{adapter: {{latency: {}}}}}"), ("return_delay_time", "{{return_delay_time: {}}}")],
)
def test_the_defaults_of_a_bus_are_the_pages(row: str, text: str) -> None:
    def bus(more: str) -> object:
        return desk.robot(
            f"name: x\nbuses:\n  m: &m {{port: sim, protocol: 1.0, baud_rate: 57600{more}}}\nloop: {{rate: 1}}\n"
            "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
        ).robot.buses["m"]

    written = text.format(ROWS[row][2])[1:-1]
    assert bus(f", {written}") == bus("")


@pytest.mark.parametrize(
    "row",
    [
        "on_exit",
        "on_fault",
        "on_lost_servo",
        "on_returned_servo",
        "groups",
        "on_stale_command",
        "exit_timeout",
    ],
)
def test_the_defaults_of_the_policies_are_the_pages(row: str) -> None:
    head = TORSO[: TORSO.index("policies:")]
    assert (
        desk.robot(head + f"policies: {{{row}: {ROWS[row][2]}}}\n").robot.policies
        == desk.robot(head).robot.policies
    )


def test_targets_and_formulas_have_the_same_three_quantities() -> None:
    assert set(Target.model_fields) == set(Formula.model_fields) == {"position", "velocity", "acceleration"}
