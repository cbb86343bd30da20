# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Motions and motor files in SI units; `cases/motion_form.txt` and `motor_form.txt` have the mistakes."""

import math

import pytest
from msgspec.structs import replace
from tests.kit import desk
from tests.kit.cases import read_head
from tests.kit.desk import TORSO
from tests.kit.robots import CASES

from dxlrun import MotorLoad, MotorModel, Stribeck
from dxlrun.description.joints.motor_file import MotorForm, UncertaintyForm, motor_text, read_motor
from dxlrun.description.motion import FormulaPart, PointsPart
from dxlrun.description.units import Measure

MOTION = read_head(CASES / "motion_form.txt").partition("---- motion0.yaml\n")[2]


def test_a_robot_file_is_no_motion_and_a_motion_no_robot() -> None:
    motion = "name: nod\nmotions:\n- {controller: c, points: [{time: 1 s, joints: {a: {position: 0 deg}}}]}\n"
    assert desk.refusals(motion) == [
        "robot.yaml:2:1: this is a motion file, not a robot file; run it with `dxlrun ROBOT.yaml --play robot.yaml`"
    ]
    assert desk.refusals("model: MX-64\ntorque_constant: 1.6 Nm/A\n") == [
        "robot.yaml:2:1: this is a motor file, not a robot file; name it in a robot file, at the joint: `motor: robot.yaml`"
    ]
    assert desk.motion_refusals(TORSO) == [
        "motion.yaml:1:1: this is a robot file, not a motion; run it with `dxlrun motion.yaml`, and give --play a motion file"
    ]
    assert len(desk.refusals("name: x\nmotions: []\njoints: {}\n")) > 1  # a robot with a key too much


def test_points_and_formulas_become_si_units() -> None:
    motion = desk.motion(MOTION).motion
    points, formulas = motion.motions
    assert isinstance(points, PointsPart)
    assert (points.controller, points.start) == ("head", 500_000_000)
    assert [point.time for point in points.points] == [1_000_000_000, 2_000_000_000]
    yaw = points.points[0].joints["yaw"]
    assert yaw.position == pytest.approx(math.pi / 2)
    assert (yaw.velocity, yaw.acceleration) == (Measure(0.5, "rad/s"), None)
    assert points.points[1].joints["yaw"].acceleration == Measure(1.0, "rad/s^2")
    assert [one.unit for one in yaw.quantities if one is not None] == ["rad", "rad/s"]
    assert isinstance(formulas, FormulaPart)
    assert (formulas.start, formulas.duration, formulas.samples) == (0, 30_000_000_000, 500)
    elbow = formulas.joints["elbow"]
    assert (elbow.position, elbow.velocity) == ("0.2*(sin(2*t) - sin(4*t)) - 0.4", "cos(t)")
    assert elbow.acceleration == "-1"
    assert formulas.joints["swing"].position == "0"


def test_a_part_that_is_neither_points_nor_formulas_is_refused() -> None:
    assert desk.motion_refusals("name: x\nmotions: [{controller: a}]\n") == [
        "motion.yaml:2:11: motions[0] has no points; add `points: [{time: 0 s, joints: ...}]`"
    ]
    assert desk.motion_refusals("name: x\nmotions: [5]\n") == [
        "motion.yaml:2:11: motions[0] is 5, but must be a mapping; write for example `motions: [{controller: head, ...}]`"
    ]
    assert desk.motion_refusals("name: x\nmotions: []\n") == [
        "motion.yaml:2:10: motions has too few entries; write at least 1"
    ]


MOTOR = read_head(CASES / "motor_form.txt").partition("---- elbow.motor.yaml\n")[2]
KNOWN = MotorModel(
    model="MX-64",
    voltage=12.0,
    torque_constant=1.6,
    resistance=3.5,
    inertia=0.0112,
    friction=0.1,
    load_friction=0.08,
    viscous_friction=0.0006,
    stribeck=Stribeck(0.05, 0.2, 2.0),
    position_gain=0.158,
    p_gain=32,
    delay_ns=1_500_000,
    load=MotorLoad(0.004, 0.2, math.pi / 2),
    source="elbow_20261123.mcap",
)


def test_a_motor_file_becomes_si_units() -> None:
    read = read_motor(desk.write(MOTOR))
    assert read.motor == KNOWN
    assert read.uncertainty == {"resistance": 0.05, "delay": pytest.approx(300e-6)}
    assert read.motor.stiffness == pytest.approx(5.056)
    assert replace(read.motor, position_gain=None).stiffness is None
    assert replace(read.motor, p_gain=None).stiffness == 0.158


def test_what_is_written_is_read_again() -> None:
    known = replace(KNOWN, source="it's: a log #1", voltage=12.3456, friction=1e-5)
    uncertainty = {
        "resistance": 0.05,
        "load_friction": 0.01,
        "delay": 2e-5,
        "load_gravity_angle": 0.01,
        "stribeck_velocity": 0.1,
        "viscous_friction": 1e-6,
    }
    read = read_motor(desk.write(motor_text(known, uncertainty, comment="one\n\ntwo")))
    assert read.motor == replace(known, load=read.motor.load)
    assert read.motor.load.gravity_angle == pytest.approx(math.pi / 2, rel=1e-5)
    assert dict(read.uncertainty) == pytest.approx(uncertainty)
    assert read.text.startswith("# one\n#\n# two\nmodel: MX-64\n")
    bare = MotorModel("AX-12A", 12.0, 1.0, 5.0, 0.01)
    assert read_motor(desk.write(motor_text(bare, {}))).motor == bare


def test_every_uncertainty_can_be_written() -> None:
    values = dict.fromkeys(UncertaintyForm.model_fields, 0.01)
    assert dict(read_motor(desk.write(motor_text(KNOWN, values))).uncertainty) == pytest.approx(values)


def test_each_figure_of_a_motor_is_a_key_of_the_file() -> None:
    keys = {*MotorForm.model_fields} - {"uncertainty", "delay"} | {"delay_ns", "torque_per_effort"}
    assert keys == {*MotorModel.__slots__}
