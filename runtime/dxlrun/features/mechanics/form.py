"""Form of the section `transmissions` of a robot file: several servos that move several joints together."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from dxlrun.description.base_form import Form, Name, key, with_keys
from dxlrun.description.joints.joint_forms import section_servo
from dxlrun.description.joints.joint_mechanics import (
    Direction,
    GearRatio,
    MotorFile,
    ServoEntry,
    ServoId,
    Tolerance,
)
from dxlrun.description.units import Angle
from dxlrun.features.feature import Section


class TransmissionServo(ServoEntry):
    """Form of one servo of a transmission; its position is that of an input, not of a joint."""

    bus: str = key("Name of the servo's bus.", "main")
    id: ServoId = key("ID of the servo.", "1")
    model: str = key(
        "Model of the servo (see `dxlrun models`), or auto to read it from the servo.",
        "XL430-W250",
        min_length=1,
    )
    reference: Angle = key(
        "Angle of the servo at the zero position of the transmission's joints, counted from tick 0.",
        "180 deg",
    )
    direction: Direction = key(
        "Sense of rotation: 1 if the transmission's input grows with the servo's angle, else -1.", "1"
    )
    gear_ratio: GearRatio = key("Gear ratio: servo turns per turn of the transmission's input.", "2.5", 1.0)
    motor: MotorFile | None = key(
        "Motor file of the servo, relative to the folder of the file that names it.", "wrist.motor.yaml", None
    )


class Transmission(Form):
    """Form of one transmission: its joints, its servos, and the matrix from servo to joint positions."""

    type: Literal["differential", "matrix"] = key(
        "Kind of transmission: differential (half of the sum and half of the difference of two servos) "
        "or matrix (see `matrix`).",
        "differential",
    )
    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = key(
        "Joints that the transmission moves, each in one transmission at most.", "[roll, pitch]"
    )
    servos: dict[Name, TransmissionServo] = key(
        "Servos of the transmission, by name.", "{left: {bus: main, id: 1, ...}}", min_length=1
    )
    matrix: (
        Annotated[
            tuple[Annotated[tuple[float, ...], Field(strict=False, min_length=1)], ...],
            Field(strict=False, min_length=1),
        ]
        | None
    ) = key(
        "Matrix with a row for each joint and a column for each servo, in the order of the file, rad/rad.",
        "[[0.5, 0.5], [0.5, -0.5]]",
        None,
    )
    tolerance: Tolerance | None = key(
        "Largest disagreement of the servos if they outnumber the joints; 3 deg by default.",
        "3 deg",
        None,
    )


def _form() -> object:
    """Return the pydantic type of the section; its servos also have the servo keys of other features."""
    servos = {"servos": dict[Name, section_servo(TransmissionServo)]}  # type: ignore[misc]  # made at run time
    return dict[Name, with_keys(Transmission, (), **servos)]  # type: ignore[misc]  # as above


def _moved_joints(section: object) -> Iterator[str]:
    """Yield the names under `joints` of all transmissions in a section that may contain mistakes."""
    for entry in section.values() if isinstance(section, dict) else ():
        names = entry.get("joints") if isinstance(entry, dict) else None
        yield from map(str, names if isinstance(names, list) else ())


STAGE: Section[dict[str, Transmission]] = Section(
    "transmissions",
    _form,
    key(
        "Transmissions by name: servos that move several joints together.",
        "{wrist: {type: differential, joints: [roll, pitch], ...}}",
        {},
    ),
    before="controllers",
    moved_joints=_moved_joints,
)
