"""Form of the section `tip_poses` of the robot file."""

from typing import TYPE_CHECKING, Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from dxlrun import Angle, Length
from dxlrun.tooling.features import Section
from dxlrun.tooling.files import Form, Name, key
from dxlrun_space.orientation_checks import at_most_a_turn, check_turns

if TYPE_CHECKING:
    from dxlrun_space.space_goals import PoseCommand

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

    def as_command(self) -> "PoseCommand":
        """Return the pose as a command."""
        # Imported here because every robot file needs this form, and few have a pose of a link.
        from dxlrun_space.space_goals import PoseCommand

        return PoseCommand.model_validate(self.model_dump(include={"x", "y", "z", "rpy", "quaternion"}))


STAGE: Section[dict[str, TipPose]] = Section(
    "tip_poses",
    dict[Name, TipPose],
    key("Poses of links by name. Each is also a pose of its joints.", "{above: {tip: hand, x: 20 cm}}", {}),
    before="policies",
)
