"""Twins: `left_x` and `right_x`, which a body that is the same on both sides mounts as mirror images."""

from __future__ import annotations

import math

from dxlrun.compile.checks.problems import Problems
from dxlrun.compile.joint.reach import degrees, servo_travel
from dxlrun.description import Description
from dxlrun.dynamixel.control_table import ControlTable

_SAME = math.radians(1.0)
"""References nearer than this are taken as equal: a horn has teeth, a trim has not."""


def check_twins(description: Description, tables: dict[str, ControlTable], problems: Problems) -> None:
    """Warn of each pair of joints that is no mirror image of itself.

    Mirrored, the right servo counts from the other end and turns the other way:
    reference_right = lowest + highest angle of the servo - reference_left, direction_right = -direction_left.
    """
    joints = description.robot.joints
    for name, left in joints.items():
        twin = name.replace("left", "right", 1)
        right = joints.get(twin)
        if twin == name or right is None or left.model != right.model or name not in tables:
            continue
        travel = servo_travel(tables[name])
        expected = travel.lower + travel.upper - left.reference
        if abs(expected - right.reference) > _SAME:
            problems.warning(
                description.marks.value("joints", twin, "reference"),
                f"{twin} is no mirror image of {name}: its reference is {degrees(right.reference)} deg, "
                f"mirrored it would be {degrees(expected)} deg",
                "correct one of the two references, or ignore this if the body is not symmetric there",
            )
        if right.direction == left.direction:
            problems.warning(
                description.marks.value("joints", twin, "direction"),
                f"{twin} is no mirror image of {name}: both have direction {left.direction:+d}",
                f"write direction: {-left.direction:+d}, or ignore this if the body is not symmetric there",
            )
