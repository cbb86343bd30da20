"""Desired motion of the tracking experiment: position and velocity of a joint at any time, interpolated
between the samples of a motion file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from dxlrun import Floats, InputError
from dxlrun.tooling.plans import Plan, ScheduledCommand
from dxlrun.tooling.robots import read_motion
from dxlrun_controllers.laws.spline import CUBIC, solve


class DesiredMotion(msgspec.Struct, frozen=True):
    """Motion of one joint: cubic between its samples, as `joint_trajectory_controller` plays it."""

    joint: str
    file: str
    times_s: tuple[float, ...]  # since the first sample
    positions: tuple[float, ...]  # rad
    velocities: tuple[float, ...]  # rad/s
    lead_ns: int
    """Time from the acceptance of the motion's first command to the first sample, ns"""

    @property
    def duration_ns(self) -> int:
        """Time from the first sample to the last, ns"""
        return round(self.times_s[-1] * 1e9)

    def at(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Return position (rad) and velocity (rad/s) at times since the first sample, s.

        Before and after the motion, the joint is at rest.
        """
        times, samples = np.clip(times_s, 0.0, self.times_s[-1]), np.array(self.times_s)
        states = np.array([self.positions, self.velocities])
        index = np.clip(np.searchsorted(samples, times, side="right") - 1, 0, len(samples) - 2)
        pieces = np.empty((CUBIC, len(times)))
        solve(CUBIC, np.diff(samples)[index], states[:, index], states[:, index + 1], pieces)
        elapsed = times - samples[index]
        position: Floats = polyval(elapsed, pieces, tensor=False)
        velocity: Floats = polyval(elapsed, polyder(pieces), tensor=False)
        velocity[times_s != times] = 0.0
        return position, velocity


def desired_motion(path: Path, plan: Plan) -> DesiredMotion:
    """Return the motion of the motion file `path`, which the plan plays.

    Raises InputError unless it moves one joint by two or more positions.
    """
    parts = len(read_motion(path, plan.groups, plan.omitted).motion.motions)
    commands = plan.loop.commands
    joints = next(one.joints for one in plan.loop.controllers if one.name == commands[0].controller)
    if parts != 1 or len(joints) != 1:
        what = f"{parts} parts" if parts != 1 else f"{len(joints)} joints"
        raise InputError(
            f"{path} has {what}, but the experiment needs one motion of one joint; "
            "give a motion file with one part and one joint"
        )
    points, lead_ns = _points(commands)
    if len(points) < 2 or not points[0].positions:
        raise InputError(f"{path} has fewer than two positions; choose another motion for --play")
    times = np.array([point.time_ns - points[0].time_ns for point in points]) * 1e-9
    positions = np.array([point.positions[0] for point in points], np.float64)
    given = np.array([point.velocities[0] if point.velocities else np.nan for point in points])
    # Without a velocity in the file, use the slope between the neighbouring samples.
    velocities = np.where(np.isfinite(given), given, np.gradient(positions, times))
    at, position, velocity = (tuple(one.tolist()) for one in (times, positions, velocities))
    return DesiredMotion(joints[0], str(path), at, position, velocity, lead_ns)


class _Point(msgspec.Struct):
    """Point of a motion's command, as decoded from JSON: targets of the joints at a time"""

    time: float = 0.0
    """Time in the trajectory, or since the first command, s"""
    positions: tuple[float, ...] = ()
    velocities: tuple[float, ...] = ()

    @property
    def time_ns(self) -> int:
        """`time` in ns"""
        return round(self.time * 1e9)


class _Trajectory(msgspec.Struct):
    points: tuple[_Point, ...] = ()
    start_in: float = 0.0
    """Time from the acceptance of the command to the start of the trajectory, s"""


def _points(commands: Sequence[ScheduledCommand]) -> tuple[Sequence[_Point], int]:
    """Decode a motion's points from its commands: one trajectory, or one command per point. The time from the
    first command to the first point, ns, is returned, too."""
    trajectory = msgspec.json.decode(commands[0].request, type=_Trajectory)
    if trajectory.points:
        return trajectory.points, round(trajectory.start_in * 1e9) + trajectory.points[0].time_ns
    points = [msgspec.json.decode(command.request, type=_Point) for command in commands]
    for point, command in zip(points, commands, strict=True):
        point.time = command.at_ns * 1e-9
    return points, 0
