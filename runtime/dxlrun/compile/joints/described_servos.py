"""Described servos: all servos that a robot file names, in joints or features, before models are known.

The servos of a file also decide which features it uses, because a feature's key can be a servo's key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import ClassVar

import msgspec

from dxlrun.description.document import KeyPath, Marks
from dxlrun.description.joints.joint_forms import Joint, ServoJoint, SharedJoint, servo_values
from dxlrun.description.reading import Description
from dxlrun.errors import Mark
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import Feature, JointKey, PolicyKey, PoseStage, Section, ServoKey, Stage
from dxlwire.joint_unit import JointUnit

AUTO = "auto"  # in place of a model, which is then read from the servo


class DescribedServo(msgspec.Struct, frozen=True):
    """A servo as the robot file describes it; keys that it lacks come from its joint."""

    title: str  # name of its load in messages: `head`, `hip`, `wrist/left`
    name: str  # its own name: `head`, `hip/1`, `wrist/left`
    joints: tuple[str, ...]  # joints that it moves
    place: KeyPath  # path of its keys in the file
    defaults: KeyPath  # path of its default keys; equal to `place` for the only servo of a joint
    bus: str
    id: int
    model: str
    reference: float  # rad from the servo's raw 0
    direction: int
    ratio: float  # travel of its load per rad of the servo: rad or m
    unit: JointUnit  # unit of its load's positions
    continuous: bool
    torque: bool
    keys: Mapping[str, object]  # keys of features; `ServoKey.value_of` returns one with its type
    motor: str | None

    @property
    def servo(self) -> str:
        """Text for messages, `ID 3 on bus arm`."""
        return f"ID {self.id} on bus {self.bus}"

    def mark(self, marks: Marks, *path: str | int) -> Mark:
        """Return line and column of one of the servo's keys, or of the joint's key that applies to it."""
        own = (*self.place, *path)
        return (
            marks.value(*own) if marks.has(own[: len(self.place) + 1]) else marks.value(*self.defaults, *path)
        )


class ServoStage(msgspec.Struct, frozen=True):
    """Hook `STAGE` in a feature's `servos.py`: returns the servos in the feature's section of the file."""

    FILE: ClassVar[str] = "servos"

    describe: Callable[[Description], Iterable[DescribedServo]]


def described_servos(description: Description) -> list[DescribedServo]:
    """Return all servos of a robot file: those of joints in file order, then those of features."""
    found: list[DescribedServo] = []
    for name, joint in description.robot.joints.items():
        if isinstance(joint, ServoJoint):
            found += _of_joint(name, joint)
    for _, stage in stages(ServoStage, installed_features()):
        found += stage.describe(description)
    return found


def used_features(description: Description) -> tuple[Feature, ...]:
    """Return the features that a robot file needs: all built-in ones, and plug-ins whose keys it has."""
    robot, marks = description.robot, description.marks
    servos = described_servos(description)
    parents: dict[type[Stage], list[KeyPath]] = {
        Section: [()],
        PolicyKey: [("policies",), *(("policies", "groups", name) for name in robot.policies.groups)],
        PoseStage: [("poses", name) for name in robot.poses],
        JointKey: [("joints", name) for name in robot.joints],
        ServoKey: [place for servo in servos for place in (servo.place, servo.defaults)],
    }

    def is_used(feature: Feature) -> bool:
        kinds = (kind for kind in parents if feature.stage(kind) is not None)
        return any(marks.has((*parent, feature.name)) for kind in kinds for parent in parents[kind])

    return tuple(each for each in installed_features() if not each.distribution or is_used(each))


def find_unknown_servos(description: Description) -> frozenset[str]:
    """Return the names of the servos with `model: auto`, whose models must be read from the bus."""
    return frozenset(servo.name for servo in described_servos(description) if servo.model == AUTO)


def first_joints(description: Description) -> dict[str, str]:
    """Return the first joint of each servo, by the name of the servo."""
    return {servo.name: servo.joints[0] for servo in described_servos(description)}


def _of_joint(name: str, joint: ServoJoint) -> Iterator[DescribedServo]:
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
