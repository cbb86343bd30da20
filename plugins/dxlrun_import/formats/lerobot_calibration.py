"""LeRobot: the calibration of an arm in JSON.

Source: what huggingface/lerobot does with a calibration of Dynamixel servos (motors_bus.py, koch_follower.py,
omx_follower.py, omx_leader.py, koch_leader.py): the present position has Homing Offset added, 0 deg is the
middle between range_min and range_max, ticks of 4096 a turn, and drive_mode is the register's reversed bit.
The file names neither the robot nor the models; arms with Feetech servos have files of the same form.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import whole_at
from dxlrun_import.robot_draft import AUTO, DraftBus, JointDraft, RobotDraft

_XL430, _XL330, _XL330_M077 = "XL430-W250", "XL330-M288", "XL330-M077"
_ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
TYPES: Mapping[str, Mapping[str, str]] = {
    "koch_follower": dict(zip(_ARM, (_XL430, _XL430, *(_XL330,) * 4), strict=True)),
    "koch_leader": dict.fromkeys(_ARM, _XL330_M077),
    "omx_follower": dict(zip(_ARM, (*(_XL430,) * 3, *(_XL330,) * 3), strict=True)),
    "omx_leader": dict(zip(_ARM, (*(_XL330,) * 5, _XL330_M077), strict=True)),
    "viperx": dict.fromkeys(("shoulder", "elbow"), "XM540-W270"),
    "widowx": dict.fromkeys(("shoulder", "elbow"), "XM430-W350"),
}
"""Models by joint of each type of arm; those without models are read at the start."""
_FEETECH = r"so_?10[01].*|lekiwi.*|hope_?jr.*"
_TICK_DEG = 360 / 4096
_SHADOW = "_shadow"


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the calibration of an arm whose type `--type` names."""
    if re.fullmatch(_FEETECH, options.type):
        fix = "use an arm with Dynamixel servos"
        raise content.refusal(f"arms of type {options.type} have Feetech servos", fix)
    if options.type not in TYPES:
        what = f"the type {options.type} is not known" if options.type else "the file does not name its robot"
        raise content.refusal(what, f"give `--type` and one of {', '.join(TYPES)}")
    models = TYPES[options.type]
    draft = RobotDraft(content, FORMAT.name, options.name)
    draft.buses["main"] = DraftBus(2.0, 1_000_000, comment="guessed: baud_rate, LeRobot's default")
    joints = {name: _joint(content, name, models.get(name, AUTO), draft) for name in content.values}
    for name, joint in joints.items():
        shadow = joints.get(f"{name}{_SHADOW}")
        more = () if shadow is None else ((shadow.id, -joint.direction),)
        if not name.endswith(_SHADOW):
            draft.add_joint(joint._replace(more=more))
    if missing := models.keys() - joints.keys():
        what = f"the calibration has no {', '.join(sorted(missing))}, so it is not one of a {options.type}"
        raise content.refusal(what, "give the type of the arm that it is of")
    if "gripper" in joints:
        draft.remarks.append("gripper: LeRobot counts from 0 to 100 over its range; here it has degrees")
    return draft.conversion()


def _joint(content: FileContent, name: str, model: str, draft: RobotDraft) -> JointDraft:
    number, drive, offset, low, high = (
        whole_at(content, name, key)
        for key in ("id", "drive_mode", "homing_offset", "range_min", "range_max")
    )
    if low >= high:
        what = f"range_min {low} of {name} is not below range_max {high}"
        raise content.refusal(what, "calibrate this joint again", name)
    if high - low > 4096 or drive not in (0, 1):
        what = f"range {low} to {high} or drive_mode {drive} of {name} is not one of a Dynamixel servo"
        raise content.refusal(what, "check which arm the file is of", name)
    if drive:
        draft.remarks.append(
            f"drive_mode {drive} of {name}: its direction has it; a run needs 0 in the register, which "
            "`dxlrun servo PORT ID set` writes"
        )
    middle = ((low + high) / 2 - offset) * _TICK_DEG
    return JointDraft(
        name,
        number,
        content.mark(name),
        model,
        reference=(360 - middle if drive else middle) % 360,
        direction=-1 if drive else 1,
        limits=((low - high) / 2 * _TICK_DEG, (high - low) / 2 * _TICK_DEG),
        comment=f"LeRobot: homing_offset {offset}, range {low} to {high}",
    )


def _matches(content: FileContent) -> bool:
    keys = {"id", "homing_offset", "range_min", "range_max"}
    values = content.values.values()
    return bool(values) and all(isinstance(one, dict) and keys <= one.keys() for one in values)


FORMAT = FileFormat(
    "a calibration of LeRobot",
    _matches,
    "`dxlrun import {path} --type TYPE --output robot.yaml` converts it to a robot file",
    convert=f"{__name__}:convert",
)
