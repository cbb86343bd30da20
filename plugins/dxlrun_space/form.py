"""Form of the section `tip_poses` of the robot file."""

import math
from typing import Annotated, Final, Self

from pydantic import AfterValidator, Field, model_validator

from dxlrun import Angle, Length
from dxlrun.tooling.features import Section
from dxlrun.tooling.files import Form, Name, key
from dxlrun.tooling.robots import from_rpy

NORM: Final = 1e-3
"""Largest difference of a quaternion's length from 1: three decimals of each number."""


def at_most_a_turn(value: float) -> float:
    """Return an angle, rad; raise ValueError if it is more than a turn."""
    if abs(value) > 2 * math.pi:
        raise ValueError(
            f"{value:g} rad is more than a turn; write at most a turn, with its unit, such as 90deg"
        )
    return value


def check_turns(quaternion: tuple[float, ...] | None, *others: tuple[float, ...] | None) -> None:
    """Raise ValueError for more than one orientation, or a quaternion that is not of length 1."""
    if sum(each is not None for each in (quaternion, *others)) > 1:
        raise ValueError("give only one of rpy, drpy and quaternion; remove the others")
    if quaternion is not None and abs(math.hypot(*quaternion) - 1) > NORM:
        raise ValueError(f"the quaternion has length {math.hypot(*quaternion):.4g}; scale it to length 1")


def rotation_of(
    quaternion: tuple[float, float, float, float] | None, rpy: tuple[float, float, float] | None
) -> tuple[float, float, float, float] | None:
    """Return an orientation as a quaternion of length 1; None: none is given."""
    if quaternion is None:
        return None if rpy is None else from_rpy(rpy)
    length, (x, y, z, w) = math.hypot(*quaternion), quaternion
    return x / length, y / length, z / length, w / length


_Place = Annotated[Length, Field(ge=-100, le=100)]  # As in the command `pose`
_Turn = Annotated[Angle, AfterValidator(at_most_a_turn)]
_Turns = Annotated[tuple[_Turn, _Turn, _Turn], Field(strict=False)]
_Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]


class TipPose(Form):
    """Form of a pose of a link, which becomes positions of the joints that move the link."""

    tip: str = key("Link of the URDF that has the pose.", "gripper_link", min_length=1)
    base: str = key("Link above the tip in whose axes the pose is; empty: the root.", "base_link", "")
    x: _Place = key("Position of the tip.", "20 cm")
    y: _Place = key("Position of the tip.", "0 cm")
    z: _Place = key("Position of the tip.", "15 cm")
    rpy: _Turns | None = key(
        "Roll, pitch and yaw. Without it any orientation. `dxlrun check` compares it with what the "
        "controllers of the robot file need; a running robot moves to the joints of the pose, and compares "
        "nothing.",
        "[0 deg, 40 deg, 0 deg]",
        None,
    )
    quaternion: _Quaternion | None = key("Orientation x, y, z, w in place of `rpy`.", "[0, 0, 0, 1]", None)
    near: dict[Name, Angle] = key(
        "Joints of the solution to prefer, where there are several.", "{elbow: 9 deg}", {}
    )

    @model_validator(mode="after")
    def _has_one_orientation(self) -> Self:
        check_turns(self.quaternion, self.rpy)
        return self


STAGE: Section[dict[str, TipPose]] = Section(
    "tip_poses",
    dict[Name, TipPose],
    key("Poses of links by name. Each is also a pose of its joints.", "{above: {tip: hand, x: 20 cm}}", {}),
    before="policies",
)
