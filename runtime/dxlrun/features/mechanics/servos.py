"""Servos in the section `transmissions` of a robot file, in the common form for all servos."""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.compile.joints.described_servos import DescribedServo, ServoStage
from dxlrun.description.joints.joint_forms import servo_values
from dxlrun.description.reading import Description
from dxlrun.features.mechanics import form
from dxlwire.joint_unit import ROTARY


def describe_servos(description: Description) -> Iterator[DescribedServo]:
    """Yield the servos of all transmissions in a robot file, in file order."""
    robot = description.robot
    for name, transmission in form.STAGE.section_of(robot).items():
        moved = [robot.joints[joint] for joint in transmission.joints if joint in robot.joints]
        for key, servo in transmission.servos.items():
            place = ("transmissions", name, "servos", key)
            yield DescribedServo(
                title=f"{name}/{key}",
                name=f"{name}/{key}",
                joints=transmission.joints,
                place=place,
                defaults=place,
                bus=servo.bus,
                id=servo.id,
                model=servo.model,
                reference=servo.reference,
                direction=servo.direction,
                ratio=1.0 / servo.gear_ratio,
                unit=ROTARY,
                continuous=any(joint.continuous for joint in moved),
                torque=all(joint.torque for joint in moved),
                keys=servo_values(servo),
                motor=servo.motor,
            )


STAGE = ServoStage(describe_servos)
