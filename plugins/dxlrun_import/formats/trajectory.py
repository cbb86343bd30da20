"""JointTrajectory of ROS: a message, or a FollowJointTrajectory goal, in YAML or JSON.

Source: trajectory_msgs/JointTrajectory and control_msgs/action/FollowJointTrajectory of ROS 2. Positions are
rad, times are seconds and nanoseconds (`sec`, `nanosec`; in ROS 1 `secs`, `nsecs`).
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import Step, list_at, mapping_at, number_at, text_at, value_at
from dxlrun_import.motion_text import MotionPoint, motion_conversion

_INSIDE: Sequence[tuple[str, ...]] = ((), ("trajectory",), ("goal", "trajectory"), ("joint_trajectory",))
_GOAL = ("path_tolerance", "goal_tolerance", "goal_time_tolerance")


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the points of the trajectory."""
    top = _trajectory(content)
    names = [
        text_at(content, *top, "joint_names", index)
        for index in range(len(list_at(content, *top, "joint_names")))
    ]
    remarks = []
    points = []
    for index in range(len(list_at(content, *top, "points"))):
        at: tuple[Step, ...] = (*top, "points", index)
        positions = _values(content, at, "positions", len(names))
        velocities = _values(content, at, "velocities", len(names), optional=True)
        named = dict(zip(names, velocities, strict=True)) if velocities else {}
        points.append(MotionPoint(_time(content, at), dict(zip(names, positions, strict=True)), named))
    for key in ("accelerations", "effort"):
        if any(value_at(content, *top, "points", index, key) for index in range(len(points))):
            remarks.append(
                f"{key} of the points: the trajectory is a spline through positions and velocities"
            )
    remarks += [
        f"{key}: write `tolerance` of the joints" for key in _GOAL if value_at(content, *top[:-1], key)
    ]
    if 0 < sum(bool(point.velocities) for point in points) < len(points):
        points = [point._replace(velocities={}) for point in points]
        remarks.append("velocities: some points have none, so a spline through the positions has its own")
    return motion_conversion(content, options, FORMAT.name, points, remarks)


def _values(
    content: FileContent, at: tuple[Step, ...], key: str, count: int, *, optional: bool = False
) -> list[float]:
    if optional and not value_at(content, *at, key):
        return []
    values = [number_at(content, *at, key, index) for index in range(len(list_at(content, *at, key)))]
    if len(values) != count:
        what = f"point {at[-1]} has {len(values)} {key}, but there are {count} joints"
        raise content.refusal(what, "write one for each joint", *at, key)
    return values


def _time(content: FileContent, at: tuple[Step, ...]) -> float:
    place = (*at, "time_from_start")
    if isinstance(value_at(content, *place), int | float):
        return number_at(content, *place)
    keys = mapping_at(content, *place).keys()
    names = ("secs", "nsecs") if "secs" in keys else ("sec", "nanosec")
    whole, fraction = (number_at(content, *place, name, default=0.0) for name in names)
    return whole + fraction * 1e-9


def _trajectory(content: FileContent) -> tuple[str, ...]:
    keys = {"joint_names", "points"}
    inside = (one for one in _INSIDE if isinstance(value_at(content, *one), dict))
    return next(one for one in inside if keys <= mapping_at(content, *one).keys())


def _matches(content: FileContent) -> bool:
    return bool(content.values) and _trajectory(content) is not None


FORMAT = FileFormat("a JointTrajectory of ROS", _matches, convert=f"{__name__}:convert", makes="motion")
