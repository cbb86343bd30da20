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
_ACTION_BYTES, _ACTION_PAGE = (65536, 131072), 512
"""Bytes of ROBOTIS' action files: pages of 512"""
_MCAP = b"\x89MCAP0\r\n"
_PYTHON = re.compile(
    r"(?:\s*#.*\n)*\s*(from [\w.]+ import |import [\w.]+\s*(as \w+)?\s*$|def \w+\(|\"\"\")", re.MULTILINE
)


def _is_action(content: FileContent) -> bool:
    """Recognize ROBOTIS' action file: pages have their checksum, one byte that makes their sum 255.

    Pages that were never written do not.
    """
    data = content.data
    pages = [data[first : first + _ACTION_PAGE] for first in range(0, len(data), _ACTION_PAGE)]
    good = sum(sum(page) & 0xFF == 0xFF for page in pages)
    return len(data) in _ACTION_BYTES and good > len(pages) / 2


def _mcap_header(content: FileContent) -> tuple[str, bool] | None:
    """Return the profile in the header of an MCAP file, and whether dxlrun wrote it; None for other files."""
    data = content.data
    if not data.startswith(_MCAP):
        return None
    size = int.from_bytes(data[len(_MCAP) + 9 : len(_MCAP) + 13], "little")
    profile = data[len(_MCAP) + 13 :][:size]
    library = data[len(_MCAP) + 17 + size :][:6]
    return profile.decode(errors="replace"), library == b"dxlrun"


def _is_modes(content: FileContent) -> bool:
    groups = [content.values.get(key) for key in ("groups", "singles")]
    entries = [one for group in groups if isinstance(group, dict) for one in group.values()]
    keys = {"torque_enable", "operating_mode"}
    return bool(entries) and all(isinstance(one, dict) and keys & one.keys() for one in entries)


def _has_keys(*keys: str) -> Callable[[FileContent], bool]:
    return lambda content: {*keys} <= content.values.keys()


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
        "a recording of ROS 2 in MCAP",
        lambda content: _mcap_header(content) == ("ros2", False),
        "`dxlrun convert {path} motion.yaml --controller NAME` converts its joint states to a motion file; "
        "docs/how-to/replay.md",
    ),
    FileFormat(
        "a recording of another program in MCAP",
        lambda content: _mcap_header(content) not in (None, ("ros2", True)),
        _EPISODE,
    ),
    FileFormat(
        "a log of dxlrun",
        lambda content: _mcap_header(content) is not None,
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
        "an action file of ROBOTIS (OP2, OP3, older Bioloid)",
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
        "a file of modes of an Interbotix arm",
        _is_modes,
        "give it with the arm's motor configuration: `dxlrun import ARM.yaml --modes {path}`",
    ),
    FileFormat(
        "a list of controllers of MoveIt",
        _has_keys("moveit_simple_controller_manager"),
        "import the parameter file of ros2_control, or the URDF; docs/how-to/from-ros2-control.md",
    ),
    FileFormat(
        "a pose of the ROBOTIS Framework (ini_pose)",
        _has_keys("mov_time", "tar_pose"),
        "import the `.robot` file, and write the angles as a pose of the robot file",
    ),
    FileFormat(
        "a file of offsets of the ROBOTIS Framework",
        lambda content: content.values.keys() in ({"offset"}, {"offset", "init_pose_for_offset_tuner"}),
        "import the `.robot` file, and add the offsets to `reference` of its joints",
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
