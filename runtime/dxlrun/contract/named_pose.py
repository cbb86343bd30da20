"""Named pose: declares the fields that accept a pose in place of positions by joint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, TypeAlias

import msgspec
from pydantic import BaseModel, GetJsonSchemaHandler, WithJsonSchema, model_validator
from pydantic_core import CoreSchema

from dxlrun.features import installed_features, stages
from dxlrun.features.feature import PoseStage


class JointPose(BaseModel, frozen=True):
    """Pose in a command: positions of joints."""

    positions: Mapping[str, float]
    """Positions by joint, rad or m."""
    remark: str = ""
    """Part of the pose that the joints do not reach, for the end of the goal; empty: none."""

    @model_validator(mode="before")
    @classmethod
    def _gather_positions(cls, pose: object) -> object:
        """Accept positions by joint."""
        is_posed = isinstance(pose, dict) and isinstance(pose.get("positions"), dict)
        return pose if is_posed else {"positions": pose}


class NamedPose(msgspec.Struct, frozen=True):
    """Marker of positions by joint, for which a pose is accepted: `Annotated[dict[str, Angle], NAMED_POSE]`.

    A pose is a name, or in the form of a `PoseStage`. Parameters get its positions as texts with units. The
    field of a command is a `GoalPose`.
    """

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, object]:
        """Return the JSON Schema of positions, a name, or a pose in the form of a feature."""
        forms = [
            {"type": "object", "required": [stage.name]}
            for _, stage in stages(PoseStage, installed_features())
        ]
        return {"anyOf": [handler(schema), {"type": "string"}, *forms]}


NAMED_POSE: Final = NamedPose()

GoalPose: TypeAlias = Annotated[
    JointPose, WithJsonSchema({"type": "object", "additionalProperties": {"type": "number"}}), NAMED_POSE
]
"""Field of a command that is a pose."""
