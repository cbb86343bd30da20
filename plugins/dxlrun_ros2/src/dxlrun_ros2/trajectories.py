"""Conversion of ROS 2 trajectories to commands of dxlrun, and to the splines that the controller plays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Duration, Time
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dxlrun import Floats, InputError
from dxlrun_controllers.laws.spline import CUBIC, LINEAR, QUINTIC, SplineSample, Trajectory, flatten


@dataclass(frozen=True)
class ValidatedTrajectory:
    """Validated ROS 2 trajectory of a controller's joints: rad, rad/s, rad/s^2 (m for linear joints), s"""

    joints: tuple[str, ...]
    times: Floats
    """Times after the start, s, increasing; shape (points,)"""
    points: Floats
    """Position, velocity, acceleration (0 if not given); shape (points, 3, joints)"""
    orders: tuple[int, ...]
    """Order of each point: LINEAR with a position only, CUBIC with a velocity, QUINTIC with an acceleration
    """
    start_in: float
    """Time from the conversion of the message until the trajectory starts, s"""

    @property
    def seconds(self) -> float:
        """Time from the conversion of the message until the last point, s"""
        return self.start_in + float(self.times[-1])

    def build_command(self) -> dict[str, object]:
        """Return the fields of the command `trajectory` of a joint_trajectory_controller."""
        return {"points": self._points(0.0), "joints": list(self.joints), "start_in": self.start_in}

    def chunk(self, now: float) -> dict[str, object]:
        """Return the fields of the command `chunk`, whose points have times of the same clock as `now`, s."""
        return {"points": self._points(now + self.start_in), "joints": list(self.joints), "now": now}

    def _points(self, begin: float) -> list[dict[str, object]]:
        rows = []
        for time, point, order in zip(self.times.tolist(), self.points.tolist(), self.orders, strict=True):
            row: dict[str, object] = {"time": begin + time, "positions": point[0]}
            if order >= CUBIC:
                row["velocities"] = point[1]
            if order == QUINTIC:
                row["accelerations"] = point[2]
            rows.append(row)
        return rows

    def spline(self, begin: Floats) -> Trajectory:
        """Return the spline that the controller plays from rest at the positions `begin`, shape (joints,)."""
        spline, now = Trajectory(len(self.joints)), SplineSample(len(self.joints))
        now.rest_at(begin)
        spline.load(flatten(self.orders, self.times, self.points, self.start_in), now)
        return spline

    def index(self, seconds: float) -> int:
        """Return the index of the next point at `seconds` after the goal was accepted; finally the last."""
        return min(int(np.searchsorted(self.times + self.start_in, seconds)), len(self.times) - 1)


def wanted(message: JointTrajectory, joints: Sequence[str], now: float) -> ValidatedTrajectory:
    """Validate and convert a ROS 2 trajectory for some or all joints of a controller.

    Points in the past are omitted, and so is a first point at time 0 if more points follow, because the
    joints are there already.

    Args:
        message: Trajectory; it starts at once with a stamp of 0.
        joints: Joints of the controller.
        now: Present time of the clock of the message's stamp, s.

    Raises:
        InputError: The trajectory is invalid, or all of its points are in the past.
    """
    named = tuple(message.joint_names)
    if unknown := [name for name in named if name not in joints]:
        raise InputError(f"the controller has no joint {', '.join(unknown)}; its joints: {', '.join(joints)}")
    if not named or len({*named}) < len(named):
        raise InputError("joint_names must not be empty or repeat a joint")
    points, times = np.zeros((len(message.points), 3, len(named))), np.zeros(len(message.points))
    orders = []
    for index, point in enumerate(message.points):
        times[index] = seconds_of(point.time_from_start)
        given = (point.positions, point.velocities, point.accelerations)
        for row, (what, values) in enumerate(
            zip(("positions", "velocities", "accelerations"), given, strict=True)
        ):
            if len(values) not in ((len(named),) if row == 0 else (0, len(named))):
                raise InputError(f"point {index + 1} has {len(values)} {what} for {len(named)} joints")
            points[index, row] = values if len(values) else 0.0
        orders.append(LINEAR if not given[1] else QUINTIC if given[2] else CUBIC)
    if not np.isfinite(points).all():
        raise InputError("the points have NaN or infinite numbers")
    if (np.diff(times, prepend=-1e-12) <= 0).any():
        raise InputError("time_from_start must not be negative, and must increase from point to point")
    stamp = seconds_of(message.header.stamp)
    start_in = stamp - now if stamp else 0.0
    if start_in < 0:
        times, start_in = times + start_in, 0.0
    ahead = times > 0
    if not ahead.any():
        if stamp:
            raise InputError("all points are in the past")
        ahead[-1] = True
    chosen = tuple(order for order, is_ahead in zip(orders, ahead, strict=True) if is_ahead)
    return ValidatedTrajectory(named, times[ahead], points[ahead], chosen, start_in)


def tolerances(given: Sequence[JointTolerance], joints: Sequence[str]) -> dict[str, dict[str, float | str]]:
    """Convert the tolerances of a ROS 2 action goal to those of the command `trajectory`, by joint.

    A tolerance of 0 is omitted, and a negative one becomes `inf`. Accelerations are not measured, so they are
    not checked.

    Raises:
        InputError: A joint is not moved, or a number is not finite.
    """
    rows: Mapping[str, JointTolerance] = {one.name: one for one in given}
    if unknown := [name for name in rows if name not in joints]:
        raise InputError(f"the trajectory does not move {', '.join(unknown)}; remove the tolerance")
    found: dict[str, dict[str, float | str]] = {}
    for name, one in rows.items():
        written = {"position": float(one.position), "velocity": float(one.velocity)}
        if not np.isfinite(list(written.values())).all():
            raise InputError(f"the tolerance of {name} is NaN or infinite")
        if values := {key: "inf" if value < 0 else value for key, value in written.items() if value}:
            found[name] = values
    return found


def goal_fields(goal: FollowJointTrajectory.Goal, joints: Sequence[str]) -> dict[str, object]:
    """Convert path, goal and time tolerances of an action goal to fields of the command `trajectory`.

    Tolerances that are not given are omitted. Raises InputError.
    """
    fields: dict[str, object] = {
        "path_tolerance": tolerances(goal.path_tolerance, joints),
        "goal_tolerance": tolerances(goal.goal_tolerance, joints),
    }
    fields = {key: value for key, value in fields.items() if value}
    seconds = seconds_of(goal.goal_time_tolerance)
    return fields | ({"goal_time_tolerance": seconds} if seconds > 0 else {})


def point(rows: Floats, seconds: float) -> JointTrajectoryPoint:
    """Return a ROS 2 trajectory point: `rows` are positions and velocities, shape (2, joints); time in s."""
    message = JointTrajectoryPoint(positions=rows[0].tolist(), velocities=rows[1].tolist())
    message.time_from_start = Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
    return message


def seconds_of(message: Time | Duration) -> float:
    """Convert a ROS 2 time or duration to s."""
    return float(message.sec) + float(message.nanosec) * 1e-9
