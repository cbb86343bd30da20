"""URDF: reads the robot's URDF, compares it with the joints of the robot file, and plans its frames.

Joints and their limits come from the robot file alone. The URDF shows the body, in the log and in frames, and
provides the simulation's masses. Most differences are therefore warnings.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import msgspec

from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.limits import Interval, limits_of
from dxlrun.compile.problems import RobotFile
from dxlrun.description.document import read_text
from dxlrun.description.frames.tree import ORIENTATION, FramesPlan, FrameTree
from dxlrun.errors import InputError, suggestion
from dxlsim.geometry.urdf import SLIDING, TURNING, Urdf, UrdfJoint, read_urdf
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

TYPES: Mapping[JointUnit, tuple[str, ...]] = {ROTARY: TURNING, LINEAR: (SLIDING,)}
"""Types that a joint of the URDF may have for a joint with this unit."""
_UNLIKE: Mapping[JointUnit, tuple[str, str, str]] = {
    ROTARY: (
        "slides",
        "angles",
        "add travel_per_turn here, or make it revolute in the URDF and add a prismatic mimic joint",
    ),
    LINEAR: ("turns", "lengths", "make it prismatic in the URDF"),
}
"""Words for a joint of this unit whose URDF joint has the other kind: what the URDF does to it, what its
positions are, and the fix."""


class CompiledUrdf(msgspec.Struct, frozen=True):
    """The URDF of a robot: its text, its parsed tree, and the joints that it shares with the robot file."""

    text: str
    urdf: Urdf
    moved: tuple[str, ...]  # joints of the robot file that move a joint of the URDF


def compile_urdf(file: RobotFile, joints: Mapping[str, CompiledJoint]) -> CompiledUrdf | None:
    """Read the URDF that a robot file names and compare its joints; None if there is none or it is wrong."""
    model = file.robot.model
    if model is None:
        return None
    mark = file.at("model", "urdf")
    path = Path(mark.file).parent / model.urdf
    if not path.exists():
        file.error(
            mark,
            f"URDF {model.urdf} not found",
            "check the name; it is relative to the folder of this file",
        )
        return None
    try:
        text = read_text(path, "URDF")
        urdf = read_urdf(text, str(path))
    except InputError as error:
        file.extend(error.problems)
        return None
    drawn = {joint.name: joint for joint in urdf.joints}
    _check_names(file, joints, drawn)
    for name, joint in joints.items():
        if name in drawn:
            _check_limits(file, joint, drawn[name])
    moved = tuple(name for name, joint in joints.items() if name in drawn and _alike(joint, drawn[name]))
    return CompiledUrdf(text, urdf, moved)


def compile_frames(
    file: RobotFile, body: CompiledUrdf | None, states: Mapping[str, Collection[str]]
) -> FramesPlan | None:
    """Return the plan for logging the robot's frames; None without a URDF or if `model.imu` is wrong.

    Args:
        file: Robot file; collects the problems.
        body: The robot's URDF.
        states: Names of the states of devices, sensors and controllers, by source.
    """
    model = file.robot.model
    if model is None or body is None:
        return None
    imu, mark = model.imu or "", file.at("model", "imu")
    if imu and imu not in states:
        turning = [name for name, own in states.items() if set(ORIENTATION) <= set(own)]
        what = f"model.imu {imu} is not a device, sensor or controller with states"
        file.error(mark, what, suggestion(imu, turning))
        return None
    if imu and not set(ORIENTATION) <= set(states[imu]):
        file.error(
            mark,
            f"model.imu {imu} has no orientation (x, y, z, w)",
            f"add an imu_sensor_broadcaster for {imu}, and write its name",
        )
        return None
    try:
        tree = FrameTree(body.urdf, body.moved, imu, model.imu_link or "")
    except InputError as error:
        for problem in error.problems:
            file.error(mark, problem.what, problem.fix)
        return None
    if model.imu_link and not imu:
        file.warning(
            file.at("model", "imu_link"),
            "model.imu_link is given without model.imu",
            "add imu, or remove imu_link",
        )
    return FramesPlan(model.frames_rate, body.moved, imu, tree.imu_link)


def _alike(joint: CompiledJoint, drawn: UrdfJoint) -> bool:
    """Return True if a joint and its URDF joint both turn or both slide."""
    return drawn.type in TYPES[joint.plan.unit]


def _check_names(
    file: RobotFile, joints: Mapping[str, CompiledJoint], drawn: Mapping[str, UrdfJoint]
) -> None:
    mark = file.at("model", "urdf")
    missing = [name for name in joints if name not in drawn]
    if missing:
        file.warning(
            mark,
            f"the URDF has no joint {', '.join(missing)}",
            "use the same names in both files; joints missing in the URDF are not shown",
        )
    stiff = [name for name in joints if name in drawn and not drawn[name].moves]
    if stiff:
        file.warning(mark, f"{', '.join(stiff)} cannot turn in the URDF", "make it revolute")
    unlike = [name for name in joints if name in drawn and drawn[name].moves]
    unlike = [name for name in unlike if not _alike(joints[name], drawn[name])]
    for unit, (moves, positions, fix) in _UNLIKE.items():
        names = ", ".join(name for name in unlike if joints[name].plan.unit is unit)
        if names:
            what = (
                f"the URDF {moves} {names}, but the robot file has {positions} for positions: the frames of "
                "the log will not move"
            )
            file.warning(mark, what, fix)
    for name in joints:
        mimic = drawn[name].mimic if name in drawn else None
        if mimic is not None:
            file.warning(
                file.key("joints", name),
                f"{name} mimics {mimic.joint} in the URDF, but its servo has priority",
                "remove the mimic from the URDF, or the joint from this file",
            )


def _check_limits(file: RobotFile, joint: CompiledJoint, drawn: UrdfJoint) -> None:
    """Warn if a joint's position or speed limits go beyond those of its URDF joint."""
    if not _alike(joint, drawn):
        return
    name, marks = joint.plan.name, file.marks
    limits = drawn.limits
    allowed = limits_of(joint.plan)
    if drawn.type != "continuous" and limits.lower is not None and limits.upper is not None:
        shown = Interval(limits.lower, limits.upper, joint.plan.unit)
        if not shown.contains(allowed):
            file.warning(
                marks.value("joints", name, "limits", "position"),
                f"{name} may move {allowed}, beyond its limits in the URDF, {shown}",
                "write the same limits in both files",
            )
    own = joint.described.limits.velocity
    unit = joint.plan.unit.speed
    if limits.velocity and own is not None and own > limits.velocity:
        file.warning(
            marks.value("joints", name, "limits", "velocity"),
            f"{name} may move at {own:g} {unit}, faster than in the URDF, {limits.velocity:g} {unit}",
            "write the same limits in both files",
        )
