"""The trajectory command: timed points, and what makes them one flat array."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter

from dxlrun import CommandModel, Duration, Floats
from dxlrun_controllers.group import check_size
from dxlrun_controllers.spline import CUBIC, LINEAR, QUINTIC, flatten

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
    `start_in` and the first point's time; when both are 0, at once, as the last gate lets them.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    start_in: Seconds = 0.0
    """s until the trajectory's start, from the moment at which the command is taken"""


def flat_trajectory(command: TrajectoryCommand, joints: tuple[str, ...]) -> Floats:
    """Return the command as a flat array. Raises ValueError for a wrong size or times that do not grow."""
    times = np.array([point.time for point in command.points])
    stalled = np.flatnonzero(np.diff(times) <= 0)
    if len(stalled):
        index = int(stalled[0]) + 1
        raise ValueError(
            f"the times of a trajectory must grow: point {index + 1} is at {times[index]:g} s, "
            f"the one before at {times[index - 1]:g} s"
        )
    points = np.zeros((len(times), 3, len(joints)))
    given = [True, True]
    for index, point in enumerate(command.points):
        check_size(f"positions in point {index + 1}", len(point.positions), joints)
        points[index, 0] = point.positions
        for derivative, (what, values) in enumerate(
            (("velocities", point.velocities), ("accelerations", point.accelerations))
        ):
            if values is None:
                given[derivative] = False
                continue
            check_size(f"{what} in point {index + 1}", len(values), joints)
            points[index, derivative + 1] = values
    velocities, accelerations = given
    order = LINEAR if not velocities else QUINTIC if accelerations else CUBIC
    return flatten(order, times, points, command.start_in)
