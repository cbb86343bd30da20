"""Units: angles, speeds and times as a person writes them, `60 deg` or `500 us`, held in SI.

Use `Angle`, `AngularVelocity`, `AngularAcceleration`, `Length`, `LinearVelocity`, `LinearAcceleration`,
`Position`, `Torque`, `Effort`, `LinearEffort`, `Mass`, `Inertia`, `Voltage`, `TorqueConstant`, `Resistance`,
`ViscousFriction`, `Stiffness` and `Duration` as types of a model's fields. They take text with a unit; a
bare number is an error, because `60` could be deg or rad. In JSON they are written back as text that they
read to the same value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated, Literal, TypeVar

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema
from pydantic_core import PydanticCustomError

from dxlrun.description.form import refuse
from dxlrun.description.modes import EffortUnit

# at most three digits of exponent: Fraction("1e-999999999") would fill the memory
_QUANTITY = re.compile(
    r"([-+]?(?:\d+(?:_\d+)*)?(?:\.\d*)?(?:[eE][-+]?\d{1,3})?)\s*([A-Za-z/^0-9% ]*)", re.ASCII
)
_LONGEST = 64

LinearEffortUnit = Literal["N", "A", "1"]
PositionUnit = Literal["rad", "m"]
SpeedUnit = Literal["rad/s", "m/s"]
AccelerationUnit = Literal["rad/s^2", "m/s^2"]

Unit = TypeVar("Unit", PositionUnit, SpeedUnit, AccelerationUnit)

_REV = 2 * math.pi

_ANGLE: Mapping[str, float] = {"deg": math.pi / 180, "rad": 1.0}
_ANGULAR_VELOCITY: Mapping[str, float] = {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": _REV / 60}
_ANGULAR_ACCELERATION: Mapping[str, float] = {"rad/s^2": 1.0, "deg/s^2": math.pi / 180}
_ANGULAR_JERK: Mapping[str, float] = {"rad/s^3": 1.0, "deg/s^3": math.pi / 180}
_LENGTH: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_LINEAR_VELOCITY: Mapping[str, float] = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3}
_LINEAR_ACCELERATION: Mapping[str, float] = {"m/s^2": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3}
_LINEAR_JERK: Mapping[str, float] = {"m/s^3": 1.0, "cm/s^3": 1e-2, "mm/s^3": 1e-3}
_FORCE: Mapping[str, float] = {"N": 1.0, "mN": 1e-3}
_MASS: Mapping[str, float] = {"kg": 1.0, "g": 1e-3}
_TORQUE: Mapping[str, float] = {"Nm": 1.0, "mNm": 1e-3}
_EFFORT: Mapping[str, tuple[float, EffortUnit]] = {
    "Nm": (1.0, "Nm"),
    "mNm": (1e-3, "Nm"),
    "A": (1.0, "A"),
    "mA": (1e-3, "A"),
    "%": (1e-2, "1"),
}
_LINEAR_EFFORT: Mapping[str, tuple[float, LinearEffortUnit]] = {
    "N": (1.0, "N"),
    "A": (1.0, "A"),
    "mA": (1e-3, "A"),
    "%": (1e-2, "1"),
}
_POSITION: Mapping[str, tuple[float, PositionUnit]] = {
    **{unit: (scale, "rad") for unit, scale in _ANGLE.items()},
    **{unit: (scale, "m") for unit, scale in _LENGTH.items()},
}
_SPEED: Mapping[str, tuple[float, SpeedUnit]] = {
    **{unit: (scale, "rad/s") for unit, scale in _ANGULAR_VELOCITY.items()},
    **{unit: (scale, "m/s") for unit, scale in _LINEAR_VELOCITY.items()},
}
_ACCELERATION: Mapping[str, tuple[float, AccelerationUnit]] = {
    **{unit: (scale, "rad/s^2") for unit, scale in _ANGULAR_ACCELERATION.items()},
    **{unit: (scale, "m/s^2") for unit, scale in _LINEAR_ACCELERATION.items()},
}
_INERTIA: Mapping[str, float] = {"kg m^2": 1.0, "kg cm^2": 1e-4, "g cm^2": 1e-7}
_VOLTAGE: Mapping[str, float] = {"V": 1.0, "mV": 1e-3}
_TORQUE_CONSTANT: Mapping[str, float] = {"Nm/A": 1.0, "mNm/A": 1e-3, "V s/rad": 1.0}
_RESISTANCE: Mapping[str, float] = {"ohm": 1.0, "mohm": 1e-3}
_VISCOUS_FRICTION: Mapping[str, float] = {"Nm s/rad": 1.0, "mNm s/rad": 1e-3}
_STIFFNESS: Mapping[str, float] = {"1/rad": 1.0, "%/rad": 1e-2}
_DURATION_NS: Mapping[str, int] = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 1_000_000_000,
    "min": 60_000_000_000,
    "h": 3_600_000_000_000,
}
_SIZE_BYTES: Mapping[str, int] = {
    "kB": 1_000,
    "MB": 1_000_000,
    "GB": 1_000_000_000,
    "KiB": 1 << 10,
    "MiB": 1 << 20,
    "GiB": 1 << 30,
}
_TABLE_UNITS: Mapping[str, tuple[str, Mapping[str, float], str]] = {
    "rad": ("an angle", _ANGLE, "60 deg or 1.05 rad"),
    "rad/s": ("an angular velocity", _ANGULAR_VELOCITY, "2 rad/s, 30 deg/s or 5 rpm"),
    "rad/s^2": ("an angular acceleration", _ANGULAR_ACCELERATION, "10 rad/s^2 or 90 deg/s^2"),
    "s": ("a time", {"us": 1e-6, "ms": 1e-3, "s": 1.0}, "500 us or 1 ms"),
    "V": ("a voltage", _VOLTAGE, "9.5 V"),
    "A": ("a current", {"A": 1.0, "mA": 1e-3}, "800 mA"),
    "Nm": ("a torque", _TORQUE, "0.3 Nm or 20 mNm"),
    "degC": ("a temperature", {"degC": 1.0}, "70 degC"),
    "1": ("a share of the maximum", {"%": 1e-2}, "40 %"),
}
_LONGEST_NS = 10**9 * _DURATION_NS["s"]  # 31 years; stays inside 64 bits when a few are added


def angle(text: str) -> float:
    """Return an angle, rad, from `60 deg` or `1.05 rad`; raises ValueError with an example."""
    return _si(text, "an angle", _ANGLE, "60 deg or 1.05 rad")


def angular_velocity(text: str) -> float:
    """Return a speed, rad/s, from `2 rad/s`, `30 deg/s` or `5 rpm`; raises ValueError with an example."""
    return _si(text, "an angular velocity", _ANGULAR_VELOCITY, "2 rad/s, 30 deg/s or 5 rpm")


def angular_acceleration(text: str) -> float:
    """Return an acceleration, rad/s^2, from `10 rad/s^2` or `90 deg/s^2`; raises ValueError."""
    return _si(text, "an angular acceleration", _ANGULAR_ACCELERATION, "10 rad/s^2 or 90 deg/s^2")


def angular_jerk(text: str) -> float:
    """Return a jerk, rad/s^3, from `100 rad/s^3` or `900 deg/s^3`; raises ValueError with an example."""
    return _si(text, "an angular jerk", _ANGULAR_JERK, "100 rad/s^3 or 900 deg/s^3")


def length(text: str) -> float:
    """Return a length, m, from `0.2 m`, `20 cm` or `200 mm`; raises ValueError with an example."""
    return _si(text, "a length", _LENGTH, "0.2 m, 20 cm or 200 mm")


def linear_velocity(text: str) -> float:
    """Return a speed, m/s, from `0.2 m/s` or `200 mm/s`; raises ValueError with an example."""
    return _si(text, "a linear velocity", _LINEAR_VELOCITY, "0.2 m/s or 200 mm/s")


def linear_acceleration(text: str) -> float:
    """Return an acceleration, m/s^2, from `1 m/s^2` or `500 mm/s^2`; raises ValueError with an example."""
    return _si(text, "a linear acceleration", _LINEAR_ACCELERATION, "1 m/s^2 or 500 mm/s^2")


def linear_jerk(text: str) -> float:
    """Return a jerk, m/s^3, from `5 m/s^3` or `500 mm/s^3`; raises ValueError with an example."""
    return _si(text, "a linear jerk", _LINEAR_JERK, "5 m/s^3 or 500 mm/s^3")


def mass(text: str) -> float:
    """Return a mass, kg, from `0.3 kg` or `300 g`; raises ValueError with an example."""
    return _si(text, "a mass", _MASS, "0.3 kg or 300 g")


def torque(text: str) -> float:
    """Return a torque, Nm, from `0.3 Nm` or `20 mNm`; raises ValueError with an example."""
    return _si(text, "a torque", _TORQUE, "0.3 Nm or 20 mNm")


def effort(text: str) -> tuple[float, EffortUnit]:
    """Return an effort and what it is counted in, from `0.3 Nm`, `800 mA` or `40 %`; raises ValueError.

    Which of them fits is a matter of the servo: some measure their current, most only the share of their
    highest load.
    """
    written = "0.3 Nm, 800 mA or 40 %"
    number, unit = _split(text, "an effort", _EFFORT, written)
    scale, counted = _EFFORT[unit]
    value = float(number) * scale
    if not 0 < value < math.inf:
        raise refuse(f"{text!r} is no effort above 0", f"write one such as {written}")
    return value, counted


def linear_effort(text: str) -> tuple[float, LinearEffortUnit]:
    """Return the effort of a linear joint and what it is counted in, from `20 N`, `800 mA` or `40 %`."""
    written = "20 N, 800 mA or 40 %"
    number, unit = _split(text, "an effort of a linear joint", _LINEAR_EFFORT, written)
    scale, counted = _LINEAR_EFFORT[unit]
    value = float(number) * scale
    if not 0 < value < math.inf:
        raise refuse(f"{text!r} is no effort above 0", f"write one such as {written}")
    return value, counted


def position(text: str) -> tuple[float, PositionUnit]:
    """Return a joint's position, rad or m, and which it is, from `60 deg` or `20 mm`; raises ValueError."""
    return _either(text, "an angle or a length", _POSITION, "60 deg, or 20 mm of a linear joint")


def speed(text: str) -> tuple[float, SpeedUnit]:
    """Return a joint's speed and its unit, from `2 rad/s` or `50 mm/s`; raises ValueError."""
    return _either(text, "a velocity", _SPEED, "2 rad/s, or 50 mm/s of a linear joint")


def acceleration(text: str) -> tuple[float, AccelerationUnit]:
    """Return a joint's acceleration and its unit, from `10 rad/s^2` or `1 m/s^2`; raises ValueError."""
    return _either(text, "an acceleration", _ACCELERATION, "10 rad/s^2, or 1 m/s^2 of a linear joint")


def inertia(text: str) -> float:
    """Return a moment of inertia, kg m^2, from `0.01 kg m^2` or `300 g cm^2`; raises ValueError."""
    return _si(text, "a moment of inertia", _INERTIA, "0.01 kg m^2, 5 kg cm^2 or 300 g cm^2")


def force(text: str) -> float:
    """Return a force, N, from `2 N` or `500 mN`; raises ValueError with an example."""
    return _si(text, "a force", _FORCE, "2 N or 500 mN")


def voltage(text: str) -> float:
    """Return a voltage, V, from `12 V`; raises ValueError with an example."""
    return _si(text, "a voltage", _VOLTAGE, "12 V")


def torque_constant(text: str) -> float:
    """Return a torque constant, Nm/A, from `1.6 Nm/A`; raises ValueError with an example."""
    return _si(text, "a torque constant", _TORQUE_CONSTANT, "1.6 Nm/A or 1.6 V s/rad")


def resistance(text: str) -> float:
    """Return a resistance, ohm, from `3.6 ohm`; raises ValueError with an example."""
    return _si(text, "a resistance", _RESISTANCE, "3.6 ohm")


def viscous_friction(text: str) -> float:
    """Return a viscous friction, Nm s/rad, from `0.01 Nm s/rad`; raises ValueError with an example."""
    return _si(text, "a viscous friction", _VISCOUS_FRICTION, "0.01 Nm s/rad")


def stiffness(text: str) -> float:
    """Return a part of the full voltage for each rad, 1/rad, from `0.158 1/rad`; raises ValueError."""
    return _si(text, "a duty for each rad", _STIFFNESS, "0.158 1/rad or 15.8 %/rad")


def share(text: str) -> float:
    """Return a share from 0 to 1 from `5 %`; raises ValueError with an example."""
    value = _si(text, "a share", {"%": 1e-2}, "5 %")
    if not 0.0 <= value <= 1.0:
        raise refuse(f"{text!r} is no share from 0 % to 100 %", "write one such as 5 %")
    return value


def duration(text: str) -> int:
    """Return a time, ns, from `500 us`, `1 ms`, `2 s` or `1 min`; raises ValueError with an example."""
    written = "500 us, 1 ms, 2 s or 1 min"
    number, unit = _split(text, "a duration", _DURATION_NS, written)
    value = round(Fraction(number) * _DURATION_NS[unit])  # exact: 0.1 ms is 100000 ns
    if not 0 <= value <= _LONGEST_NS:
        raise refuse(f"{text!r} is no duration from 0 s to 31 years", f"write one such as {written}")
    return value


def quantity(text: str, unit: str) -> float:
    """Return a quantity in an SI unit of the control tables, from text with any unit of its kind.

    `unit` is rad, rad/s, rad/s^2, s, V, A, Nm, degC or 1 (a fraction: `40 %`). Raises ValueError
    with an example.
    """
    return _si(text, *_TABLE_UNITS[unit])


def _si(text: str, what: str, units: Mapping[str, float], written: str) -> float:
    number, unit = _split(text, what, units, written)
    value = float(number) * units[unit]
    if not math.isfinite(value):
        raise refuse(f"{text!r} is too large", f"write {what} such as {written}")
    return value


def _either(
    text: str, what: str, units: Mapping[str, tuple[float, Unit]], written: str
) -> tuple[float, Unit]:
    number, unit = _split(text, what, units, written)
    scale, counted = units[unit]
    value = float(number) * scale
    if not math.isfinite(value):
        raise refuse(f"{text!r} is too large", f"write {what} such as {written}")
    return value, counted


def _split(text: object, what: str, units: Mapping[str, object], written: str) -> tuple[str, str]:
    """Return number and unit of a quantity; both are known to be right."""
    if isinstance(text, int | float) and not isinstance(text, bool):
        raise refuse(f"{text} has no unit", f"write {what} with its unit, such as {written}")
    if not isinstance(text, str):
        raise refuse(f"this is not {what}", f"write {what} such as {written}")
    match = _QUANTITY.fullmatch(text.strip()) if len(text) <= _LONGEST else None
    number = match[1].replace("_", "") if match else ""
    if match is None or not any(character.isdigit() for character in number.split("e")[0].split("E")[0]):
        raise refuse(f"{text[:_LONGEST]!r} is not {what}", f"write {what} such as {written}")
    if not match[2]:
        raise refuse(f"{text!r} has no unit", f"write {what} with its unit, such as {written}")
    if match[2] not in units:
        raise refuse(
            f"{text!r} has the unit {match[2]}, which is not one of {what}", f"write it as {written}"
        )
    return number, match[2]


def _auto_duration(value: str) -> int | str:
    if value == "auto":
        return value
    try:
        return duration(value)
    except PydanticCustomError as error:
        context = error.context or {}
        raise refuse(str(context["what"]), f"{context['fix']}, or auto") from error


def _polling(value: str) -> int | str:
    if value in ("auto", "off"):
        return 0 if value == "off" else value
    try:
        return duration(value)
    except PydanticCustomError as error:
        context = error.context or {}
        raise refuse(str(context["what"]), f"{context['fix']}, auto or off") from error


def _part(value: object) -> object:
    if isinstance(value, tuple):  # as it was read before
        return value
    units = {**_SIZE_BYTES, **_DURATION_NS}
    number, unit = _split(value, "a size or a duration", units, "100 MB or 10 min")
    amount = round(Fraction(number) * units[unit])
    if not 0 <= amount <= _LONGEST_NS:
        raise refuse(f"{value!r} is out of range", "write a size or a duration such as 100 MB or 10 min")
    return ("bytes" if unit in _SIZE_BYTES else "ns", amount)


def _text_schema(example: str, units: Mapping[str, object], *others: dict[str, object]) -> WithJsonSchema:
    # an escaped space is none of the escapes that JSON Schema allows
    names = "|".join(re.escape(unit).replace("\\ ", " ") for unit in units)
    pattern = rf"^\s*[-+]?[0-9_.]+([eE][-+]?[0-9]+)?\s*({names})\s*$"
    schema: dict[str, object] = {"type": "string", "pattern": pattern, "examples": [example]}
    return WithJsonSchema({"anyOf": [schema, *others]} if others else schema)


Angle = Annotated[
    float,
    BeforeValidator(angle),
    PlainSerializer(lambda value: f"{value!r} rad", return_type=str, when_used="json"),
    _text_schema("60 deg", _ANGLE),
]
"""rad, from `60 deg` or `1.05 rad`."""

AngularVelocity = Annotated[
    float,
    BeforeValidator(angular_velocity),
    PlainSerializer(lambda value: f"{value!r} rad/s", return_type=str, when_used="json"),
    _text_schema("2 rad/s", _ANGULAR_VELOCITY),
]
"""rad/s, from `2 rad/s`, `30 deg/s` or `5 rpm`."""

AngularAcceleration = Annotated[
    float,
    BeforeValidator(angular_acceleration),
    PlainSerializer(lambda value: f"{value!r} rad/s^2", return_type=str, when_used="json"),
    _text_schema("10 rad/s^2", _ANGULAR_ACCELERATION),
]
"""rad/s^2, from `10 rad/s^2` or `90 deg/s^2`."""

AngularJerk = Annotated[
    float,
    BeforeValidator(angular_jerk),
    PlainSerializer(lambda value: f"{value!r} rad/s^3", return_type=str, when_used="json"),
    _text_schema("100 rad/s^3", _ANGULAR_JERK),
]
"""rad/s^3, from `100 rad/s^3` or `900 deg/s^3`."""

Length = Annotated[
    float,
    BeforeValidator(length),
    PlainSerializer(lambda value: f"{value!r} m", return_type=str, when_used="json"),
    _text_schema("200 mm", _LENGTH),
]
"""m, from `0.2 m`, `20 cm` or `200 mm`."""

Mass = Annotated[
    float,
    BeforeValidator(mass),
    PlainSerializer(lambda value: f"{value!r} kg", return_type=str, when_used="json"),
    _text_schema("300 g", _MASS),
]
"""kg, from `0.3 kg` or `300 g`."""

LinearVelocity = Annotated[
    float,
    BeforeValidator(linear_velocity),
    PlainSerializer(lambda value: f"{value!r} m/s", return_type=str, when_used="json"),
    _text_schema("0.2 m/s", _LINEAR_VELOCITY),
]
"""m/s, from `0.2 m/s` or `200 mm/s`."""

LinearAcceleration = Annotated[
    float,
    BeforeValidator(linear_acceleration),
    PlainSerializer(lambda value: f"{value!r} m/s^2", return_type=str, when_used="json"),
    _text_schema("1 m/s^2", _LINEAR_ACCELERATION),
]
"""m/s^2, from `1 m/s^2` or `500 mm/s^2`."""

LinearJerk = Annotated[
    float,
    BeforeValidator(linear_jerk),
    PlainSerializer(lambda value: f"{value!r} m/s^3", return_type=str, when_used="json"),
    _text_schema("5 m/s^3", _LINEAR_JERK),
]
"""m/s^3, from `5 m/s^3` or `500 mm/s^3`."""

Torque = Annotated[
    float,
    BeforeValidator(torque),
    PlainSerializer(lambda value: f"{value!r} Nm", return_type=str, when_used="json"),
    _text_schema("0.3 Nm", _TORQUE),
]
"""Nm, from `0.3 Nm` or `20 mNm`."""

Effort = Annotated[
    tuple[float, EffortUnit],
    BeforeValidator(effort),
    PlainSerializer(
        lambda value: f"{value[0]!r} {value[1]}" if value[1] != "1" else f"{value[0] * 100!r} %",
        return_type=str,
        when_used="json",
    ),
    _text_schema("800 mA", _EFFORT),
]
"""A number above 0 and its unit, from `0.3 Nm`, `800 mA` or `40 %`."""

LinearEffort = Annotated[
    tuple[float, LinearEffortUnit],
    BeforeValidator(linear_effort),
    PlainSerializer(
        lambda value: f"{value[0]!r} {value[1]}" if value[1] != "1" else f"{value[0] * 100!r} %",
        return_type=str,
        when_used="json",
    ),
    _text_schema("20 N", _LINEAR_EFFORT),
]
"""A number above 0 and its unit, from `20 N`, `800 mA` or `40 %`."""

Position = Annotated[
    tuple[float, PositionUnit],
    BeforeValidator(position),
    PlainSerializer(lambda value: f"{value[0]!r} {value[1]}", return_type=str, when_used="json"),
    _text_schema("60 deg", _POSITION),
]
"""rad or m and which of them, from `60 deg` or `20 mm`."""

Speed = Annotated[
    tuple[float, SpeedUnit],
    BeforeValidator(speed),
    PlainSerializer(lambda value: f"{value[0]!r} {value[1]}", return_type=str, when_used="json"),
    _text_schema("2 rad/s", _SPEED),
]
"""rad/s or m/s and which of them, from `2 rad/s` or `50 mm/s`."""

Acceleration = Annotated[
    tuple[float, AccelerationUnit],
    BeforeValidator(acceleration),
    PlainSerializer(lambda value: f"{value[0]!r} {value[1]}", return_type=str, when_used="json"),
    _text_schema("10 rad/s^2", _ACCELERATION),
]
"""rad/s^2 or m/s^2 and which of them, from `10 rad/s^2` or `1 m/s^2`."""

Share = Annotated[
    float,
    BeforeValidator(share),
    PlainSerializer(lambda value: f"{value * 100:.12g} %", return_type=str, when_used="json"),
    _text_schema("5 %", {"%": 1e-2}),
]
"""A number from 0 to 1, from `5 %`."""

Inertia = Annotated[
    float,
    BeforeValidator(inertia),
    PlainSerializer(lambda value: f"{value!r} kg m^2", return_type=str, when_used="json"),
    _text_schema("0.01 kg m^2", _INERTIA),
]
"""kg m^2, from `0.01 kg m^2`, `5 kg cm^2` or `300 g cm^2`."""

Force = Annotated[
    float,
    BeforeValidator(force),
    PlainSerializer(lambda value: f"{value!r} N", return_type=str, when_used="json"),
    _text_schema("2 N", _FORCE),
]
"""N, from `2 N` or `500 mN`."""

Voltage = Annotated[
    float,
    BeforeValidator(voltage),
    PlainSerializer(lambda value: f"{value!r} V", return_type=str, when_used="json"),
    _text_schema("12 V", _VOLTAGE),
]
"""V, from `12 V`."""

TorqueConstant = Annotated[
    float,
    BeforeValidator(torque_constant),
    PlainSerializer(lambda value: f"{value!r} Nm/A", return_type=str, when_used="json"),
    _text_schema("1.6 Nm/A", _TORQUE_CONSTANT),
]
"""Nm/A, from `1.6 Nm/A` or `1.6 V s/rad`."""

Resistance = Annotated[
    float,
    BeforeValidator(resistance),
    PlainSerializer(lambda value: f"{value!r} ohm", return_type=str, when_used="json"),
    _text_schema("3.6 ohm", _RESISTANCE),
]
"""ohm, from `3.6 ohm`."""

ViscousFriction = Annotated[
    float,
    BeforeValidator(viscous_friction),
    PlainSerializer(lambda value: f"{value!r} Nm s/rad", return_type=str, when_used="json"),
    _text_schema("0.01 Nm s/rad", _VISCOUS_FRICTION),
]
"""Nm s/rad, from `0.01 Nm s/rad`."""

Stiffness = Annotated[
    float,
    BeforeValidator(stiffness),
    PlainSerializer(lambda value: f"{value!r} 1/rad", return_type=str, when_used="json"),
    _text_schema("0.158 1/rad", _STIFFNESS),
]
"""1/rad: the part of the full voltage for each rad of error, from `0.158 1/rad` or `15.8 %/rad`."""

Duration = Annotated[
    int,
    BeforeValidator(duration),
    PlainSerializer(lambda value: f"{value} ns", return_type=str, when_used="json"),
    _text_schema("500 us", _DURATION_NS),
]
"""ns, never negative, from `500 us`, `1 ms`, `2 s` or `1 min`."""

AutoDuration = Annotated[
    int | Literal["auto"],
    BeforeValidator(_auto_duration),
    PlainSerializer(
        lambda value: value if value == "auto" else f"{value} ns", return_type=str, when_used="json"
    ),
    _text_schema("500 us", _DURATION_NS, {"type": "string", "const": "auto"}),
]
"""ns as Duration, or the word `auto`."""

Polling = Annotated[
    int | Literal["auto"],
    BeforeValidator(_polling),
    PlainSerializer(
        lambda value: value if value == "auto" else f"{value} ns" if value else "off",
        return_type=str,
        when_used="json",
    ),
    _text_schema("500 us", _DURATION_NS, {"type": "string", "enum": ["auto", "off"]}),
]
"""ns as Duration, or the word `auto`; `off` is 0."""

SizeOrDuration = Annotated[
    tuple[Literal["bytes", "ns"], int],
    BeforeValidator(_part),
    PlainSerializer(
        lambda value: f"{value[1] / 1000!r} kB" if value[0] == "bytes" else f"{value[1]} ns",
        return_type=str,
        when_used="json",
    ),
    _text_schema("100 MB", {**_SIZE_BYTES, **_DURATION_NS}),
]
"""Bytes from `100 MB` or `64 MiB`, or ns from `10 min`; with the word that says which."""

Angles = Annotated[tuple[Angle, ...], Field(strict=False)]
"""Several angles, rad, from `[60 deg, 1 rad]`; shape (written ones,)."""
