"""Commands of trajectories and chunks of positions, and their conversion to the flat arrays of the loop."""

from collections.abc import Collection, Iterator, Mapping
from typing import Annotated, Final, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from dxlrun import CommandModel, Duration, Floats, RestSpeed, SpeedPeak, Tolerance
from dxlrun_controllers.joint_parameters import check_size, or_number, row_of
from dxlrun_controllers.laws.spline import (
    CUBIC,
    LINEAR,
    QUINTIC,
    flatten,
    smooth_velocities,
    trajectory_peaks,
)

SPLICED: Final = 2.0
"""Mark of a moved joint at the end of a spliced flat trajectory.

Without a splice it is 1; other joints have 0.
"""
_DURATION: TypeAdapter[int] = TypeAdapter(Duration, config=ConfigDict(defer_build=True))


def _seconds(value: object) -> object:
    """Return a text with a unit, such as `500 ms`, in seconds; a number is in seconds already."""
    return _DURATION.validate_python(value) * 1e-9 if isinstance(value, str) else value


Seconds = Annotated[float, BeforeValidator(_seconds), Field(ge=0)]


Near = Annotated[float, Field(gt=0, allow_inf_nan=True), or_number(Tolerance)]
"""Position tolerance: rad or m, text with a unit, or `inf`"""
Slow = Annotated[float, Field(gt=0, allow_inf_nan=True), or_number(RestSpeed)]
"""Velocity tolerance: rad/s or m/s, text with a unit, or `inf`"""


class JointTolerance(CommandModel):
    """Tolerances of a joint in one goal. The robot file has the defaults."""

    position: Near | None = None
    """Position tolerance, rad or m"""
    velocity: Slow | None = None
    """Velocity tolerance, rad/s or m/s. At the end, it is the speed below which the joint is at rest. On the
    way, it limits the difference to the desired velocity."""

    @model_validator(mode="before")
    @classmethod
    def _from_position(cls, data: object) -> object:
        """Accept a position tolerance in place of a mapping."""
        return data if isinstance(data, Mapping | JointTolerance) else {"position": data}


class TrajectoryPoint(CommandModel):
    """Desired state of the joints at a time"""

    time: Seconds
    """Time since the start of the trajectory, s"""
    positions: tuple[float, ...]
    """Positions, rad, shape (joints,)"""
    velocities: tuple[float, ...] | None = None
    """Velocities, rad/s, shape (joints,)"""
    accelerations: tuple[float, ...] | None = None
    """Accelerations, rad/s^2, shape (joints,)"""


class TrajectoryCommand(CommandModel):
    """Trajectory through points.

    The piece between two points is linear if only positions are given, cubic if both points have velocities,
    and quintic if both also have accelerations. The joints reach the first point after `start_in` plus the
    time of that point, or within one period if both are 0. A goal that would exceed a speed limit on this way
    is aborted.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    start_in: Seconds = 0.0
    """Time from the acceptance of the command to the start of the trajectory, s"""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints that the points list; by default all. All other joints continue their motion."""
    timeout: Annotated[Seconds, Field(gt=0)] | None = None
    """Time after which the goal is missed, whatever the speed factor, s; by default unlimited"""
    goal_tolerance: dict[str, JointTolerance] | None = None
    """Tolerances at the end, by joint. They override those of the robot file."""
    path_tolerance: dict[str, JointTolerance] | None = None
    """Tolerances on the way, by joint. Beyond them the goal is aborted."""
    goal_time_tolerance: Seconds | None = None
    """Time after the end in which the goal may still be reached, s"""
    splice: bool = False
    """Continue the active trajectory for `start_in`, and then leave it without a jump in position, velocity
    and acceleration."""


class ChunkCommand(CommandModel):
    """Next positions of a stream, such as those of a policy, which replace the rest of the previous chunk.

    If a point has no velocity, velocities are chosen for all points so that no piece overshoots its points.
    The joints blend into the chunk from their present state, and come to rest after its end.
    """

    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=1)]
    """Points with times of the sender's clock, which may be any clock, s. Points in the past are ignored."""
    now: float
    """Time of the sender's clock when the chunk is sent, s"""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints that the points list; by default all"""
    blend: Annotated[Seconds, Field(le=10)] = 0.1
    """Shortest time in which the joints blend into the chunk, s"""


class GoalLimits(NamedTuple):
    """Tolerances of a goal, shape (joints,). NaN in a command selects the tolerance of the robot file."""

    path: Floats
    """Largest position error on the way, rad or m; infinite if it is not checked."""
    path_velocity: Floats
    """Largest velocity error on the way, rad/s or m/s; infinite if it is not checked."""
    position: Floats
    """Largest position error at the end, rad or m."""
    velocity: Floats
    """Highest speed at the end, rad/s or m/s, at which a joint counts as at rest."""
    settle_s: float
    """Time after the end in which the goal may still be reached, s."""

    @property
    def checks_path(self) -> bool:
        """True if there is a position or velocity tolerance on the way."""
        return bool(np.isfinite(self.path).any() or np.isfinite(self.path_velocity).any())

    def flatten(self) -> Floats:
        """Return the tolerances as one array: `settle_s`, then the four rows."""
        return np.concatenate([[self.settle_s], *self[:-1]])

    def replaced_by(self, flat: Floats, joints: int) -> Self:
        """Return a copy in which the values of a flattened GoalLimits that are not NaN replace these
        tolerances.
        """
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
    """Header of a flat chunk: the sender's time and the blending time, s."""

    now: float
    blend: float


def flat_chunk(command: ChunkCommand, joints: tuple[str, ...], wrap: Collection[str] = ()) -> Floats:
    """Return a chunk as a flat array: its header, and its trajectory with times relative to `now`.

    Raises:
        ValueError: As in `flat_trajectory`.
    """
    points = tuple(point.model_copy(update={"time": point.time - command.now}) for point in command.points)
    whole = TrajectoryCommand.model_construct(points=points, start_in=0.0, joints=command.joints)
    head = ChunkHead(command.now, command.blend)
    return np.concatenate([head, flat_trajectory(whole, joints, wrap, smooth=True)])


def flat_trajectory(
    command: TrajectoryCommand, joints: tuple[str, ...], wrap: Collection[str] = (), *, smooth: bool = False
) -> Floats:
    """Return a trajectory as a flat array: splines of all joints, timeout (s), tolerances, moved joints.

    Args:
        command: Trajectory.
        joints: All joints of the controller.
        wrap: Joints that take the shorter way between two points, so their positions may differ by whole
            turns.
        smooth: Choose velocities without overshoot if a point has none.

    Raises:
        ValueError: The number of values is wrong, a joint is unknown, or the times do not increase.
    """
    times = np.array([point.time for point in command.points])
    stalled = np.flatnonzero(np.diff(times) <= 0)
    if len(stalled):
        index = int(stalled[0]) + 1
        raise ValueError(
            f"the times of a trajectory must grow: point {index + 1} is at {times[index]:g} s, "
            f"the previous point at {times[index - 1]:g} s"
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
    """Return the tolerances in a command, NaN where it has none.

    Raises ValueError if one names a joint that is not moved.
    """
    given = {"path_tolerance": command.path_tolerance or {}, "goal_tolerance": command.goal_tolerance or {}}
    for key, tolerances in given.items():
        if unknown := [joint for joint in tolerances if joint not in named]:
            raise ValueError(f"{key} names {unknown[0]}, but the moved joints are {', '.join(named)}")

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
    """Yield the peak speed of each joint between the points of a prepared trajectory or chunk.

    Speeds are multiplied by `factor`, but the reported times are those of the points.
    """
    flat = data[len(ChunkHead._fields) :] if kind == "chunk" else data
    for joint, (speed, time, piece) in zip(joints, trajectory_peaks(flat), strict=False):
        yield SpeedPeak(joint, speed * factor, time, f"from point {piece + 1} to {piece + 2}")


def _columns(named: tuple[str, ...], joints: tuple[str, ...]) -> list[int]:
    """Return the indices of named joints in `joints`; raises ValueError for a joint unknown or named
    twice.
    """
    for index, joint in enumerate(named):
        if joint not in joints:
            raise ValueError(f"{joint} is not one of its joints ({', '.join(joints)})")
        if joint in named[:index]:
            raise ValueError(f"joints names {joint} twice")
    return [joints.index(joint) for joint in named]
