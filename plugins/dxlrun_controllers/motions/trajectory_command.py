"""Trajectories and chunks of positions as they are commanded, and the flat arrays that the loop plays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Annotated, Final, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, model_validator

from dxlrun import CommandModel, Duration, Floats, RestSpeed, SpeedPeak, Tolerance
from dxlrun_controllers.joints import check_size, or_number, row_of
from dxlrun_controllers.laws.spline import (
    CUBIC,
    LINEAR,
    QUINTIC,
    flatten,
    smooth_velocities,
    trajectory_peaks,
)

SPLICED: Final = 2.0
"""Behind a flat trajectory, of the joints that it moves when it is spliced; else 1, and 0 of all others."""
_DURATION: TypeAdapter[int] = TypeAdapter(Duration)


def _seconds(value: object) -> object:
    """Accept `500 ms` beside a bare number, which counts seconds."""
    return _DURATION.validate_python(value) * 1e-9 if isinstance(value, str) else value


Seconds = Annotated[float, BeforeValidator(_seconds), Field(ge=0)]


Near = Annotated[float, Field(gt=0, allow_inf_nan=True), or_number(TypeAdapter(Tolerance))]
"""rad or m, or text with a unit, or `inf`."""
Slow = Annotated[float, Field(gt=0, allow_inf_nan=True), or_number(TypeAdapter(RestSpeed))]
"""rad/s or m/s, or text with a unit, or `inf`."""


class JointTolerance(CommandModel):
    """How far a joint may be off in one goal; what is left out is as in the robot file."""

    position: Near | None = None
    """rad or m"""
    velocity: Slow | None = None
    """rad/s or m/s: at the end the speed below which it is at rest, on the way its difference to the desired
    speed"""

    @model_validator(mode="before")
    @classmethod
    def _from_position(cls, data: object) -> object:
        """Accept a position alone."""
        return data if isinstance(data, Mapping | JointTolerance) else {"position": data}


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
    """A trajectory: from point to point linear where only positions are given, cubic where both have
    velocities, quintic where both have accelerations too.

    The joints go from where they are to the first point in `start_in` and the first point's time; when both
    are 0, within a period. A goal for which that is too fast is aborted.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    start_in: Seconds = 0.0
    """s until the trajectory's start, from the moment at which the command is taken"""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """The joints that the points name, in their order; left out: all. The others go on with what they do."""
    timeout: Annotated[Seconds, Field(gt=0)] | None = None
    """s after which the goal is missed if it was not reached, however slow it was made; left out: none"""
    goal_tolerance: dict[str, JointTolerance] | None = None
    """By joint, at the end, in place of the tolerances in the robot file"""
    path_tolerance: dict[str, JointTolerance] | None = None
    """By joint, on the way: beyond it the goal is aborted"""
    goal_time_tolerance: Seconds | None = None
    """s after the end in which the goal may still be reached"""
    splice: bool = False
    """For `start_in` the joints go on with the trajectory that they play, and leave it then with the
    position, velocity and acceleration that they have."""


class ChunkCommand(CommandModel):
    """The next positions of a stream, such as those of a policy: they replace all that was to come.

    Where points have no velocities, all get some with which the way between two points stays between them.
    The joints pass into the chunk from the state in which they are, and behind its end they come to rest.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    """Their times are those of the sender's clock, whichever it is, s; what is past is left out."""
    now: float
    """What the sender's clock shows when this is sent, s"""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """As of a trajectory"""
    blend: Annotated[Seconds, Field(le=10)] = 0.1
    """s in which the joints pass into the chunk, at least"""


class GoalLimits(NamedTuple):
    """Tolerances of a goal, shape (joints,); NaN in a command: those of the robot file."""

    path: Floats
    """rad or m on the way, infinite: not checked."""
    path_velocity: Floats
    """rad/s or m/s on the way, infinite: not checked."""
    position: Floats
    """rad or m at the end."""
    velocity: Floats
    """rad/s or m/s at the end."""
    settle_s: float
    """s after the end."""

    @property
    def checks_path(self) -> bool:
        """True when there is a tolerance on the way."""
        return bool(np.isfinite(self.path).any() or np.isfinite(self.path_velocity).any())

    def flatten(self) -> Floats:
        """Return the tolerances as one array."""
        return np.concatenate([[self.settle_s], *self[:-1]])

    def replaced_by(self, flat: Floats, joints: int) -> Self:
        """Return these tolerances with those of a flat array in their places, where it has some."""
        settle_s, rows = float(flat[0]), flat[1 : 1 + 4 * joints].reshape(4, joints)
        own = [np.where(np.isnan(new), old, new) for old, new in zip(self[:-1], rows, strict=True)]
        return type(self)(
            path=own[0],
            path_velocity=own[1],
            position=own[2],
            velocity=own[3],
            settle_s=self.settle_s if np.isnan(settle_s) else settle_s,
        )


class ChunkHead(NamedTuple):
    """What stands before the flat array of a chunk."""

    now: float
    blend: float


def flat_chunk(command: ChunkCommand, joints: tuple[str, ...], wrap: Collection[str] = ()) -> Floats:
    """Return a chunk as a flat array: its head, and its trajectory with times from `now` on.

    Raises ValueError as `flat_trajectory` does.
    """
    points = tuple(point.model_copy(update={"time": point.time - command.now}) for point in command.points)
    whole = TrajectoryCommand.model_construct(points=points, start_in=0.0, joints=command.joints)
    head = ChunkHead(command.now, command.blend)
    return np.concatenate([head, flat_trajectory(whole, joints, wrap, smooth=True)])


def flat_trajectory(
    command: TrajectoryCommand, joints: tuple[str, ...], wrap: Collection[str] = (), *, smooth: bool = False
) -> Floats:
    """Return the command as a flat array: splines of all joints, time-out (s), tolerances, joints moved.

    From point to point the joints of `wrap` take the shorter way, so that a position may be whole turns off.
    `smooth`: velocities that not all points have are chosen. Raises ValueError for a wrong size, unknown
    joints, or times that do not grow.
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
    orders = []
    for index, point in enumerate(command.points):
        check_size(f"positions in point {index + 1}", len(point.positions), named)
        points[index, 0, columns] = point.positions
        given = 1
        for derivative, (what, values) in enumerate(
            (("velocities", point.velocities), ("accelerations", point.accelerations)), 1
        ):
            if values is None:
                continue
            check_size(f"{what} in point {index + 1}", len(values), named)
            points[index, derivative, columns] = values
            given += given == derivative
        orders.append((LINEAR, CUBIC, QUINTIC)[given - 1])
    for column in columns:
        if joints[column] in wrap:
            points[:, 0, column] = np.unwrap(points[:, 0, column])
    if smooth and LINEAR in orders:
        points[:, 1] = smooth_velocities(times, points[:, 0])
        orders = [CUBIC] * len(times)
    moved = np.zeros(len(joints))
    moved[columns] = SPLICED if command.splice else 1.0
    timeout = np.inf if command.timeout is None else command.timeout
    within = _goal_limits(command, named, joints).flatten()
    return np.concatenate([flatten(orders, times, points, command.start_in), [timeout], within, moved])


def _goal_limits(command: TrajectoryCommand, named: tuple[str, ...], joints: tuple[str, ...]) -> GoalLimits:
    """Return the tolerances of a command. Raises ValueError for one of a joint that it does not move."""
    given = {"path_tolerance": command.path_tolerance or {}, "goal_tolerance": command.goal_tolerance or {}}
    for key, tolerances in given.items():
        if unknown := [joint for joint in tolerances if joint not in named]:
            raise ValueError(f"{key} names {unknown[0]}, which is not moved ({', '.join(named)})")

    def row(key: str, quantity: str) -> Floats:
        found = {joint: getattr(one, quantity) for joint, one in given[key].items()}
        return row_of({j: value for j, value in found.items() if value is not None}, joints, np.nan)

    settle_s = command.goal_time_tolerance
    return GoalLimits(
        path=row("path_tolerance", "position"),
        path_velocity=row("path_tolerance", "velocity"),
        position=row("goal_tolerance", "position"),
        velocity=row("goal_tolerance", "velocity"),
        settle_s=np.nan if settle_s is None else settle_s,
    )


def trajectory_speed_peaks(
    kind: str, data: Floats, joints: tuple[str, ...], factor: float = 1.0
) -> Iterator[SpeedPeak]:
    """Yield the highest speed of each joint between the points of a prepared trajectory or chunk.

    It is played `factor` times as fast; times are those of the points.
    """
    flat = data[len(ChunkHead._fields) :] if kind == "chunk" else data
    for joint, (speed, time, piece) in zip(joints, trajectory_peaks(flat), strict=False):
        yield SpeedPeak(joint, speed * factor, time, f"from point {piece + 1} to {piece + 2}")


def _columns(named: tuple[str, ...], joints: tuple[str, ...]) -> list[int]:
    """Return the places of named joints. Raises ValueError for one that is unknown or named twice."""
    for index, joint in enumerate(named):
        if joint not in joints:
            raise ValueError(f"{joint} is not one of its joints ({', '.join(joints)})")
        if joint in named[:index]:
            raise ValueError(f"joints names {joint} twice")
    return [joints.index(joint) for joint in named]
