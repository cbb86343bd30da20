"""Trajectories as they are commanded: points with times, and the flat array that the loop plays."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter

from dxlrun import CommandModel, Duration, Floats
from dxlrun_controllers.joints import check_size
from dxlrun_controllers.laws.spline import CUBIC, LINEAR, QUINTIC, flatten

_DURATION: TypeAdapter[int] = TypeAdapter(Duration)


def _seconds(value: object) -> object:
    """Accept `500 ms` beside a bare number, which counts seconds."""
    return _DURATION.validate_python(value) * 1e-9 if isinstance(value, str) else value


Seconds = Annotated[float, BeforeValidator(_seconds), Field(ge=0)]


class TrajectoryPoint(CommandModel):
    """Where the joints are to be at a time."""

    time: Seconds
    """s since the trajectory's start"""
    positions: tuple[float, ...]
    """rad, shape (joints,)"""
    velocities: tuple[float, ...] | None = None
    """rad/s, shape (joints,)"""
    accelerations: tuple[float, ...] | None = None
    """rad/s^2, shape (joints,)"""


class TrajectoryCommand(CommandModel):
    """A trajectory: linear when only positions are given, cubic with velocities, quintic with accelerations.

    What only some points give is not used. The joints go from where they are to the first point in
    `start_in` and the first point's time; when both are 0, within a period. A goal for which that is too fast
    is aborted.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    start_in: Seconds = 0.0
    """s until the trajectory's start, from the moment at which the command is taken"""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """The joints that the points name, in their order; left out: all. The others come to rest and hold."""
    timeout: Annotated[Seconds, Field(gt=0)] | None = None
    """s after which the goal is missed if it was not reached, however slow it was made; left out: none"""


def flat_trajectory(command: TrajectoryCommand, joints: tuple[str, ...]) -> Floats:
    """Return the command as a flat array: splines of all joints, time-out (s), and which joints it moves (1).

    Raises ValueError for a wrong size, unknown joints, or times that do not grow.
    """
    times = np.array([point.time for point in command.points])
    stalled = np.flatnonzero(np.diff(times) <= 0)
    if len(stalled):
        index = int(stalled[0]) + 1
        raise ValueError(
            f"the times of a trajectory must grow: point {index + 1} is at {times[index]:g} s, "
            f"the one before at {times[index - 1]:g} s"
        )
    named = joints if command.joints is None else command.joints
    columns = _columns(named, joints)
    points = np.zeros((len(times), 3, len(joints)))
    given = [True, True]
    for index, point in enumerate(command.points):
        check_size(f"positions in point {index + 1}", len(point.positions), named)
        points[index, 0, columns] = point.positions
        for derivative, (what, values) in enumerate(
            (("velocities", point.velocities), ("accelerations", point.accelerations))
        ):
            if values is None:
                given[derivative] = False
                continue
            check_size(f"{what} in point {index + 1}", len(values), named)
            points[index, derivative + 1, columns] = values
    velocities, accelerations = given
    order = LINEAR if not velocities else QUINTIC if accelerations else CUBIC
    moved = np.zeros(len(joints))
    moved[columns] = 1.0
    timeout = np.inf if command.timeout is None else command.timeout
    return np.concatenate([flatten(order, times, points, command.start_in), [timeout], moved])


def _columns(named: tuple[str, ...], joints: tuple[str, ...]) -> list[int]:
    """Return the places of named joints. Raises ValueError for one that is unknown or named twice."""
    for index, joint in enumerate(named):
        if joint not in joints:
            raise ValueError(f"{joint} is not one of its joints ({', '.join(joints)})")
        if joint in named[:index]:
            raise ValueError(f"joints names {joint} twice")
    return [joints.index(joint) for joint in named]
