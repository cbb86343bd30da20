"""Foreign files: recognizes files of other programs given as a robot file, and says what to do instead."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from dxlrun.description.base_form import folded

Kind = tuple[str, str]
"""Sentence that says what the file is (`this is ...`), and the fix."""

_DRAFT = "`dxlrun scan PORT --output robot.yaml` writes a draft of a robot file"
_ROSBAGS = (
    "`rosbags-convert --src {path} --dst {stem} --dst-storage mcap` (from `pip install rosbags`) converts it "
    "to MCAP for `dxlrun replay --on` and `dxlrun convert`"
)
_MAGIC: Mapping[bytes, Kind] = {
    b"\x89MCAP0\r\n": (
        "this is a recording in MCAP",
        "`dxlrun analyze {path}` evaluates a log of dxlrun, `dxlrun replay {path}` plays it",
    ),
    b"#ROSBAG V": ("this is a ROS 1 bag", _ROSBAGS),
    b"SQLite format 3\0": ("this is a ROS 2 bag in SQLite, or another database", _ROSBAGS),
}
LONGEST_MAGIC = max(map(len, _MAGIC))
"""Number of bytes at a file's start that `kind_of_bytes` needs."""
_TEXTS: tuple[tuple[re.Pattern[str], Kind], ...] = (
    (
        re.compile(r"\s*type=motion\b|.*^page_begin\s*$|\s*<Root type=\"motion\"", re.M | re.S),
        (
            "this is a motion file of RoboPlus (R+ Motion)",
            "write its pages as motions of a keyframe_player; "
            "`dxlrun examples bioloid_torso_keyframes` copies a robot with such motions",
        ),
    ),
    (
        re.compile(r".*xmlns:xacro=", re.S),
        (
            "this is a xacro file: a body without servos",
            "convert it by `xacro {path} > {stem}.urdf`, and write `model: {urdf: {stem}.urdf}` in a robot "
            "file",
        ),
    ),
    (
        re.compile(r"\s*(<\?xml.*?\?>)?\s*(<!--.*?-->\s*)*<robot\b", re.S),
        (
            "this is a URDF: a body without servos",
            "write `model: {urdf: {name}}` in a robot file; " + _DRAFT,
        ),
    ),
    (re.compile(r"\s*<(\?xml|[A-Za-z])"), ("this is XML", f"give a robot file in YAML; {_DRAFT}")),
    (
        re.compile(
            r"(?:\s*#.*\n)*\s*(from [\w.]+ import |import [\w.]+\s*(as \w+)?\s*$|def \w+\(|\"\"\")", re.M
        ),
        (
            "this is a program in Python",
            "give a robot file; for a controller, write `type: ./{name}:CLASS` in it",
        ),
    ),
)


def kind_of_bytes(data: bytes, path: Path) -> Kind | None:
    """Return what a binary file is by its first bytes, with the fix; None if it is not known."""
    return next((_filled(kind, path) for magic, kind in _MAGIC.items() if data.startswith(magic)), None)


def kind_of_text(text: str, path: Path) -> Kind | None:
    """Return what a text file of another program is (URDF, Python), with the fix; None if it is not known."""
    return next((_filled(kind, path) for pattern, kind in _TEXTS if pattern.match(text)), None)


def kind_of_data(data: Mapping[str, object], path: Path) -> Kind | None:
    """Return what a YAML or JSON file of another program is, with the fix; None if it is not known."""
    kind = next(_kinds(data), None)
    return None if kind is None else _filled(kind, path)


def _filled(kind: Kind, path: Path) -> Kind:
    fix = kind[1].replace("{path}", str(path)).replace("{stem}", path.stem).replace("{name}", path.name)
    return kind[0], fix


def _kinds(data: Mapping[str, object]) -> Iterator[Kind]:
    values = [value for value in data.values() if isinstance(value, dict)]
    if _has_key(data, "ros__parameters", 3) or not {"controller_manager", "/**"}.isdisjoint(data):
        yield (
            "this is a parameter file of ROS 2 (ros2_control)",
            f"{_DRAFT}; docs/how-to/ros2.md explains how dxlrun and ROS 2 work together",
        )
    elif not {"buses", "joints"} & data.keys() and _has_ros_type(data, 4):
        yield (
            "this is a parameter file of ROS",
            f"{_DRAFT}; docs/how-to/ros2.md explains how dxlrun and ROS 2 work together",
        )
    if {"motorgroups", "motors"} <= data.keys():
        yield (
            "this is a configuration of pypot",
            _DRAFT + "; write angle_limit as `limits: {position: ...}`, orientation as `direction`",
        )
    if (lerobot := _lerobot(data)) is not None:
        yield "this is a configuration of LeRobot", lerobot
    if _is_calibration(data) or (values and all(map(_is_calibration, values))):
        yield (
            "this is a calibration of LeRobot",
            f"{_DRAFT}, and `dxlrun calibrate robot.yaml` measures its joints",
        )
    if values and all("ID" in value for value in values):
        yield "this is a configuration of ROBOTIS' dynamixel_workbench", _DRAFT


def _has_key(value: object, key: str, levels: int) -> bool:
    if not isinstance(value, dict) or not levels:
        return False
    return key in value or any(_has_key(inner, key, levels - 1) for inner in value.values())


def _has_ros_type(value: object, levels: int) -> bool:
    if not isinstance(value, dict) or not levels:
        return False
    kind = value.get("type")
    return (isinstance(kind, str) and _ROS_TYPE.fullmatch(kind) is not None) or any(
        _has_ros_type(inner, levels - 1) for inner in value.values()
    )


def _is_calibration(value: Mapping[str, object]) -> bool:
    return "homing_offset" in value and not {"range_min", "drive_mode"}.isdisjoint(value)


def _lerobot(data: Mapping[str, object]) -> str | None:
    """Return the fix for a configuration of LeRobot; None if the data are not one."""
    parts = [data.get(key) for key in ("robot", "teleop", "follower", "leader")]
    if "buses" not in data and "joints" not in data:
        parts.append(data)
    arms = [part for part in parts if isinstance(part, dict) and isinstance(part.get("type"), str)]
    arms = [arm for arm in arms if not {"port", "id", "cameras", "left_arm_port"}.isdisjoint(arm)]
    if not arms and ("buses" in data or not {"leader_arms", "follower_arms", "robot_type"} & data.keys()):
        return None
    types = " ".join(str(arm["type"]) for arm in arms)
    if re.search(r"so_?10[01]|lekiwi", types):
        return "use arms with Dynamixel servos; dxlrun does not support Feetech servos"
    if "koch" in types:
        return "`dxlrun examples koch` copies a robot file for these arms"
    port = next((arm["port"] for arm in arms if "port" in arm), "PORT")
    return _DRAFT.replace("PORT", str(port))


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
