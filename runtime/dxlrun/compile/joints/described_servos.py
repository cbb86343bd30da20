"""Servos as the robot file has them: those of joints, with what a joint has for all, and of features.

The file's servos decide which features it uses, as a key may be that of a servo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import msgspec

from dxlrun.description.document import KeyPath, Marks
from dxlrun.description.joints.joints import Joint, ServoJoint, SharedJoint, servo_values
from dxlrun.description.reading import Description
from dxlrun.errors import Mark
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import Feature, JointKey, PolicyKey, Section, ServoKey, Stage
from dxlwire.joint_unit import JointUnit

AUTO = "auto"  # In place of a model: it is read from the servo


class DescribedServo(msgspec.Struct, frozen=True):
    """One servo as the robot file has it, with what its joint has for it."""

    title: str  # What it moves, as sentences name it: `head`, `hip`, `wrist/left`
    name: str  # Its own: `head`, `hip/1`, `wrist/left`
    joints: tuple[str, ...]  # The joints that it moves
    place: KeyPath  # Of its keys in the file
    defaults: KeyPath  # Where what it does not have itself is; the same place for the only servo of a joint
    bus: str
    id: int
    model: str
    reference: float  # rad from the servo's raw 0
    direction: int
    ratio: float  # What it moves while it turns by 1 rad: rad or m
    unit: JointUnit  # Of the positions of what it moves
    continuous: bool
    torque: bool
    keys: Mapping[str, object]  # Of features; `ServoKey.of` returns one with its type
    motor: str | None

    @property
    def servo(self) -> str:
        """ID and bus, as sentences name it."""
        return f"ID {self.id} on bus {self.bus}"

    def mark(self, marks: Marks, *path: str | int) -> Mark:
        """Return the place of one of its values, which may be its joint's."""
        own = (*self.place, *path)
        return (
            marks.value(*own) if marks.has(own[: len(self.place) + 1]) else marks.value(*self.defaults, *path)
        )


@dataclass(frozen=True)
class ServoStage:
    """`STAGE` of `servos.py`: called for the servos that a feature's section has, before models are known."""

    FILE: ClassVar[str] = "servos"

    describe: Callable[[Description], Iterable[DescribedServo]]


def described_servos(description: Description) -> list[DescribedServo]:
    """Return all servos of a file: those of the joints in their order, then those of features."""
    found: list[DescribedServo] = []
    for name, joint in description.robot.joints.items():
        if isinstance(joint, ServoJoint):
            found += _of_joint(name, joint)
    for _, stage in stages(ServoStage, installed_features()):
        found += stage.describe(description)
    return found


def used_features(description: Description) -> tuple[Feature, ...]:
    """Return our features, and those of plug-ins whose sections or keys the file has."""
    robot, marks = description.robot, description.marks
    servos = described_servos(description)
    parents: dict[type[Stage], list[KeyPath]] = {
        Section: [()],
        PolicyKey: [("policies",), *(("policies", "groups", name) for name in robot.policies.groups)],
        JointKey: [("joints", name) for name in robot.joints],
        ServoKey: [place for servo in servos for place in (servo.place, servo.defaults)],
    }

    def is_used(feature: Feature) -> bool:
        kinds = (kind for kind in parents if feature.stage(kind) is not None)
        return any(marks.has((*parent, feature.name)) for kind in kinds for parent in parents[kind])

    return tuple(each for each in installed_features() if not each.distribution or is_used(each))


def find_unknown_servos(description: Description) -> frozenset[str]:
    """Return the names of the servos with `model: auto`, whose models are read from them."""
    return frozenset(servo.name for servo in described_servos(description) if servo.model == AUTO)


def first_joints(description: Description) -> dict[str, str]:
    """Return the joint that each servo moves, or the first one, by the name of the servo."""
    return {servo.name: servo.joints[0] for servo in described_servos(description)}


def _of_joint(name: str, joint: ServoJoint) -> Iterator[DescribedServo]:
    """Yield the servos of a joint."""
    place: KeyPath = ("joints", name)
    servos = joint.servos if isinstance(joint, SharedJoint) else ()
    for index in range(max(len(servos), 1)):
        own = servos[index] if servos else None
        yield DescribedServo(
            title=name,
            name=name if own is None else f"{name}/{index + 1}",
            joints=(name,),
            place=place if own is None else (*place, "servos", index),
            defaults=place,
            bus=joint.bus if own is None or own.bus is None else own.bus,
            id=own.id if own is not None else joint.id if isinstance(joint, Joint) else -1,
            model=joint.model if own is None or own.model is None else own.model,
            reference=joint.reference if own is None or own.reference is None else own.reference,
            direction=joint.direction if own is None or own.direction is None else own.direction,
            ratio=joint.ratio,
            unit=joint.unit,
            continuous=joint.continuous,
            torque=joint.torque,
            keys=servo_values(joint) if own is None else servo_values(own, joint),
            motor=joint.motor if own is None or own.motor is None else own.motor,
        )
