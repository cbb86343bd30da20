# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
import math
import re
from collections.abc import Callable
from typing import Annotated

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, TypeAdapter, ValidationError

from dxlrun.description import units
from dxlrun.description.units import (
    Angle,
    Angles,
    AngularAcceleration,
    AngularVelocity,
    Duration,
    Measure,
    Rate,
)

Read = Callable[[object], float]
FIGURES = {
    units.angle: {
        "180 deg": math.pi,
        "-90deg": -math.pi / 2,
        "1.05 rad": 1.05,
        "+1e-2 rad": 0.01,
        ".5 rad": 0.5,
        "1_000 rad": 1000.0,
        " 0 deg ": 0.0,
    },
    units.angular_velocity: {"2 rad/s": 2.0, "180 deg/s": math.pi, "60 rpm": 2 * math.pi, "-1 rad/s": -1.0},
    units.angular_acceleration: {"10 rad/s^2": 10.0, "180 deg/s^2": math.pi},
    units.angular_jerk: {"180 deg/s^3": math.pi},
    units.length: {"0.2 m": 0.2, "20 cm": 0.2, "200 mm": 0.2},
    units.linear_velocity: {"-300 mm/s": -0.3},
    units.linear_acceleration: {"50 cm/s^2": 0.5},
    units.linear_jerk: {"5 m/s^3": 5.0},
    units.torque: {"0.3 Nm": 0.3, "20 mNm": 0.02, "-1Nm": -1.0},
    units.inertia: {"0.01 kg m^2": 0.01, "5 kg cm^2": 0.0005, "300 g cm^2": 3e-05, "1e-3kg m^2": 0.001},
    units.voltage: {"12 V": 12.0, "11_500 mV": 11.5},
    units.torque_constant: {"1.6 Nm/A": 1.6, "1.6 V s/rad": 1.6, "380 mNm/A": 0.38},
    units.resistance: {"3.6 ohm": 3.6, "900 mohm": 0.9},
    units.viscous_friction: {"0.6 mNm s/rad": 0.0006, "1e-3 Nm s/rad": 0.001},
    units.stiffness: {"0.158 1/rad": 0.158, "15.8 %/rad": 0.158},
}
BARE = {
    units.rate: {"15Hz": 15.0, "100 Hz": 100.0, "1 kHz": 1000.0, "12.5": 12.5, 50: 50.0},
    units.seconds: {"3": 3.0, "1.5 s": 1.5, "500ms": 0.5, "2 min": 120.0, 0.25: 0.25},
}
"""Of these a number may be without its unit."""
MEASURES = {
    units.position: {"60 deg": Measure(math.pi / 3, "rad"), "20 mm": Measure(0.02, "m")},
    units.speed: {"50 mm/s": Measure(0.05, "m/s")},
    units.acceleration: {"1 rad/s^2": Measure(1.0, "rad/s^2")},
    units.torque_or_force: {"2 N": Measure(2.0, "N")},
    units.effort: {"800 mA": Measure(0.8, "A"), "40 %": Measure(0.4, "1")},
}
"""Of these the unit is kept, as it says what they are of."""
ROWS = [
    (read, text, value)
    for table in (FIGURES, BARE, MEASURES)
    for read in table
    for text, value in table[read].items()
]
WITH_UNIT = [(read, text) for read, text, _ in ROWS if read not in BARE]


class Quantities(BaseModel):
    """Parameters as a plug-in would write them."""

    reach: Angle
    speed: AngularVelocity
    gain: AngularAcceleration
    wait: Duration
    several: Angles = ()


@pytest.mark.parametrize(("read", "text", "expected"), ROWS)
def test_a_quantity_is_in_si(read: Read, text: object, expected: float) -> None:
    found = read(text)
    assert found == pytest.approx(float(expected), rel=1e-15)
    assert getattr(found, "unit", None) == getattr(expected, "unit", None)


@pytest.mark.parametrize(("read", "text"), WITH_UNIT)
def test_a_quantity_in_json_is_read_to_the_same_value(read: Read, text: str) -> None:
    kind = TypeAdapter(Annotated[float, read])
    value = kind.validate_python(text)
    again = kind.validate_json(kind.dump_json(value))
    assert (again, getattr(again, "unit", None)) == (value, getattr(value, "unit", None))
    assert kind.json_schema()["type"] == "string"


def test_a_rate_in_json_is_a_number() -> None:
    kind = TypeAdapter(Rate)
    assert kind.dump_json(kind.validate_python("1 kHz")) == b"1000.0"
    assert kind.json_schema()["anyOf"][0] == {"type": "number"}


@pytest.mark.parametrize("read", [units.rate, units.seconds])
def test_what_is_neither_a_number_nor_a_quantity_is_refused(read: Read) -> None:
    for text in ("", "Hz", "3 rad", "nan", "inf", True, None):
        with pytest.raises(ValueError, match="write"):
            read(text)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0.01", "'0.01' has no unit; write a moment of inertia with its unit, such as 0.01 kg m^2"),
        (
            "0.01 kg",
            "has the wrong unit kg for a moment of inertia; write a moment of inertia such as 0.01 kg m^2, 5 kg",
        ),
        ("kg m^2", "'kg m^2' is not a moment of inertia; write a moment of inertia such as 0.01 kg m^2"),
    ],
)
def test_what_is_no_inertia_says_how_to_write_one(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        units.inertia(text)


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
    assert units.duration(text) == expected


@pytest.mark.parametrize("read", [units.duration, *FIGURES, *MEASURES])
@pytest.mark.parametrize(
    "text",
    ["", "deg", "60", "sixty deg", "6 0 deg", "1,5 rad", ". rad", "e5 rad", "1e rad", "nan rad", "inf s", "60 grad",
     "1 rad rad", "1e999999999 s", "9e999 rad", "9e999 s", "1e-999999999 s", "1" * 100 + " s", "٣ s", "1 m\ns"],
)  # fmt: skip
def test_what_is_no_quantity_is_refused_with_an_example(read: Read, text: str) -> None:
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
        units.duration(text)


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
    for read in (units.angle, units.duration):
        try:
            value, refusal = read(text), ""
        except ValueError as error:
            value, refusal = 0, str(error)
        assert math.isfinite(value)
        assert not refusal or "write" in refusal
