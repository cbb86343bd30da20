"""Form of the section `tip_poses` of the robot file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dxlrun import Angle, Length
from dxlrun.tooling.features import Section
from dxlrun.tooling.files import Form, Name, key

_Place = Annotated[Length, Field(ge=-100, le=100)]  # As in the command `pose`
_Turns = Annotated[tuple[Angle, Angle, Angle], Field(strict=False)]
_Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]


class TipPose(Form):
    """Form of a pose of a link, which becomes positions of the joints that move the link."""

    tip: str = key("Link of the URDF that has the pose.", "gripper_link", min_length=1)
    base: str = key("Link above the tip in whose axes the pose is; empty: the root.", "base_link", "")
    x: _Place = key("Position of the tip.", "20 cm")
    y: _Place = key("Position of the tip.", "0 cm")
    z: _Place = key("Position of the tip.", "15 cm")
    rpy: _Turns | None = key(
        "Roll, pitch and yaw. Without it any orientation.", "[0 deg, 40 deg, 0 deg]", None
    )
    quaternion: _Quaternion | None = key("Orientation x, y, z, w in place of `rpy`.", "[0, 0, 0, 1]", None)
    near: dict[Name, Angle] = key(
        "Joints of the solution to prefer, where there are several.", "{elbow: 9 deg}", {}
    )


STAGE: Section[dict[str, TipPose]] = Section(
    "tip_poses",
    dict[Name, TipPose],
    key("Poses of links by name. Each is also a pose of its joints.", "{above: {tip: hand, x: 20 cm}}", {}),
    before="policies",
)
