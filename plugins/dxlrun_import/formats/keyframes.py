"""bit-bots keyframes: the JSON animations of the robot Wolfgang.

Source: the animations of bit-bots/bitbots_main and their README: a keyframe has `goals` in degrees, the
`duration` of the way to it and a `pause`, s. Stiffness and torque of keyframes are optional.
"""

from __future__ import annotations

import math

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import list_at, mapping_at, number_at
from dxlrun_import.motion_text import MotionPoint, motion_conversion

_USED = {"name", "duration", "pause", "goals"}
_ABOUT = {"author", "description", "last_edited", "name", "version", "hostname", "keyframes"}
LEAD_S = 1.0
"""Time of the way to the first keyframe if its own is 0, s."""


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert each keyframe to a point, and its pause to another one."""
    points: list[MotionPoint] = []
    unused: set[str] = set()
    time = 0.0
    for index in range(len(list_at(content, "keyframes"))):
        at = ("keyframes", index)
        unused |= mapping_at(content, *at).keys() - _USED
        goals = mapping_at(content, *at, "goals")
        pose = {joint: math.radians(number_at(content, *at, "goals", joint)) for joint in goals}
        time += number_at(content, *at, "duration", default=0.0) or (0.0 if points else LEAD_S)
        pause = number_at(content, *at, "pause", default=0.0)
        still = dict.fromkeys(pose, 0.0)
        points.append(MotionPoint(time, pose, still))
        if pause:
            time += pause
            points.append(MotionPoint(time, pose, still))
    remarks = [f"{key} of keyframes: has no equivalent in a motion file" for key in sorted(unused)]
    remarks += [f"{key}: has no equivalent" for key in sorted(content.values.keys() - _ABOUT)]
    if len({frozenset(point.positions) for point in points}) > 1:
        remarks.append("keyframes with some joints only: the controller may want all of its joints")
    return motion_conversion(content, options, FORMAT.name, points, remarks)


def _matches(content: FileContent) -> bool:
    frames = content.values.get("keyframes")
    return isinstance(frames, list) and any(isinstance(one, dict) and "goals" in one for one in frames)


FORMAT = FileFormat(
    "a keyframe animation of bit-bots", _matches, convert=f"{__name__}:convert", makes="motion"
)
