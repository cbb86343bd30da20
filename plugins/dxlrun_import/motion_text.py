"""Motion text: points of another program's trajectory, written as a motion file for one controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dxlrun.tooling.files import Conversion, FileContent, ImportOptions
from dxlrun_import.checked_values import valid_name
from dxlrun_import.robot_draft import commented

CONTROLLER = "arm"
"""Controller that plays a motion unless --controller names one, as in imported robot files."""
SUSPICIOUS_RAD = 50.0
"""Positions beyond eight turns are in another unit, such as degrees or ticks."""
MOST_POINTS = 20_000


class MotionPoint(NamedTuple):
    """Point of a motion, with positions of joints, rad, and velocities where the source has them, rad/s."""

    time_s: float
    positions: Mapping[str, float]
    velocities: Mapping[str, float] = {}


def motion_conversion(
    content: FileContent,
    options: ImportOptions,
    origin: str,
    points: Sequence[MotionPoint],
    remarks: Sequence[str] = (),
) -> Conversion:
    """Return the text of a motion file with these points.

    Raises InputError if there are no points, too many, if their times do not ascend, or positions have
    another unit.
    """
    if not points:
        raise content.refusal("the file has no points", "export the motion again")
    if len(points) > MOST_POINTS:
        raise content.refusal(f"the file has {len(points)} points", f"give at most {MOST_POINTS}")
    before = -math.inf
    for number, point in enumerate(points, 1):
        if not before < point.time_s or point.time_s < 0:
            what = f"the time of point {number}, {point.time_s:g} s, is not after the one before it"
            raise content.refusal(what, "give times in s that ascend")
        before = point.time_s
        for joint, position in point.positions.items():
            if abs(position) > SUSPICIOUS_RAD:
                what = f"point {number} moves {joint} to {position:g} rad, beyond any servo"
                raise content.refusal(what, "check the unit; `--unit deg` reads degrees")
    joints = list(dict.fromkeys(joint for point in points for joint in point.positions))
    names = {joint: valid_name(joint) for joint in joints}
    if len(set(names.values())) < len(names):
        raise content.refusal("two joints have the same name in dxlrun", "rename one of them")
    remarks = [*remarks]
    remarks += [f"joint {joint} is {name} here" for joint, name in names.items() if joint != name]
    guessed = "" if options.controller else "  # guessed: a controller of your robot with these joints"
    lines = [
        f"# {options.name}: imported from {content.path.name}, {origin}.",
        *(["# Not taken over:"] if remarks else []),
        *(line for remark in remarks for line in commented(f"- {remark}")),
        "#",
        f"#   dxlrun ROBOT.yaml --play {options.name}.yaml",
        f"name: {options.name}",
        "",
        "motions:",
        f"  - controller: {options.controller or CONTROLLER}{guessed}",
        "    points:",
        *(_point(point, names) for point in points),
    ]
    return Conversion("\n".join(lines) + "\n", tuple(remarks))


def _point(point: MotionPoint, names: Mapping[str, str]) -> str:
    targets = ", ".join(
        f"{names[joint]}: {{position: {_number(position)} rad{_speed(point.velocities.get(joint))}}}"
        for joint, position in point.positions.items()
    )
    return f"      - {{time: {_number(point.time_s)} s, joints: {{{targets}}}}}"


def _speed(velocity: float | None) -> str:
    return "" if velocity is None else f", velocity: {_number(velocity)} rad/s"


def _number(value: float) -> str:
    return f"{round(value, 6) + 0.0:.12g}"
