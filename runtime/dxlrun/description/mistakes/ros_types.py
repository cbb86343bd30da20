"""ROS types: explains controller types of ros2_control and ros_control that are given in a robot file."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

from dxlrun.description.base_form import folded

_ROS_TYPE = re.compile(r"[a-z0-9_]+(?:/|::)([A-Z]\w*)")
_ROS_TYPES: Mapping[str, str] = {
    "forward_command_controller": "joint_group_position_controller",
    "gripper_action_controller": "gripper_controller",
    "joint_state_controller": "joint_state_broadcaster",
    "joint_velocity_controller": "joint_group_velocity_controller",
    "joint_effort_controller": "joint_group_effort_controller",
}
"""Controller types of ros2_control and ros_control with another name in dxlrun, and that name."""


def ros_type(type_name: str, known: Collection[str]) -> tuple[str, str, str] | None:
    """Explain a controller type of ROS: return problem, fix, and dxlrun's type.

    Args:
        type_name: As written: `position_controllers/JointGroupPositionController`.
        known: Types of dxlrun.

    Returns:
        None if it is not a type of ROS. The third text is empty if dxlrun has no such type.
    """
    match = _ROS_TYPE.fullmatch(type_name)
    if match is None:
        return None
    name = folded(match[1])
    ours = name if name in known else _ROS_TYPES.get(name, "")
    fix = f"write {ours}" if ours in known else "choose a type of dxlrun; `dxlrun plugins` lists them"
    return f"{type_name} is a type of ROS", fix, ours if ours in known else ""
