"""Motor file: the YAML file with a servo's measured motor model: its form, reader and writer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
from pydantic import AfterValidator, Field, create_model

from dxlrun.description.arguments import refuse_arguments
from dxlrun.description.base_form import Form, key, validation_error
from dxlrun.description.document import Marks, grow, parse, read_text, refusal
from dxlrun.description.form_problems import read_form
from dxlrun.description.units import (
    Angle,
    AngularVelocity,
    Duration,
    Inertia,
    Resistance,
    Stiffness,
    Torque,
    TorqueConstant,
    ViscousFriction,
    Voltage,
)
from dxlrun.errors import Mark
from dxlsim.motor_model import MotorModel

_ESSENTIAL = ("voltage", "torque_constant", "resistance", "inertia")
"""Required figures of a motor file; a file that has none of them is refused as another kind of file."""


_LONGEST_DELAY_NS = 100_000_000


def _short(delay_ns: int) -> int:
    if delay_ns > _LONGEST_DELAY_NS:
        raise validation_error("a delay is 100 ms at most", "check its unit; a few milliseconds are usual")
    return delay_ns


class StribeckForm(Form):
    """Form of `stribeck` in a motor file: friction that decreases as the motor starts to turn."""

    friction: Annotated[Torque, Field(ge=0)] = key("Additional friction at standstill.", "0.05 Nm")
    velocity: Annotated[AngularVelocity, Field(gt=0)] = key(
        "Speed at which the additional friction has fallen to 37 %.", "0.2 rad/s"
    )
    exponent: float = key(
        "Exponent of the additional friction's fall; a higher one is steeper.", "2", 2.0, gt=0, le=20
    )


class LoadForm(Form):
    """Form of `load` in a motor file: what the motor moved while it was identified."""

    inertia: Annotated[Inertia, Field(ge=0)] = key(
        "Moment of inertia of the load, without rotor and gear.", "0.01 kg m^2", 0.0
    )
    gravity: Annotated[Torque, Field(ge=0)] = key(
        "Torque of the weight in the horizontal position.", "0.3 Nm", 0.0
    )
    gravity_angle: Angle = key("Joint angle at which the weight hangs straight down.", "0 deg", 0.0)


_UNCERTAIN: Mapping[str, tuple[object, str]] = {
    "torque_constant": (TorqueConstant, "0.02 Nm/A"),
    "resistance": (Resistance, "0.05 ohm"),
    "inertia": (Inertia, "0.0003 kg m^2"),
    "friction": (Torque, "0.004 Nm"),
    "load_friction": (float, "0.01"),
    "viscous_friction": (ViscousFriction, "0.001 Nm s/rad"),
    "stribeck_friction": (Torque, "0.01 Nm"),
    "stribeck_velocity": (AngularVelocity, "0.05 rad/s"),
    "position_gain": (Stiffness, "0.003 1/rad"),
    "delay": (Duration, "300 us"),
    "load_inertia": (Inertia, "0.0003 kg m^2"),
    "load_gravity": (Torque, "0.01 Nm"),
    "load_gravity_angle": (Angle, "2 deg"),
}
"""Figures of a motor file that can have an uncertainty, with their unit and an example."""
UncertaintyForm = create_model(  # type: ignore[call-overload]  # fields by a table
    "UncertaintyForm",
    __base__=Form,
    __doc__="Half-widths of the 95 % confidence intervals, each in the unit of its value.",
    **{
        name: (
            Annotated[kind, Field(ge=0)] | None,
            Field(
                default=None,
                description=f"Half-width of the 95 % confidence interval of {name}.",
                examples=[example],
            ),
        )
        for name, (kind, example) in _UNCERTAIN.items()
    },
)


class MotorForm(Form):
    """Form of a motor file, as `dxlrun identify` writes it."""

    model: str = key("Model of the servo.", "MX-64", min_length=1)
    source: str = key("Data of the identification: log and date.", "elbow.mcap", "")
    voltage: Annotated[Voltage, Field(gt=0)] = key("Supply voltage, unless the servo measures it.", "12 V")
    torque_constant: Annotated[TorqueConstant, Field(gt=0)] = key(
        "Torque at the horn per ampere.", "1.6 Nm/A"
    )
    resistance: Annotated[Resistance, Field(gt=0)] = key("Resistance of the motor's winding.", "3.6 ohm")
    inertia: Annotated[Inertia, Field(gt=0)] = key(
        "Moment of inertia of rotor and gear, at the horn.", "0.011 kg m^2"
    )
    friction: Annotated[Torque, Field(ge=0)] = key(
        "Coulomb friction, the same at every speed.", "0.1 Nm", 0.0
    )
    load_friction: float = key(
        "Friction per Nm of difference between the torques of motor and load, Nm/Nm.", "0.08", 0.0, ge=0, lt=1
    )
    viscous_friction: Annotated[ViscousFriction, Field(ge=0)] = key(
        "Viscous friction, proportional to the speed.", "0.01 Nm s/rad", 0.0
    )
    stribeck: StribeckForm | None = key(
        "Additional friction near standstill (Stribeck effect).",
        "{friction: 0.05 Nm, velocity: 0.2 rad/s}",
        None,
    )
    position_gain: Annotated[Stiffness, Field(gt=0)] | None = key(
        "Share of the full voltage for a position error of 1 rad, at a P gain of 1.", "0.158 1/rad", None
    )
    p_gain: int | None = key(
        "Value of the P gain register during the identification; absent if the servo has no such register.",
        "32",
        None,
        gt=0,
    )
    delay: Annotated[Duration, AfterValidator(_short)] = key(
        "Delay between a goal's arrival at the servo and its effect on the motor, at most 100 ms.", "2 ms", 0
    )
    load: LoadForm = key("Load during the identification.", "{inertia: 0.01 kg m^2}", LoadForm.of_defaults())
    uncertainty: UncertaintyForm = key(
        "Half-widths of the 95 % confidence intervals, by name.",
        "{resistance: 0.05 ohm}",
        UncertaintyForm.of_defaults(),
    )

    def motor(self) -> MotorModel:
        """Return the motor model for simulation and control."""
        figures = self.model_dump(exclude={"delay", "uncertainty"})
        return msgspec.convert(figures | {"delay_ns": self.delay}, MotorModel)


class MotorDescription(msgspec.Struct, frozen=True):
    """A motor file that was read: its motor model, its text, and the places of its values."""

    motor: MotorModel
    marks: Marks
    path: Path
    text: str  # text as read
    uncertainty: Mapping[str, float] = {}
    """Half-widths of the 95 % confidence intervals by figure, in SI units (the delay in s)."""


def read_motor(path: Path) -> MotorDescription:
    """Read a motor file; raise InputError with all of its mistakes."""
    file, text = str(path), read_text(path)
    grown = grow(parse(text, file), file, refuse_arguments)
    if not any(key in grown.data for key in _ESSENTIAL):
        what = f"this is not a motor file: {', '.join(_ESSENTIAL)} are missing"
        raise refusal(Mark(file), what, "give a motor file from `dxlrun identify`")
    form = read_form(grown, MotorForm)
    found = {name: float(value) for name, value in form.uncertainty if value is not None}
    # The form holds the delay in ns, the description in s.
    if "delay" in found:
        found["delay"] *= 1e-9
    return MotorDescription(form.motor(), grown.marks, path, text, found)


_UNITS: Mapping[str, str] = {
    "voltage": " V",
    "torque_constant": " Nm/A",
    "resistance": " ohm",
    "inertia": " kg m^2",
    "friction": " Nm",
    "load_friction": "",
    "viscous_friction": " Nm s/rad",
    "velocity": " rad/s",
    "exponent": "",
    "position_gain": " 1/rad",
    "p_gain": "",
    "delay": " s",
    "gravity": " Nm",
    "gravity_angle": " rad",
}


def motor_text(motor: MotorModel, uncertainty: Mapping[str, float], *, comment: str = "") -> str:
    """Write a motor model as the text of a motor file, which `read_motor` reads back up to rounding.

    Args:
        motor: The motor model; figures are written with six digits.
        uncertainty: As in `MotorDescription`.
        comment: Lines of a comment at the top.
    """
    return "\n".join(
        [*(f"# {line}".rstrip() for line in comment.splitlines()), *_lines(motor, uncertainty), ""]
    )


def _lines(motor: MotorModel, uncertainty: Mapping[str, float]) -> Iterator[str]:
    yield f"model: {motor.model}"
    if motor.source:
        yield f"source: {_quoted(motor.source)}"
    for name in (*_ESSENTIAL, "friction", "load_friction", "viscous_friction"):
        yield f"{name}: {_written(name, getattr(motor, name))}"
    if motor.stribeck is not None:
        stribeck = {name: getattr(motor.stribeck, name) for name in StribeckForm.model_fields}
        yield f"stribeck: {_mapping(stribeck)}"
    if motor.position_gain is not None:
        yield f"position_gain: {_written('position_gain', motor.position_gain)}"
    if motor.p_gain is not None:
        yield f"p_gain: {motor.p_gain}"
    if motor.delay_ns:
        yield f"delay: {motor.delay_ns / 1000:.12g} us"
    load = {name: getattr(motor.load, name) for name in LoadForm.model_fields}
    if any(load.values()):
        yield f"load: {_mapping(load)}"
    if uncertainty:
        yield "uncertainty:  # half-widths of the 95 % confidence intervals"
        yield from (f"  {name}: {_written(name, value)}" for name, value in uncertainty.items())


def _mapping(values: Mapping[str, float]) -> str:
    return "{" + ", ".join(f"{name}: {_written(name, value)}" for name, value in values.items()) + "}"


def _written(name: str, value: float) -> str:
    if name not in _UNITS:
        name = name.removeprefix("load_").removeprefix("stribeck_")
    return f"{value:.6g}{_UNITS[name]}"


def _quoted(text: str) -> str:
    single = " ".join(text.split()).replace("'", "''")
    return f"'{single}'"
