"""Mechanics: how servos move joints in a robot file: one or several on a joint, linear, in transmissions.

A servo's shaft turns by theta; s = direction * (theta - reference) * ratio is what it does at the joint. A
joint of one servo is q = s, of several servos the mean of theirs, and a transmission's joints are q = M s.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from dxlrun.description.form import Form, Name, refuse
from dxlrun.description.units import Acceleration, Angle, Effort, Length, Measure, Position, Speed

LEAST_RATIO, MOST_RATIO = 0.01, 10_000.0
"""Servo turns a joint turn; beyond them is a mistake: a tick would be 9 deg of the joint, or 30 nrad. [i]"""
LEAST_TRAVEL_M, MOST_TRAVEL_M = 1e-5, 10.0
"""Travel a servo turn; as above."""
TOLERANCE_RAD = math.radians(3.0)
"""By which the servos of one joint may disagree if the file gives nothing: backlash, a loaded gear. [i]"""
TOLERANCE_M = 1e-3
"""The same of a linear joint. [i]"""

MotorFile = Annotated[str, Field(min_length=1)]
"""Name of a motor file, as `dxlrun identify` writes it."""
_MOST_TOLERANCE_RAD = math.radians(20.0)
"""Servos that are further apart pull against each other, whatever they hold. [i]"""


def _useful(value: Measure) -> Measure:
    if value > _MOST_TOLERANCE_RAD and not value.linear:
        raise refuse(
            "a tolerance above 20 deg would let servos pull against each other unseen",
            "write for example 3 deg",
        )
    return value


Tolerance = Annotated[Position, Field(gt=0), AfterValidator(_useful)]
"""By how much servos of one joint may disagree, rad or m."""


def _whole(value: object) -> object:
    # True and 1.0 are equal to 1 in Python, but not what a person means by a direction
    if isinstance(value, bool | float):
        raise refuse("a direction is 1 or -1", "write 1 when the angle grows as the servo's does, else -1")
    return value


def _register(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise refuse(
            "this is no value of a register", "write the raw integer, or a quantity with its unit: 500 us"
        )
    return value


def _ordered(value: tuple[Measure, Measure]) -> tuple[Measure, Measure]:
    if not value[0] < value[1]:
        raise refuse("the lower limit is not below the upper one", "write [lower, upper]")
    return value


Direction = Annotated[Literal[1, -1], BeforeValidator(_whole)]
ServoId = Annotated[int, Field(ge=0, le=253)]
GearRatio = Annotated[float, Field(ge=LEAST_RATIO, le=MOST_RATIO)]
Register = Annotated[int | str, BeforeValidator(_register), WithJsonSchema({"type": ["integer", "string"]})]
"""A raw integer, or a quantity with its unit as text: its item's unit is in the control table."""
TravelPerTurn = Annotated[Length, Field(ge=LEAST_TRAVEL_M, le=MOST_TRAVEL_M)]


class Limits(Form):
    """Where a joint may go, and how fast; the last gate before the bus holds it there."""

    position: Annotated[tuple[Position, Position], Field(strict=False), AfterValidator(_ordered)] | None = (
        Field(
            default=None,
            description="Lower and upper limit of the joint's position.",
            examples=["[-90 deg, 90 deg]"],
        )
    )
    velocity: Annotated[Speed, Field(gt=0)] | None = Field(
        default=None, description="Highest speed; none: the servo's own.", examples=["2 rad/s"]
    )
    acceleration: Annotated[Acceleration, Field(gt=0)] | None = Field(
        default=None,
        description="By how much goals may become faster or slower; none: as much as commanded.",
        examples=["20 rad/s^2"],
    )
    effort: Effort | None = Field(
        default=None,
        description="Highest effort that may be commanded, in what the servo measures: Nm, N, A or %.",
        examples=["800 mA"],
    )


class OneOfServos(Form):
    """One of several servos on a joint; what it does not have is the joint's."""

    id: ServoId = Field(description="ID of the servo.", examples=["2"])
    bus: str | None = Field(
        default=None, description="Name of its bus; none: the joint's.", examples=["legs"]
    )
    model: str | None = Field(
        default=None, min_length=1, description="Its model; none: the joint's.", examples=["MX-64"]
    )
    reference: Angle | None = Field(
        default=None,
        description="Its angle, from its zero, where the joint's is zero; none: the joint's.",
        examples=["180 deg"],
    )
    direction: Direction | None = Field(
        default=None,
        description="1: the joint's angle grows as the servo's does, -1: against it; none: the joint's.",
        examples=["-1"],
    )
    registers: dict[Name, Register] | None = Field(
        default=None,
        description="What its control table shall hold; none: the joint's.",
        examples=["{position_p_gain: 800}"],
    )
    motor: MotorFile | None = Field(
        default=None, description="Its motor file; none: the joint's.", examples=["hip.motor.yaml"]
    )


class TransmissionServo(Form):
    """One servo of a transmission."""

    bus: str = Field(description="Name of its bus.", examples=["main"])
    id: ServoId = Field(description="ID of the servo.", examples=["1"])
    model: str = Field(min_length=1, description="Its model, or auto: it is asked.", examples=["XL430-W250"])
    reference: Angle = Field(
        description="Its angle, from its zero, where the transmission's joints are at zero.",
        examples=["180 deg"],
    )
    direction: Direction = Field(
        description="1: the transmission counts as the servo does, -1: against it.", examples=["1"]
    )
    gear_ratio: GearRatio = Field(
        default=1.0,
        description="Turns of the servo for one turn of the transmission's input.",
        examples=["2.5"],
    )
    registers: dict[Name, Register] = Field(
        default={},
        description="What its control table shall hold: written at the start where it differs.",
        examples=["{position_p_gain: 800}"],
    )
    motor: MotorFile | None = Field(
        default=None,
        description="Its motor file, from the folder of the file that says it.",
        examples=["wrist.motor.yaml"],
    )


class Transmission(Form):
    """Several servos that move several joints together: q = M s."""

    type: Literal["differential", "matrix"] = Field(
        description="differential: half of the sum and half of the difference; matrix: as `matrix` says.",
        examples=["differential"],
    )
    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="The joints that it moves, each in one transmission at most.", examples=["[roll, pitch]"]
    )
    servos: dict[Name, TransmissionServo] = Field(
        min_length=1, description="Its servos by name.", examples=["{left: {bus: main, id: 1, ...}}"]
    )
    matrix: (
        Annotated[
            tuple[Annotated[tuple[float, ...], Field(strict=False, min_length=1)], ...],
            Field(strict=False, min_length=1),
        ]
        | None
    ) = Field(
        default=None,
        description="Rows: joints, columns: servos, both in the order of the file; rad per rad.",
        examples=["[[0.5, 0.5], [0.5, -0.5]]"],
    )
    tolerance: Tolerance | None = Field(
        default=None,
        description="By how much a servo may be off where there are more servos than joints.",
        examples=["3 deg"],
    )
