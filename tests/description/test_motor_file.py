# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace
from tests.kit import desk

from dxlrun import MotorLoad, MotorModel, Stribeck
from dxlrun.description.joints.motor_file import MotorForm, UncertaintyForm, motor_text, read_motor

MOTOR = """\
model: MX-64
source: elbow_20261123.mcap
voltage: 12 V
torque_constant: 1600 mNm/A
resistance: 3.5 ohm
inertia: 0.0112 kg m^2
friction: 0.1 Nm
load_friction: 0.08
viscous_friction: 0.6 mNm s/rad
stribeck: {friction: 50 mNm, velocity: 0.2 rad/s}
position_gain: 15.8 %/rad
p_gain: 32
delay: 1.5 ms
load: {inertia: 40 kg cm^2, gravity: 0.2 Nm, gravity_angle: 90 deg}
uncertainty: {resistance: 0.05 ohm, delay: 300 us}
"""
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


MISTAKES = [
    ("voltage: 12 V", "voltage: §0 V", "voltage is 0 V, but must be greater than 0; write for example `voltage: 12 V`"),
    ("voltage: 12 V", "voltage: §12", "voltage: 12 has no unit; write a voltage with its unit, such as 12 V"),
    ("resistance: 3.5 ohm", "resistance: §-3.5 ohm", "resistance is -3.5 ohm, but must be greater than 0; write for example `resistance: 3.6 ohm`"),
    ("resistance: 3.5 ohm", "resistance: §3.5 Nm", "resistance: '3.5 Nm' has the wrong unit Nm for a resistance; write a resistance such as 3.6 ohm"),
    ("friction: 0.1 Nm", "friction: §-0.1 Nm", "friction is -0.1 Nm, but must be at least 0; write for example `friction: 0.1 Nm`"),
    ("load_friction: 0.08", "load_friction: §1", "load_friction is 1, but must be less than 1; write for example `load_friction: 0.08`"),
    ("p_gain: 32", "p_gain: §32.5", "p_gain is 32.5, but must be a whole number; write for example `p_gain: 32`"),
    ("delay: 1.5 ms", "delay: §1 s", "delay: a delay is 100 ms at most; check its unit; a few milliseconds are usual"),
    ("friction: 0.1", "§frictoin: 0.1", "the file has an unknown key 'frictoin'; did you mean friction?"),
    ("gravity: 0.2", "§gravty: 0.2", "load has an unknown key 'gravty'; did you mean gravity?"),
    ("inertia: 0.0112 kg m^2\n", "", "the file has no inertia; add `inertia: 0.011 kg m^2`"),
    ("model: MX-64", "model: §${model}", "this file cannot contain ${...}; write the value"),
]  # fmt: skip


@pytest.mark.parametrize(("right", "wrong", "sentence"), MISTAKES)
def test_each_mistake_is_told_at_its_place(right: str, wrong: str, sentence: str) -> None:
    text, place = desk.pointed(MOTOR, right, wrong or "§")
    path = desk.write(text, "elbow.motor.yaml")
    (found,) = desk.caught(lambda: read_motor(path))
    assert found.endswith(sentence)
    if wrong:
        assert found.startswith(f"elbow.motor.yaml:{place}: ")


def test_each_figure_of_a_motor_is_a_key_of_the_file() -> None:
    keys = {*MotorForm.model_fields} - {"uncertainty", "delay"} | {"delay_ns", "torque_per_effort"}
    assert keys == {*MotorModel.__slots__}
