"""Joints of a robot file: their forms, told apart by their keys, and what simulated servos move.

How one or several servos move a joint is in `mechanics`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import BeforeValidator, Discriminator, Field, Tag, WithJsonSchema

from dxlrun.description.form import Form, Name, refuse
from dxlrun.description.joints.mechanics import (
    TOLERANCE_M,
    TOLERANCE_RAD,
    Direction,
    GearRatio,
    Limits,
    LinearLimits,
    MotorFile,
    OneOfServos,
    Register,
    ServoId,
    Tolerance,
    TravelPerTurn,
)
from dxlrun.description.units import Angle, Duration, Force, Inertia, Length, Mass, Torque

LONGEST_RESPONSE_DELAY_NS, LONGEST_WRITE_TIME_NS = 1_000_000_000, 100_000_000
"""Of simulated servos; real ones are quicker by far."""


def _on_or_off(value: object) -> object:
    """Return true or false for the words on and off, which YAML 1.2 takes for texts."""
    if isinstance(value, bool):
        return value
    if value not in ("on", "off"):
        raise refuse("torque is on or off", "write `torque: off` for a joint that is to be limp")
    return value == "on"


class ServoSimulation(Form):
    """How slow a simulated servo is, and its motor; a servo on a real port does not use it."""

    response_delay: Annotated[Duration, Field(le=LONGEST_RESPONSE_DELAY_NS)] = Field(
        default=0,
        description="Time between an instruction to the servo and its effect on the motor.",
        examples=["20 ms"],
    )
    write_time: Annotated[Duration, Field(le=LONGEST_WRITE_TIME_NS)] = Field(
        default=0,
        description="Time after a write in which the servo receives nothing.",
        examples=["1 ms"],
    )
    motor: MotorFile | None = Field(
        default=None,
        description="Motor file of the simulated servo, where that shall be another motor than the joint's.",
        examples=["other.motor.yaml"],
    )


class JointSimulation(ServoSimulation):
    """What simulated servos move, at their joint, and how slow they are."""

    inertia: Annotated[Inertia, Field(gt=0)] | None = Field(
        default=None, description="Moment of inertia of what it moves.", examples=["0.01 kg m^2"]
    )
    friction: Annotated[Torque, Field(ge=0)] | None = Field(
        default=None, description="Friction of the joint, at every speed.", examples=["0.05 Nm"]
    )
    gravity: Annotated[Torque, Field(ge=0)] | None = Field(
        default=None, description="Torque of the weight when it sticks out horizontally.", examples=["0.3 Nm"]
    )
    gravity_angle: Angle | None = Field(
        default=None,
        description="Angle of the joint where the weight hangs straight down.",
        examples=["0 deg"],
    )


class LinearSimulation(ServoSimulation):
    """What simulated servos move of a linear joint, and how slow they are."""

    refused: ClassVar[Mapping[str, str]] = {
        "inertia": "a linear joint has a mass; write `mass: 0.2 kg`",
        "gravity_angle": "a linear joint has its weight everywhere; take gravity_angle out",
    }

    mass: Annotated[Mass, Field(gt=0)] | None = Field(
        default=None, description="Mass of what it moves.", examples=["0.2 kg"]
    )
    friction: Annotated[Force, Field(ge=0)] | None = Field(
        default=None, description="Friction of the joint, at every speed.", examples=["2 N"]
    )
    gravity: Annotated[Force, Field(ge=0)] | None = Field(
        default=None, description="Weight that pulls towards lower positions.", examples=["1.5 N"]
    )


OnOff = Annotated[
    bool,
    BeforeValidator(_on_or_off),
    WithJsonSchema({"anyOf": [{"type": "string", "enum": ["on", "off"]}, {"type": "boolean"}]}),
]


class AnyJoint(Form):
    """What every joint has, whatever moves it."""

    continuous: bool = Field(
        default=False,
        description="A wheel, or a joint of many turns; it needs no position limits.",
        examples=["true"],
    )
    torque: OnOff = Field(
        default=True,
        description="off: it is limp from the start, until `dxlrun torque on`.",
        examples=["off"],
    )


class ServoJoint(AnyJoint):
    """A joint with a servo of its own, or several: s = direction * (theta - reference) of each."""

    bus: str = Field(description="Name of its bus.", examples=["main"])
    model: str = Field(
        min_length=1, description="Model of its servo, or auto: it is asked.", examples=["AX-12A"]
    )
    reference: Angle = Field(
        description="Angle of the servo, from its zero, where the joint's is zero.", examples=["150 deg"]
    )
    direction: Direction = Field(
        description="1: the joint's angle grows as the servo's does, -1: against it.", examples=["1"]
    )
    registers: dict[Name, Register] = Field(
        default={},
        description="What its servo's control table shall hold: written at the start where it differs.",
        examples=["{position_p_gain: 800, return_delay_time: 0 us}"],
    )
    motor: MotorFile | None = Field(
        default=None,
        description="Motor file of its servo, from the folder of the file that says it.",
        examples=["elbow.motor.yaml"],
    )


class Turning(Form):
    """A joint that turns."""

    simulation: JointSimulation = Field(
        default=JointSimulation(),
        description="What its servos move when they are simulated.",
        examples=["{inertia: 0.01 kg m^2}"],
    )
    limits: Limits = Field(
        default=Limits(),
        description="Where it may go, and how fast.",
        examples=["{position: [-90 deg, 90 deg]}"],
    )


class Geared(Turning):
    """A joint that turns by one servo, or by several on its axis."""

    gear_ratio: GearRatio = Field(
        default=1.0, description="Turns of the servo for one turn of the joint.", examples=["2.5"]
    )


class Sliding(Form):
    """A linear joint: its positions are lengths."""

    travel_per_turn: TravelPerTurn = Field(
        description="How far the joint moves in one turn of the servo; makes it a linear joint.",
        examples=["94.2 mm"],
    )
    limits: LinearLimits = Field(
        default=LinearLimits(),
        description="Where it may go, and how fast.",
        examples=["{position: [0 mm, 40 mm]}"],
    )
    simulation: LinearSimulation = Field(
        default=LinearSimulation(),
        description="What its servos move when they are simulated.",
        examples=["{mass: 0.2 kg}"],
    )


class OneServo(ServoJoint):
    """A joint with one servo."""

    id: ServoId = Field(description="ID of its servo.", examples=["1"])


class SeveralServos(ServoJoint):
    """A joint with several servos, which get equal goals."""

    servos: Annotated[tuple[OneOfServos, ...], Field(strict=False, min_length=2)] = Field(
        description="Its servos; what one does not have is the joint's.",
        examples=["[{id: 1}, {id: 2, direction: -1}]"],
    )


class Joint(Geared, OneServo):
    """One joint and its servo: q = direction * (theta - reference) / gear_ratio."""


class LinearJoint(Sliding, OneServo):
    """A linear joint: q = direction * (theta - reference) * travel_per_turn / turn."""


class SharedJoint(Geared, SeveralServos):
    """One joint that several servos move."""

    tolerance: Tolerance = Field(
        default=TOLERANCE_RAD,
        description="By how much its servos may disagree, as an angle of the joint.",
        examples=["3 deg"],
    )


class LinearSharedJoint(Sliding, SeveralServos):
    """One linear joint that several servos move."""

    tolerance: Annotated[Length, Field(gt=0)] = Field(
        default=TOLERANCE_M, description="By how much its servos may disagree.", examples=["1 mm"]
    )


class TransmittedJoint(Turning, AnyJoint):
    """One joint of a transmission, which has the servos."""


def kind_of_joint(joint: object) -> str:
    """Return which of the forms of a joint an entry has, by the keys that only one of them has."""
    if isinstance(joint, dict):
        linear, shared = "travel_per_turn" in joint, "servos" in joint
        if linear:
            return "<linear joint, several servos>" if shared else "<linear joint>"
        if shared:
            return "<several servos>"
        return "<one servo>" if _OF_A_SERVO.intersection(joint) else "<transmission>"
    kinds: tuple[tuple[type[AnyJoint], str], ...] = (
        (Joint, "<one servo>"),
        (LinearJoint, "<linear joint>"),
        (SharedJoint, "<several servos>"),
        (LinearSharedJoint, "<linear joint, several servos>"),
        (TransmittedJoint, "<transmission>"),
    )
    return next((kind for model, kind in kinds if isinstance(joint, model)), "<one servo>")


_OF_A_SERVO = frozenset(OneServo.model_fields) - frozenset(AnyJoint.model_fields)
"""Keys of a joint with a servo of its own; one without any is moved by a transmission."""

KEYS_OF_SERVOS = frozenset(
    key for form in (SharedJoint, LinearSharedJoint, Joint, LinearJoint) for key in form.model_fields
) - frozenset(TransmittedJoint.model_fields)
"""Keys that a joint of a transmission does not have."""

JOINT_FORMS = (
    ("LinearSharedJoint", {"required": ["travel_per_turn", "servos"]}),
    ("LinearJoint", {"required": ["travel_per_turn"]}),
    ("SharedJoint", {"required": ["servos"]}),
    ("Joint", {"anyOf": [{"required": [key]} for key in sorted(_OF_A_SERVO)]}),
)
"""The same for editors, as JSON Schemas: the first that fits counts; what fits none may be any form."""

JointEntry = Annotated[
    Annotated[Joint, Tag("<one servo>")]
    | Annotated[LinearJoint, Tag("<linear joint>")]
    | Annotated[SharedJoint, Tag("<several servos>")]
    | Annotated[LinearSharedJoint, Tag("<linear joint, several servos>")]
    | Annotated[TransmittedJoint, Tag("<transmission>")],
    Discriminator(kind_of_joint),
]
