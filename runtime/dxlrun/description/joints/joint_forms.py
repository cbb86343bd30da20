"""Joints: the forms of an entry under `joints` of a robot file: with one, several, or no own servos.

`mechanics` describes how one or several servos move a joint.
"""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Optional, Self, TypeAlias, TypeVar, get_args

from msgspec.structs import replace
from pydantic import BeforeValidator, Discriminator, Field, Tag, WithJsonSchema, model_validator

from dxlrun.description.base_form import Form, key, validation_error, with_keys
from dxlrun.description.joints.joint_mechanics import (
    Direction,
    GearRatio,
    GoalTolerance,
    Limits,
    MotorFile,
    OneOfServos,
    ServoId,
    SharedTolerance,
    TravelPerTurn,
)
from dxlrun.description.mistakes.words import words_for
from dxlrun.description.units import (
    AlternativeQuantity,
    Angle,
    Duration,
    Inertia,
    Mass,
    TorqueOrForce,
    acceleration,
    position,
    speed,
    torque_or_force,
)
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import JointKey, ServoKey
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

if TYPE_CHECKING:  # it imports yaml, which a monitor in the module of a policy does not need
    from dxlrun.description.document import KeyPath

F = TypeVar("F", bound=Form)
LONGEST_RESPONSE_DELAY_NS, LONGEST_WRITE_TIME_NS = 1_000_000_000, 100_000_000
"""Upper bounds of two delays of simulated servos, ns; real servos are much faster."""


def _on_or_off(value: object) -> object:
    """Validate the words on and off, which are text in YAML 1.2, into a bool."""
    if isinstance(value, bool):
        return value
    if value not in ("on", "off"):
        raise validation_error("torque is on or off", "write `torque: off` for a limp joint")
    return value == "on"


OnOff = Annotated[
    bool,
    BeforeValidator(_on_or_off),
    WithJsonSchema({"anyOf": [{"type": "string", "enum": ["on", "off"]}, {"type": "boolean"}]}),
]


class JointSimulation(Form):
    """Form of `simulation` of a joint: load and delays of its simulated servos; real servos ignore it."""

    response_delay: Annotated[Duration, Field(le=LONGEST_RESPONSE_DELAY_NS)] = key(
        "Delay between an instruction to the servo and its effect on the motor; the delay in the "
        "motor file by default.",
        "20 ms",
        0,
    )
    write_time: Annotated[Duration, Field(le=LONGEST_WRITE_TIME_NS)] = key(
        "Time after a write during which the servo ignores instructions.", "1 ms", 0
    )
    motor: MotorFile | None = key(
        "Motor file of the simulated servo; the joint's motor file by default.",
        "other.motor.yaml",
        None,
    )
    inertia: Annotated[Inertia, Field(gt=0)] | None = key(
        "Moment of inertia of the joint's load; the load in the motor file by default.", "0.01 kg m^2", None
    )
    mass: Annotated[Mass, Field(gt=0)] | None = key("Mass of a linear joint's load.", "0.2 kg", None)
    friction: Annotated[TorqueOrForce, Field(ge=0)] | None = key(
        "Coulomb friction of the joint, in addition to the servo's own.", "0.05 Nm", None
    )
    gravity: Annotated[TorqueOrForce, Field(ge=0)] | None = key(
        "Torque of the weight in the horizontal position; for a linear joint, force of the weight "
        "towards lower positions.",
        "0.3 Nm",
        None,
    )
    gravity_angle: Angle | None = key("Joint angle at which the weight hangs straight down.", "0 deg", None)


class BareJoint(Form):
    """Form of a joint whose servos are in another section (`transmissions`); base of the other forms."""

    continuous: bool = key("Wheel or multi-turn joint, which needs no position limits.", "true", False)
    installed: bool = key(
        "Presence of the joint's servos on their bus; with false the joint is omitted.", "false", True
    )
    torque: OnOff = key(
        "Torque at the start of a run; with off the joint is limp until `dxlrun torque on`.", "off", True
    )
    limits: Limits = key(
        "Limits of position, velocity, acceleration and effort.",
        "{position: [-90 deg, 90 deg]}",
        Limits.of_defaults(),
    )
    tolerance: GoalTolerance = key(
        "Tolerance within which a goal counts as reached.",
        "{position: 2 deg, velocity: 2 deg/s, time: 2 s}",
        GoalTolerance.of_defaults(),
    )
    wrap: bool = key(
        "Shorter way to each goal, for continuous joints: whole turns do not matter.", "true", False
    )

    @model_validator(mode="after")
    def _wraps_where_continuous(self) -> Self:
        if self.wrap and not self.continuous:
            raise validation_error(
                "wrap is for continuous joints only",
                "write continuous: true, or remove wrap",
            )
        return self

    simulation: JointSimulation = key(
        "Load and delays of the joint's simulated servos.",
        "{inertia: 0.01 kg m^2}",
        JointSimulation.of_defaults(),
    )


class ServoJoint(BareJoint):
    """Base form of a joint with its own servos, where q = direction * (theta - reference) * ratio.

    A joint with `travel_per_turn` is linear: its positions are lengths.
    """

    bus: str = key("Name of the servo's bus.", "main")
    model: str = key(
        "Model of the servo (see `dxlrun models`), or auto to read it from the servo.", "AX-12A", min_length=1
    )
    reference: Angle = key("Angle of the servo at the joint's zero position, counted from tick 0.", "150 deg")
    direction: Direction = key(
        "Sense of rotation: 1 if the joint's position grows with the servo's angle, else -1.", "1"
    )
    gear_ratio: GearRatio = key("Gear ratio: servo turns per turn of the joint.", "2.5", 1.0)
    travel_per_turn: TravelPerTurn | None = key(
        "Travel per turn of the servo, which makes the joint linear.", "94.2 mm", None
    )
    motor: MotorFile | None = key(
        "Motor file of the servo, relative to the folder of the file that names it.", "elbow.motor.yaml", None
    )

    @property
    def unit(self) -> JointUnit:
        """Unit of the joint's positions: LINEAR (m) with `travel_per_turn`, else ROTARY (rad)."""
        return ROTARY if self.travel_per_turn is None else LINEAR

    @property
    def ratio(self) -> float:
        """Travel of the joint per rad of a servo, rad or m."""
        return 1.0 / self.gear_ratio if self.travel_per_turn is None else self.travel_per_turn / math.tau


class Joint(ServoJoint):
    """Form of a joint with one servo."""

    id: ServoId = key("ID of the servo.", "1")


class SharedJoint(ServoJoint):
    """Form of a joint that several servos move together; all get the same goal."""

    servos: Annotated[tuple[OneOfServos, ...], Field(strict=False, min_length=2)] = key(
        "Servos of the joint; the joint's keys are their defaults.",
        "[{id: 1}, {id: 2, direction: -1}]",
    )
    tolerance: SharedTolerance = key(
        "Tolerance within which a goal counts as reached, and largest difference between the servos.",
        "{servos: 3 deg, position: 2 deg}",
        SharedTolerance.of_defaults(),
    )


JointEntry: TypeAlias = Joint | SharedJoint | BareJoint
"""A joint of the robot file in one of its three forms."""


def _keys_of_a_servo() -> frozenset[str]:
    """Return the keys (such as `id`) that show that a joint has its own servo."""
    own = Joint.model_fields.keys() - BareJoint.model_fields.keys()
    return frozenset(own | {key.name for key in servo_keys()})


def keys_of_servos() -> frozenset[str]:
    """Return the keys that only joints with their own servos have, in any form."""
    return _keys_of_a_servo() | SharedJoint.model_fields.keys() - BareJoint.model_fields.keys()


def joint_conditions() -> tuple[tuple[str, dict[str, object]], ...]:
    """Return the names of the forms of joints with the JSON Schema condition that selects each."""
    own = [{"required": [key]} for key in sorted(_keys_of_a_servo())]
    return (("SharedJoint", {"required": ["servos"]}), ("Joint", {"anyOf": own}))


def kind_of_joint(joint: object) -> str:
    """Return the tag of a joint's form: `<one servo>`, `<several servos>` or `<no servo>`."""
    if isinstance(joint, dict):
        if "servos" in joint or isinstance(joint.get("id", joint.get("ids")), list):
            return "<several servos>"
        of_any = BareJoint.model_fields.keys() | {key.name for key in joint_keys()}
        surplus = {re.split(r"[ :=]", key)[0] for key in joint if key not in of_any}
        own = _keys_of_a_servo()
        if surplus and (surplus & own or surplus & words_for("BareJoint", own)):
            return "<one servo>"
        return "<no servo>"
    if isinstance(joint, SharedJoint):
        return "<several servos>"
    return "<one servo>" if isinstance(joint, Joint) or not isinstance(joint, BareJoint) else "<no servo>"


def joint_keys() -> list[JointKey[object]]:
    """Return the keys that installed features add to joints."""
    return [key for _, key in stages(JointKey, installed_features())]


def servo_keys() -> list[ServoKey[object]]:
    """Return the keys that installed features add to servos."""
    return [key for _, key in stages(ServoKey, installed_features())]


def servo_values(servo: Form, joint: Form | None = None) -> dict[str, object]:
    """Return the values of all features' keys of a servo, by key; missing ones are those of its joint."""
    found = {key.name: getattr(servo, key.name) for key in servo_keys()}
    return {
        name: value if joint is None or value is not None else getattr(joint, name)
        for name, value in found.items()
    }


def section_servo(form: type[F]) -> type[F]:
    """Return the form of a servo in a feature's section, extended by other features' servo keys."""
    return with_keys(form, [replace(key, field=key.of_section) for key in servo_keys()])


def joint_form() -> object:
    """Return the pydantic type of a joint: a union of its forms, extended by the features' keys."""
    every, servos = joint_keys(), servo_keys()
    optional = [replace(key, form=Optional[key.form], field=key.of_one) for key in servos]  # noqa: UP045  an object has no |
    one_of_servos = with_keys(OneOfServos, optional)
    several = Annotated[
        tuple[one_of_servos, ...],  # type: ignore[valid-type]  # made at run time
        Field(strict=False, min_length=2),
    ]
    own = with_keys(Joint, [*every, *servos])
    shared = with_keys(SharedJoint, [*every, *servos], servos=several)
    bare = with_keys(BareJoint, every)
    return Annotated[
        Annotated[own, Tag("<one servo>")]
        | Annotated[shared, Tag("<several servos>")]
        | Annotated[bare, Tag("<no servo>")],
        Discriminator(kind_of_joint),
    ]


def planned_keys(joint: BareJoint) -> dict[str, object]:
    """Return the features' keys that the file sets for a joint, in JSON types for the plan."""
    given = {key.name: getattr(joint, key.name) for key in joint_keys() if key.name in joint.model_fields_set}
    return {name: _planned(value) for name, value in given.items() if value is not None}


def _planned(value: object) -> object:
    """Convert a validated value into JSON types; quantities become numbers in SI units."""
    if isinstance(value, Form):
        return {name: _planned(getattr(value, name)) for name in type(value).model_fields}
    if isinstance(value, dict):
        return {name: _planned(each) for name, each in value.items()}
    if isinstance(value, tuple):
        return [_planned(each) for each in value]
    return float(value) if isinstance(value, float) else value


_MEASURES: Mapping["KeyPath", tuple[AlternativeQuantity, Mapping[JointUnit, str]]] = {
    ("limits", "position"): (position, {ROTARY: "[-90 deg, 90 deg]", LINEAR: "[0 mm, 40 mm]"}),
    ("limits", "velocity"): (speed, {ROTARY: "2 rad/s", LINEAR: "50 mm/s"}),
    ("limits", "acceleration"): (acceleration, {ROTARY: "20 rad/s^2", LINEAR: "500 mm/s^2"}),
    ("simulation", "friction"): (torque_or_force, {ROTARY: "0.05 Nm", LINEAR: "2 N"}),
    ("simulation", "gravity"): (torque_or_force, {ROTARY: "0.3 Nm", LINEAR: "1.5 N"}),
    ("tolerance",): (position, {ROTARY: "3 deg", LINEAR: "1 mm"}),
    ("tolerance", "servos"): (position, {ROTARY: "3 deg", LINEAR: "1 mm"}),
    ("tolerance", "position"): (position, {ROTARY: "2 deg", LINEAR: "2 mm"}),
    ("tolerance", "velocity"): (speed, {ROTARY: "2 deg/s", LINEAR: "2 mm/s"}),
}
"""Keys whose unit must fit the kind of joint (angle or length), each with an example for both kinds."""
_OF_OTHER_JOINTS: Mapping[JointUnit, Mapping["KeyPath", str]] = {
    ROTARY: {("simulation", "mass"): "write `inertia: 0.01 kg m^2`"},
    LINEAR: {
        ("gear_ratio",): "remove it; travel_per_turn replaces it",
        ("simulation", "inertia"): "write `mass: 0.2 kg`",
        ("simulation", "gravity_angle"): "remove it",
    },
}
"""Keys that joints of this kind cannot have, each with a fix."""


def misfits(joints: object) -> Iterator[tuple["KeyPath", str, str]]:
    """Yield keys and units that do not fit a rotary or linear joint: path, problem, and fix.

    `joints` is the section of the file; the model checks its form.
    """
    measures = {**_MEASURES}
    measures |= {(key.name,): (kind, key.examples) for key in joint_keys() for kind in _kinds_of(key)}
    for name, entry in joints.items() if isinstance(joints, dict) else ():
        unit = LINEAR if isinstance(entry, dict) and "travel_per_turn" in entry else ROTARY
        is_so = f"{name} {unit.verb}"
        for path, fix in _OF_OTHER_JOINTS[unit].items():
            if _written(entry, path) is not None:
                yield ("joints", name, *path), f"{is_so}, so {path[-1]} is not allowed", fix
        for path, (kind, examples) in measures.items():
            for step, written in _units(kind, _written(entry, path)):
                if JointUnit.find_by_quantity(written) is not unit:
                    what = f"{is_so}, so its {path[-1]} cannot be in {written}"
                    yield ("joints", name, *path, *step), what, f"write it as {examples[unit]}"


def units_of_key(key: JointKey[object]) -> dict[JointUnit, str]:
    """Return the SI unit of a key for rotary and linear joints; empty if it does not depend on that."""
    found: dict[JointUnit, str] = {}
    for kind in _kinds_of(key):
        for unit, example in key.examples.items():
            with suppress(ValueError):
                found[unit] = kind(example).unit
    return found


def _kinds_of(key: JointKey[object]) -> list[AlternativeQuantity]:
    """Return the quantities of a feature's key whose unit depends on the kind of joint; else nothing."""
    return [*_quantities(key.form)] if key.examples else []


def _quantities(form: object) -> Iterator[AlternativeQuantity]:
    """Yield the quantities (angle or length) in a pydantic type such as `Position | None`."""
    for part in get_args(form):
        if isinstance(part, AlternativeQuantity):
            yield part
        else:
            yield from _quantities(part)


def _written(entry: object, path: "KeyPath") -> object:
    for step in path:
        entry = entry.get(step) if isinstance(entry, dict) else None
    return entry


def _units(kind: AlternativeQuantity, value: object) -> Iterator[tuple["KeyPath", str]]:
    """Yield the SI units of a value or of the items of a list, with their index; skip unreadable ones."""
    places: list[tuple[KeyPath, object]] = [((), value)]
    if isinstance(value, list):
        places = [((index,), one) for index, one in enumerate(value)]
    for step, one in places:
        try:
            yield step, kind(one).unit
        except ValueError:
            continue
