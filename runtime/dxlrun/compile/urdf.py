"""URDF of the robot file: that it can be read, and that it has the same joints and limits.

It is only shown and recorded; the robot file alone limits a joint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.compile.joints import CompiledJoint
from dxlrun.compile.limits import Interval
from dxlrun.compile.problems import Problems
from dxlrun.description import Description
from dxlrun.description.source.syntax import read_text
from dxlrun.errors import InputError, Mark

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_TURNING = ("revolute", "continuous")
_SLIDING = "prismatic"
"""Drawn as a slide although a servo turns, as grippers are: its limits are m and cannot be compared."""


def compile_urdf(
    description: Description, joints: Mapping[str, CompiledJoint], problems: Problems
) -> str | None:
    """Return the text of the robot's URDF; None when the file names none, or it cannot be read."""
    model = description.robot.model
    if model is None:
        return None
    mark = description.marks.value("model", "urdf")
    path = Path(mark.file).parent / model.urdf
    if not path.exists():
        problems.error(
            mark,
            f"there is no URDF {model.urdf}",
            "check the name, which counts from the folder of this file",
        )
        return None
    try:
        text = read_text(path, "URDF")
    except InputError as error:
        problems.extend(error.problems)
        return None
    root = _parsed(text, str(path), problems)
    if root is None:
        return None
    drawn = {element.get("name", ""): element for element in root.iter("joint")}
    _check_names(description, joints, drawn, problems)
    for name, joint in joints.items():
        if name in drawn:
            _check_joint(description, joint, drawn[name], problems)
    return text


def _parsed(text: str, file: str, problems: Problems) -> Element | None:
    from xml.etree import ElementTree  # only a robot with a URDF pays for it

    # entities can be files of this machine, or grow without end; a URDF needs none, so no DTD is read
    start = text.find("<!DOCTYPE")
    if start >= 0:
        line = text.count("\n", 0, start) + 1
        column = start - (text.rfind("\n", 0, start) + 1) + 1
        problems.error(Mark(file, line, column), "a DOCTYPE is refused", "take it out")
        return None
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 (no DTD, so no entities; at most 1 MiB)
    except ElementTree.ParseError as error:
        line, column = error.position
        what = f"this is not XML ({str(error).partition(':')[0]})"
        problems.error(Mark(file, line, column + 1), what, "correct it")
        return None
    if root.tag != "robot":
        problems.error(Mark(file), f"the top element is {root.tag}, not robot", "name a URDF file")
        return None
    return root


def _check_names(
    description: Description,
    joints: Mapping[str, CompiledJoint],
    drawn: Mapping[str, Element],
    problems: Problems,
) -> None:
    mark = description.marks.value("model", "urdf")
    missing = [name for name in joints if name not in drawn]
    if missing:
        problems.warning(
            mark,
            f"the URDF has no joint {', '.join(missing)}",
            "give the joints of both files the same names; until then these are not shown",
        )
    movable = (*_TURNING, _SLIDING)
    stiff = [name for name in joints if name in drawn and drawn[name].get("type") not in movable]
    if stiff:
        problems.warning(mark, f"the URDF does not let {', '.join(stiff)} turn", "make it revolute there")


def _check_joint(
    description: Description, joint: CompiledJoint, element: Element, problems: Problems
) -> None:
    """Compare limits, rad and rad/s."""
    limit = element.find("limit")
    if limit is None or element.get("type") not in _TURNING:
        return
    name, marks = joint.plan.name, description.marks
    lower, upper, speed = (_number(limit.get(key)) for key in ("lower", "upper", "velocity"))
    allowed = Interval(joint.plan.lower, joint.plan.upper)
    if element.get("type") == "revolute" and lower is not None and upper is not None:
        shown = Interval(lower, upper)
        if not shown.contains(allowed):
            problems.warning(
                marks.value("joints", name, "limits", "position"),
                f"{name} may move {allowed}, beyond its limits in the URDF, {shown}",
                "make both alike",
            )
    limit_speed = joint.described.limits.velocity
    if speed and limit_speed is not None and limit_speed > speed:
        problems.warning(
            marks.value("joints", name, "limits", "velocity"),
            f"{name} may move at {limit_speed:g} rad/s, faster than in the URDF, {speed:g} rad/s",
            "make both alike",
        )


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
