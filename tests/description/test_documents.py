from __future__ import annotations

import json
import re

import pytest
from tests.kit import desk
from tests.kit.pages import page_text

from dxlrun.cli.examples import schema_text
from dxlrun.description.base_form import Form
from dxlrun.description.bus import Adapter, Bus, BusSimulation, SlowRegisters
from dxlrun.description.joints.joint_forms import Joint, JointSimulation, SharedJoint
from dxlrun.description.joints.joint_mechanics import (
    GoalTolerance,
    Limits,
    OneOfServos,
    SharedTolerance,
)
from dxlrun.description.joints.motor_file import MotorForm, read_motor
from dxlrun.description.motion import Formula, FormulaPart, MotionForm, Point, PointsPart, Target
from dxlrun.description.robot import (
    ControllerEntry,
    Gateway,
    GroupPolicies,
    Loop,
    Policies,
    PoseStep,
    RobotModel,
    Scheduler,
    Simulation,
    TorqueStep,
    robot_form,
)
from dxlrun.features.devices.form import Device, DeviceSimulation
from dxlrun.features.mechanics.form import Transmission, TransmissionServo
from dxlrun.features.recording.form import Recording
from dxlrun.features.sensors.form import SensorEntry

PAGE = page_text("robot-file.md")
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
TABLES = set(re.findall(r"^<!-- keys: (\w+) -->$", PAGE, re.MULTILINE))
"""Sections whose tables docs/generate.py writes."""


def test_the_examples_of_the_page_are_read() -> None:
    robot, variant, groups, near, slide, shared, wrist, chain, motor, motion = EXAMPLES
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
        (near, "elbow"),
        (slide, "gripper"),
        (shared, "hip"),
        (wrist, "wrist_roll"),
    ):
        assert joint in desk.robot(head + example).robot.joints
    assert len(desk.motion(motion).motion.motions) == 2
    assert read_motor(desk.write(motor, "elbow.motor.yaml")).motor.p_gain == 32


PARTS = [
    *(
        Bus,
        Adapter,
        SlowRegisters,
        BusSimulation,
        Joint,
        Limits,
        GoalTolerance,
        SharedTolerance,
        OneOfServos,
        Transmission,
        TransmissionServo,
    ),
    *(JointSimulation, Loop, Scheduler, Policies, PoseStep, TorqueStep, GroupPolicies, ControllerEntry),
    *(
        SensorEntry,
        Device,
        DeviceSimulation,
        Recording,
        Gateway,
        RobotModel,
        Simulation,
        PointsPart,
        FormulaPart,
    ),
]


def test_every_part_has_a_table() -> None:
    assert {part.__name__ for part in PARTS} | {"robot", "motor"} == TABLES


@pytest.mark.parametrize("part", [*PARTS, robot_form(), SharedJoint, MotorForm, MotionForm, Point, Target])
def test_every_key_is_described(part: type[Form]) -> None:
    for key, field in part.model_fields.items():
        assert field.description, key


@pytest.mark.parametrize(
    ("part", "key"),
    [
        ("Adapter", "latency"),
        ("Bus", "return_delay_time"),
        ("Policies", "on_returned_servo"),
        ("Policies", "exit_timeout"),
    ],
)
def test_a_default_of_the_schema_is_that_of_the_program(part: str, key: str) -> None:
    written = json.loads(schema_text("robot"))["$defs"][part]["properties"][key]["default"]
    keys = {"Bus": f"{key}: {written}", "Adapter": f"adapter: {{{key}: {written}}}"}.get(
        part, "baud_rate: 57600"
    )
    robot = (
        "name: x\nbuses:\n  m: {port: sim, protocol: 1.0, %s}\nloop: {rate: 1}\n"
        "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
    )
    bus = "baud_rate: 57600"
    policies = f"policies: {{{key}: {written}}}\n" if part == "Policies" else ""
    given = robot % (bus if keys == bus else f"{bus}, {keys}") + policies
    assert desk.robot(given).robot == desk.robot(robot % bus).robot


def test_targets_and_formulas_have_the_same_three_quantities() -> None:
    assert set(Target.model_fields) == set(Formula.model_fields) == {"position", "velocity", "acceleration"}
