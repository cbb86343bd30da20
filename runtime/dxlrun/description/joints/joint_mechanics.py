"""Mechanics: forms of limits, tolerances and servos of a joint, with their ranges.

A servo's shaft turns by theta; s = direction * (theta - reference) * ratio is the resulting motion at the
joint. The position of a joint is q = s with one servo, and the mean of all s with several servos.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    model_validator,
)
from pydantic_core import CoreSchema

from dxlrun.description import units
from dxlrun.description.base_form import Form, key, validation_error
from dxlrun.description.units import (
    Acceleration,
    Angle,
    Duration,
    Effort,
    Length,
    Measure,
    Position,
    RestSpeed,
    Speed,
)
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

LEAST_RATIO, MOST_RATIO = 0.01, 10_000.0
"""Allowed range of `gear_ratio` [i]; beyond it a tick would be 9 deg or 30 nrad of the joint."""
LEAST_TRAVEL_M, MOST_TRAVEL_M = 1e-5, 10.0  # travel per servo turn; values beyond are mistakes
SERVO_TOLERANCES: Mapping[JointUnit, float] = {ROTARY: math.radians(3.0), LINEAR: 1e-3}
"""Default of the largest difference between the servos of one joint, rad or m: backlash and the elasticity of
a loaded gear. [i]"""

MotorFile = Annotated[str, Field(min_length=1)]  # name of a motor file from `dxlrun identify`
_MOST_TOLERANCES: Mapping[JointUnit, float] = {ROTARY: math.radians(20.0), LINEAR: math.inf}
"""Largest tolerance between servos that a file may set: further apart they pull against each other. [i]"""


def _useful(value: Measure) -> Measure:
    if value > _MOST_TOLERANCES[value.joint_unit]:
        raise validation_error(
            "a tolerance between servos is 20 deg at most",
            "write for example 3 deg",
        )
    return value


Tolerance = Annotated[Position, Field(gt=0), AfterValidator(_useful)]
"""Largest difference between the servos of one joint in a file, as an angle or a length."""


class GoalTolerance(Form):
    """Form of `tolerance` of a joint: how near and how slow it must be to have reached its goal."""

    alone: ClassVar[str] = "position"
    """Key that is meant if the file has a single value in place of the mapping."""
    position: units.Tolerance | None = key(
        "Largest distance from the goal; 5 deg or 5 mm by default, inf for any distance.", "2 deg", None
    )
    velocity: RestSpeed | None = key(
        "Speed below which the joint is at rest; 5 deg/s or 5 mm/s by default, inf for any speed.",
        "2 deg/s",
        None,
    )
    time: Duration | None = key(
        "Time after the end of a motion within which the goal must be reached; 1 s by default.", "2 s", None
    )

    @model_validator(mode="before")
    @classmethod
    def _from_one_value(cls, data: object) -> object:
        return {cls.alone: data} if isinstance(data, str | int | float) else data

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of the mapping or of the single value that stands for it."""
        mapping = dict(handler.resolve_ref_schema(handler(core_schema)))
        values = [one for one in mapping["properties"][cls.alone]["anyOf"] if one != {"type": "null"}]
        return mapping | {"anyOf": [{"type": mapping.pop("type")}, *values]}


class SharedTolerance(GoalTolerance):
    """Form of `tolerance` of a joint with several servos, which may also differ from each other."""

    alone: ClassVar[str] = "servos"
    servos: Tolerance | None = key(
        "Largest difference between the joint positions of the servos; 3 deg or 1 mm by default.",
        "3 deg",
        None,
    )


def _whole(value: object) -> object:
    # True and 1.0 equal 1 in Python, but are not meant as a direction.
    if isinstance(value, bool | float):
        raise validation_error(
            "a direction is 1 or -1", "write 1 if the angles of joint and servo grow together, else -1"
        )
    return value


def _ordered(value: tuple[Measure, Measure]) -> tuple[Measure, Measure]:
    if not value[0] < value[1]:
        raise validation_error("the lower limit is not below the upper one", "write [lower, upper]")
    return value


Direction = Annotated[Literal[1, -1], BeforeValidator(_whole)]
ServoId = Annotated[int, Field(ge=0, le=253)]
GearRatio = Annotated[float, Field(ge=LEAST_RATIO, le=MOST_RATIO)]
TravelPerTurn = Annotated[Length, Field(ge=LEAST_TRAVEL_M, le=MOST_TRAVEL_M)]


class Limits(Form):
    """Form of `limits` of a joint; the gate enforces them on every goal before it is sent."""

    position: Annotated[tuple[Position, Position], Field(strict=False), AfterValidator(_ordered)] | None = (
        key(
            "Lower and upper position limit; the servo's range by default.",
            "[-90 deg, 90 deg]",
            None,
        )
    )
    velocity: Annotated[Speed, Field(gt=0)] | None = key(
        "Velocity limit; the servo's own by default.", "2 rad/s", None
    )
    acceleration: Annotated[Acceleration, Field(gt=0)] | None = key(
        "Acceleration limit of goals; unlimited by default.", "20 rad/s^2", None
    )
    effort: Effort | None = key(
        "Limit of commanded efforts, in the quantity that the servo measures: Nm, N, A or %.", "800 mA", None
    )


class ServoEntry(Form):
    """Base form of servos that are listed below a joint or a transmission."""


class OneOfServos(ServoEntry):
    """Form of one of several servos of a joint; keys that it lacks are those of the joint."""

    id: ServoId = key("ID of the servo.", "2")
    bus: str | None = key("Name of the servo's bus; the joint's by default.", "legs", None)
    model: str | None = key("Model of the servo; the joint's by default.", "MX-64", None, min_length=1)
    reference: Angle | None = key(
        "Angle of the servo at the joint's zero position, from tick 0; the joint's reference by default.",
        "180 deg",
        None,
    )
    direction: Direction | None = key(
        "Sense of rotation: 1 if the joint's position grows with the servo's angle, else -1; the "
        "joint's by default.",
        "-1",
        None,
    )
    motor: MotorFile | None = key("Motor file of the servo; the joint's by default.", "hip.motor.yaml", None)
