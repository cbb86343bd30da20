"""Signatures: files that are named, with the next step, and not converted."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

from dxlrun.tooling.files import FileContent, FileFormat

_DRAFT = "`dxlrun scan PORT --output robot.yaml` writes a draft of a robot file"
_ROSBAGS = (
    "`rosbags-convert --src {path} --dst {stem} --dst-storage mcap` (from `pip install rosbags`) converts it "
    "to MCAP for `dxlrun replay --on` and `dxlrun convert`"
)
_PAGES = (
    "write its pages as motions of a keyframe_player; `dxlrun examples bioloid_torso_keyframes` copies a "
    "robot with such motions"
)
_EPISODE = "write one episode as CSV, with times and joints, and import that; docs/how-to/import.md"
_ACTION_BYTES, _ACTION_PAGE = 131072, 512
"""Bytes of ROBOTIS' action file: 256 pages of 512"""
_PYTHON = re.compile(
    r"(?:\s*#.*\n)*\s*(from [\w.]+ import |import [\w.]+\s*(as \w+)?\s*$|def \w+\(|\"\"\")", re.MULTILINE
)


def _is_action(content: FileContent) -> bool:
    """Recognize ROBOTIS' action file: all pages have their checksum, one byte that makes their sum 255."""
    data = content.data
    pages = [data[first : first + _ACTION_PAGE] for first in range(0, len(data), _ACTION_PAGE)]
    return len(data) == _ACTION_BYTES and all(sum(page) & 0xFF == 0xFF for page in pages)


def _is_dataset(content: FileContent) -> bool:
    return {"codebase_version", "features"} <= content.values.keys()


def _is_bag(content: FileContent) -> bool:
    return "rosbag2_bagfile_information" in content.values


def _is_lerobot(content: FileContent) -> bool:
    """Recognize a configuration of LeRobot by the arms in it, or by the keys of its first version."""
    data = content.values
    if {"leader_arms", "follower_arms", "robot_type"} & data.keys() and "buses" not in data:
        return True
    return bool(_arms(content))


def _arms(content: FileContent) -> list[Mapping[str, object]]:
    data = content.values
    parts = [data.get(key) for key in ("robot", "teleop", "follower", "leader")]
    parts += [] if {"buses", "joints"} & data.keys() else [data]
    arms = [part for part in parts if isinstance(part, dict) and isinstance(part.get("type"), str)]
    return [arm for arm in arms if not {"port", "id", "cameras", "left_arm_port"}.isdisjoint(arm)]


def _is_lerobot_of(words: str) -> Callable[[FileContent], bool]:
    return lambda content: any(re.search(words, str(arm["type"])) for arm in _arms(content))


def _is_unexpanded(content: FileContent) -> bool:
    text = content.text
    return text.lstrip()[:1] == "<" and re.search(r"<xacro:|\$\{|\$\(", text) is not None


def _is_python(content: FileContent) -> bool:
    return _PYTHON.match(content.text) is not None


def _is_ros2_parameters(content: FileContent) -> bool:
    data = content.values
    return _has_key(data, "ros__parameters", 3) or not {"controller_manager", "/**"}.isdisjoint(data)


def _has_key(value: object, key: str, levels: int) -> bool:
    if not isinstance(value, dict) or not levels:
        return False
    return key in value or any(_has_key(inner, key, levels - 1) for inner in value.values())


def _is_calibration(content: FileContent) -> bool:
    return {"homing_offset", "drive_mode", "motor_names"} <= content.values.keys()


def _is_ros_one(content: FileContent) -> bool:
    data = content.values
    return not {"buses", "joints"} & data.keys() and _has_ros_type(data, 4)


def _has_ros_type(value: object, levels: int) -> bool:
    if not isinstance(value, dict) or not levels:
        return False
    kind = value.get("type")
    is_ros = isinstance(kind, str) and re.fullmatch(r"[a-z0-9_]+(?:/|::)[A-Z]\w*", kind) is not None
    return is_ros or any(_has_ros_type(inner, levels - 1) for inner in value.values())


_LEROBOT = "a configuration of LeRobot"
FIRST = (
    FileFormat(
        "a recording in MCAP",
        lambda content: content.data.startswith(b"\x89MCAP0\r\n"),
        "`dxlrun analyze {path}` evaluates a log of dxlrun, `dxlrun replay {path}` plays it, "
        "`dxlrun convert {path} motion.yaml` converts it to a motion file",
    ),
    FileFormat("a ROS 1 bag", lambda content: content.data.startswith(b"#ROSBAG V"), _ROSBAGS),
    FileFormat(
        "a ROS 2 bag in SQLite, or another database",
        lambda content: content.data.startswith(b"SQLite format 3\0"),
        _ROSBAGS,
    ),
    FileFormat(
        "a ROS 2 bag",
        _is_bag,
        "`dxlrun convert {path} motion.yaml --controller NAME` converts its directory to a motion file, "
        "docs/how-to/replay.md",
    ),
    FileFormat(
        "a table in Parquet, as in a dataset of LeRobot",
        lambda content: content.data.startswith(b"PAR1"),
        _EPISODE,
    ),
    FileFormat(
        "the description of a dataset of LeRobot",
        _is_dataset,
        _EPISODE,
    ),
    FileFormat(
        "an action file of ROBOTIS (OP2, OP3)",
        _is_action,
        _PAGES,
    ),
    FileFormat(
        "a xacro file, which makes a URDF",
        _is_unexpanded,
        "expand it by `xacro {path} > {stem}.urdf`, and import that",
    ),
)
"""Signatures that are compared before the formats with a converter."""
LAST = (
    FileFormat(
        "a URDF without servos: it has no ros2_control block with IDs",
        lambda content: content.top == "robot",
        "write `model: {urdf: {name}}` in a robot file; " + _DRAFT,
    ),
    FileFormat(
        "a model of MuJoCo (MJCF): a body without servos",
        lambda content: content.top in ("mujoco", "mujocoinclude"),
        _DRAFT + "; docs/reference/simulation.md has what moves simulated bodies",
    ),
    FileFormat(
        "a model of Gazebo (SDF): a body without servos", lambda content: content.top == "sdf", _DRAFT
    ),
    FileFormat(
        "a motion file of R+ Motion (.mtnx)",
        lambda content: content.top == "Root" and content.xml.get("type") == "motion",
        _PAGES,
    ),
    FileFormat("XML", lambda content: bool(content.top), f"give a robot file in YAML; {_DRAFT}"),
    FileFormat(
        _LEROBOT,
        _is_lerobot_of(r"so_?10[01]|lekiwi"),
        "use arms with Dynamixel servos; dxlrun does not support Feetech servos",
    ),
    FileFormat(_LEROBOT, _is_lerobot_of("koch"), "`dxlrun examples koch` copies a robot file for these arms"),
    FileFormat(
        _LEROBOT,
        _is_lerobot,
        _DRAFT + "; `dxlrun import CALIBRATION.json --type TYPE` takes over its calibration",
    ),
    FileFormat(
        "a parameter file of ROS 2 (ros2_control)",
        _is_ros2_parameters,
        f"{_DRAFT}; docs/how-to/from-ros2-control.md has its terms next to ours",
    ),
    FileFormat(
        "a calibration of LeRobot, of its first version",
        _is_calibration,
        "calibrate the arm with a newer LeRobot, or by `dxlrun calibrate robot.yaml`",
    ),
    FileFormat(
        "a parameter file of ROS",
        _is_ros_one,
        f"{_DRAFT}; docs/how-to/ros2.md explains how dxlrun and ROS 2 work together",
    ),
    FileFormat(
        "a program in Python",
        _is_python,
        "to use a controller in it, write `type: ./{name}:CLASS` in a robot file",
    ),
)
"""Signatures that are compared after the formats with a converter, the most general ones last."""
