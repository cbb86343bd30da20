# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import math
import re
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from dxlrun.description.units import (
    Angle,
    Angles,
    AngularAcceleration,
    AngularJerk,
    AngularVelocity,
    Duration,
    Inertia,
    Length,
    LinearAcceleration,
    LinearJerk,
    LinearVelocity,
    Rate,
    Resistance,
    Stiffness,
    Torque,
    TorqueConstant,
    ViscousFriction,
    Voltage,
    angle,
    angular_acceleration,
    angular_jerk,
    angular_velocity,
    duration,
    inertia,
    length,
    linear_acceleration,
    linear_jerk,
    linear_velocity,
    rate,
    resistance,
    seconds,
    stiffness,
    torque,
    torque_constant,
    viscous_friction,
    voltage,
)


class Quantities(BaseModel):
    """Parameters as a plug-in would write them."""

    reach: Angle
    speed: AngularVelocity
    gain: AngularAcceleration
    wait: Duration
    several: Angles = ()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("180 deg", math.pi),
        ("-90deg", -math.pi / 2),
        ("1.05 rad", 1.05),
        ("+1e-2 rad", 0.01),
        (".5 rad", 0.5),
        ("1_000 rad", 1000.0),
        (" 0 deg ", 0.0),
    ],
)
def test_angle_is_in_rad(text: str, expected: float) -> None:
    assert angle(text) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("2 rad/s", 2.0), ("180 deg/s", math.pi), ("60 rpm", 2 * math.pi), ("-1 rad/s", -1.0)],
)
def test_velocity_is_in_rad_per_second(text: str, expected: float) -> None:
    assert angular_velocity(text) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"), [("0.3 Nm", 0.3), ("20 mNm", 0.02), ("-1Nm", -1.0), ("1_000 Nm", 1000.0)]
)
def test_torque_is_in_newton_metres(text: str, expected: float) -> None:
    assert torque(text) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0.01 kg m^2", 0.01), ("5 kg cm^2", 5e-4), ("300 g cm^2", 3e-5), ("1e-3kg m^2", 1e-3)],
)
def test_inertia_is_in_kilogram_square_metres(text: str, expected: float) -> None:
    assert inertia(text) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0.01", "'0.01' has no unit; write a moment of inertia with its unit, such as 0.01 kg m^2"),
        (
            "0.01 kg",
            "has the unit kg, which is not one of a moment of inertia; write it as 0.01 kg m^2, 5 kg cm^2 or",
        ),
        ("kg m^2", "'kg m^2' is not a moment of inertia; write a moment of inertia such as 0.01 kg m^2"),
    ],
)
def test_what_is_no_inertia_says_how_to_write_one(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        inertia(text)


@pytest.mark.parametrize("text", ["0.25 Nm", "20 mNm"])
def test_a_torque_in_json_is_read_to_the_same_value(text: str) -> None:
    class Weight(BaseModel):
        pull: Torque
        mass: Inertia

    weight = Weight.model_validate({"pull": text, "mass": "3 g cm^2"})
    assert Weight.model_validate_json(weight.model_dump_json()) == weight


@pytest.mark.parametrize(
    ("read", "text", "expected"),
    [
        (voltage, "12 V", 12.0),
        (voltage, "11_500 mV", 11.5),
        (torque_constant, "1.6 Nm/A", 1.6),
        (torque_constant, "1.6 V s/rad", 1.6),
        (torque_constant, "380 mNm/A", 0.38),
        (resistance, "3.6 ohm", 3.6),
        (resistance, "900 mohm", 0.9),
        (viscous_friction, "0.6 mNm s/rad", 0.0006),
        (viscous_friction, "1e-3 Nm s/rad", 0.001),
        (stiffness, "0.158 1/rad", 0.158),
        (stiffness, "15.8 %/rad", 0.158),
    ],
)
def test_figures_of_motors_are_in_si_units(read: Callable[[str], float], text: str, expected: float) -> None:
    assert read(text) == pytest.approx(expected, rel=1e-15)
    for other in ("12", "12 Hz", "V", "12 V/rad", ""):
        with pytest.raises(ValueError, match="write"):
            read(other)


def test_a_motor_in_json_is_read_to_the_same_values() -> None:
    class Figures(BaseModel):
        voltage: Voltage
        constant: TorqueConstant
        resistance: Resistance
        viscous: ViscousFriction
        gain: Stiffness

    written = {
        "voltage": "11.1 V",
        "constant": "1.1 Nm/A",
        "resistance": "3.3 ohm",
        "viscous": "0.7 mNm s/rad",
        "gain": "15.8 %/rad",
    }
    figures = Figures.model_validate(written)
    assert Figures.model_validate_json(figures.model_dump_json()) == figures


@pytest.mark.parametrize(
    ("read", "text", "expected"),
    [
        (rate, "15Hz", 15.0),
        (rate, "100 Hz", 100.0),
        (rate, "1 kHz", 1000.0),
        (rate, "12.5", 12.5),
        (rate, 50, 50.0),
        (seconds, "3", 3.0),
        (seconds, "1.5 s", 1.5),
        (seconds, "500ms", 0.5),
        (seconds, "2 min", 120.0),
        (seconds, 0.25, 0.25),
    ],
)
def test_rates_and_the_seconds_of_options_may_be_bare(
    read: Callable[[object], float], text: object, expected: float
) -> None:
    assert read(text) == expected
    for other in ("", "Hz", "3 rad", "nan", "inf", True, None):
        with pytest.raises(ValueError, match="write"):
            read(other)


def test_a_rate_in_json_is_a_number() -> None:
    class Loop(BaseModel):
        rate: Rate

    assert Loop.model_validate({"rate": "1 kHz"}).model_dump_json() == '{"rate":1000.0}'
    assert Loop.model_json_schema()["properties"]["rate"]["anyOf"][0] == {"type": "number"}


def test_acceleration_is_in_rad_per_square_second() -> None:
    assert angular_acceleration("10 rad/s^2") == 10.0
    assert angular_acceleration("180 deg/s^2") == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("read", "text", "expected"),
    [
        (length, "0.2 m", 0.2),
        (length, "20 cm", 0.2),
        (length, "200 mm", 0.2),
        (linear_velocity, "-300 mm/s", -0.3),
        (linear_acceleration, "50 cm/s^2", 0.5),
        (linear_jerk, "5 m/s^3", 5.0),
        (angular_jerk, "180 deg/s^3", math.pi),
    ],
)
def test_ways_of_wheels_are_in_metres(read: Callable[[str], float], text: str, expected: float) -> None:
    assert read(text) == pytest.approx(expected, rel=1e-15)


def test_a_base_in_json_is_read_to_the_same_values() -> None:
    class Base(BaseModel):
        separation: Length
        speed: LinearVelocity
        acceleration: LinearAcceleration
        jerk: LinearJerk
        turn: AngularJerk

    written = {"separation": "16 cm", "speed": "30 cm/s", "acceleration": "1 m/s^2", "jerk": "3 mm/s^3"}
    base = Base.model_validate(written | {"turn": "7 deg/s^3"})
    assert Base.model_validate_json(base.model_dump_json()) == base


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("500 us", 500_000),
        ("1 ms", 1_000_000),
        ("0.1 ms", 100_000),
        ("0.3 us", 300),
        ("2 s", 2_000_000_000),
        ("1 min", 60_000_000_000),
        ("1 h", 3_600_000_000_000),
        ("7 ns", 7),
        ("0 s", 0),
    ],
)
def test_duration_is_in_exact_nanoseconds(text: str, expected: int) -> None:
    assert duration(text) == expected


@pytest.mark.parametrize(
    "read", [angle, angular_velocity, angular_acceleration, duration, length, linear_velocity, linear_jerk]
)
@pytest.mark.parametrize(
    "text",
    ["", "deg", "60", "sixty deg", "6 0 deg", "1,5 rad", ". rad", "e5 rad", "1e rad", "nan rad", "inf s", "60 grad",
     "1 rad rad", "1e999999999 s", "9e999 rad", "9e999 s", "1e-999999999 s", "1" * 100 + " s", "٣ s", "1 m\ns"],
)  # fmt: skip
def test_what_is_no_quantity_is_refused_with_an_example(read: object, text: str) -> None:
    assert callable(read)
    with pytest.raises(ValueError, match="write") as caught:
        read(text)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("value", [60, 1.05, True, None, ["1 rad"], {}])
def test_a_value_without_unit_is_refused(value: object) -> None:
    with pytest.raises(ValidationError) as caught:
        Quantities.model_validate({"reach": value, "speed": value, "gain": value, "wait": value})
    assert {error["loc"][0] for error in caught.value.errors()} == {"reach", "speed", "gain", "wait"}


@pytest.mark.parametrize("text", ["-1 ns", "1e20 s", "40 h e"])
def test_a_time_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="duration"):
        duration(text)


def test_the_wrong_kind_of_unit_is_named() -> None:
    with pytest.raises(ValueError, match="unit ms, which is not one of an angle"):
        angle("5 ms")


@settings(max_examples=200, deadline=None)
@given(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e6, max_value=1e6),
    st.integers(min_value=0, max_value=10**18),
)
def test_json_reads_back_to_the_same_value(number: float, nanoseconds: int) -> None:
    # the plan keeps parameters as JSON; a digit lost there would move the robot
    before = Quantities.model_validate(
        {"reach": f"{number!r} rad", "speed": "1 rpm", "gain": "3 deg/s^2", "wait": f"{nanoseconds} ns"}
        | {"several": [f"{number!r} deg"]}
    )
    assert before.reach == number
    assert before.wait == nanoseconds
    assert Quantities.model_validate_json(before.model_dump_json()) == before


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=80))
def test_any_text_is_read_or_refused_in_words(text: str) -> None:
    for read in (angle, duration):
        try:
            value, refusal = read(text), ""
        except ValueError as error:
            value, refusal = 0, str(error)
        assert math.isfinite(value)
        assert not refusal or "write" in refusal


def test_the_schema_of_a_quantity_is_text() -> None:
    schema = Quantities.model_json_schema()["properties"]
    assert schema["reach"]["type"] == "string"
    assert schema["wait"]["examples"] == ["500 us"]
