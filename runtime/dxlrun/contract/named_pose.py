"""Named pose: declares the fields that have positions by joint, and forms of poses in place of positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar, Final, Generic, TypeVar

import msgspec
from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic_core import CoreSchema

from dxlrun.features import installed_features, stages
from dxlrun.plan.loop_plan import JointPlan

F = TypeVar("F", bound=BaseModel)


class PoseStage(msgspec.Struct, Generic[F], frozen=True):
    """Hook `STAGE` in a feature's `pose_form.py`: a form of poses, such as the place of a link.

    Motion files and parameters of controllers can have a pose in this form in place of a name.
    """

    FILE: ClassVar[str] = "pose_form"

    key: str
    """Key that every pose in this form has, such as `tip`; poses by joint have none that is not a joint."""
    form: type[F]
    solve: Callable[[F, str | None, Mapping[str, JointPlan]], Mapping[str, float]]
    """Returns the positions of joints, rad or m, for a pose, the text of the URDF and all joints; raises
    ValueError with the text `problem; fix`."""


class NamedPose(msgspec.Struct, frozen=True):
    """Marker of positions by joint, for which a pose is accepted: `Annotated[dict[str, Angle], NAMED_POSE]`.

    A pose is a name, or in the form of a `PoseStage`. The class gets its positions: in parameters as texts
    with units, in a command as numbers in SI.
    """

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, object]:
        """Return the JSON Schema of positions, a name, or a pose in the form of a feature."""
        forms = [
            {"type": "object", "required": [stage.key]}
            for _, stage in stages(PoseStage, installed_features())
        ]
        return {"anyOf": [handler(schema), {"type": "string"}, *forms]}


NAMED_POSE: Final = NamedPose()
