"""Path: joint positions from a start to a pose, and the times at which they are passed within all limits.

A path is planned as a whole before anything moves, so what it cannot do is known then. Times follow from one
pass forward and one backward over the nodes (J. E. Bobrow et al., "Time-optimal control of robotic
manipulators along specified paths", 1985, with the limits of velocity and acceleration at each node).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Generator, Sequence
from typing import Final

import msgspec

from dxlrun_space.chain import Pose, Vector, rotation_by, times
from dxlrun_space.solver import CLOSE_M, Residual, Solver, distance, residual_of

Positions = tuple[float, ...]

_NODE_M: Final = 0.004
"""Distance of two nodes of a straight line, m: on an arc of 0.2 m radius the middle is 0.01 mm off."""
_NODE_RAD: Final = 0.05
"""Distance of two nodes where the tip or a joint turns, rad."""
_FEWEST_NODES, _MOST_NODES, _MOST_SPLIT = 12, 100, 200
_SPLITS: Final = 7
"""Number of times that the distance of two nodes may be halved near a singularity."""
_JUMP_RAD: Final = 0.06
"""Largest change of a joint between two nodes, rad or m: beyond it, nodes are closer."""
_BEND_RAD: Final = 0.002
"""Largest change of a joint's way between two pairs of nodes, rad or m: where a joint comes to its limit,
nodes are closer, because a spline would leave the line by 1 mm."""
_LEASH_RAD: Final = 0.05
"""Largest change of a joint toward the posture between two nodes, rad or m."""
_SHARE: Final = 0.5
"""Part of a joint's acceleration limit for each of two terms: the path's curvature, and changes of speed."""
_LEAST: Final = 1e-9
_ROUNDING: Final = 1e-6
"""Largest distance of a position from a limit in other digits of the same angle, rad or m."""


class MotionLimits(msgspec.Struct, frozen=True):
    """Limits of a motion: of each joint, rad/s and rad/s^2, and of the tip."""

    velocity: Positions
    acceleration: Positions
    linear_velocity: float  # m/s
    linear_acceleration: float  # m/s^2
    angular_velocity: float  # rad/s
    angular_acceleration: float  # rad/s^2


class NoPath(msgspec.Struct, frozen=True):
    """Failure to find a path: the reason as text, with the remaining distance."""

    text: str


class Sample(msgspec.Struct, frozen=True):
    """Positions and velocities of the joints on a path, rad and rad/s."""

    positions: Positions
    velocities: Positions


class Path:
    """Nodes of a motion with the time of each.

    Args:
        places: Place of each node on the path, 0 to 1.
        nodes: Joint positions of each node, rad or m.
        times: Time of each node, s.
        speeds: Speed of the place at each node, 1/s.
        residual: Distance of the last node from the pose that was asked.
        solver: Its limits are those of the joints; a start outside of them is not changed.
    """

    def __init__(
        self,
        places: Sequence[float],
        nodes: Sequence[Positions],
        times: Sequence[float],
        speeds: Sequence[float],
        *,
        residual: Residual,
        solver: Solver,
    ) -> None:
        self._places, self._nodes, self._times, self._speeds = places, nodes, times, speeds
        self._slopes = _slopes(places, nodes)
        self._lower = tuple(map(min, solver.lower, nodes[0]))
        self._upper = tuple(map(max, solver.upper, nodes[0]))
        self.residual = residual
        self.duration_s = times[-1]

    @property
    def last(self) -> Positions:
        """Positions at the end of the path."""
        return self._nodes[-1]

    def sample(self, time_s: float) -> Sample:
        """Return positions and velocities at a time since the start, s."""
        still = (0.0,) * len(self.last)
        if time_s >= self.duration_s:
            return Sample(self.last, still)
        if time_s <= 0.0:
            return Sample(self._nodes[0], still)
        index = bisect_right(self._times, time_s) - 1
        begin, speed = self._times[index], self._speeds[index]
        span = self._times[index + 1] - begin
        passed = time_s - begin
        slope = (self._speeds[index + 1] - speed) / span
        way = self._places[index + 1] - self._places[index]
        share = min(1.0, (speed + slope * passed / 2) * passed / way)
        return self._between(index, share, way, (speed + slope * passed) / way)

    def _between(self, index: int, share: float, way: float, rate: float) -> Sample:
        """Return the cubic Hermite spline between two nodes, and its derivative by time."""
        square, cube = share * share, share * share * share
        first, last = 2 * cube - 3 * square + 1, 3 * square - 2 * cube
        out, into = (cube - 2 * square + share) * way, (cube - square) * way
        bend, leave, enter = (
            6 * (square - share),
            (3 * square - 4 * share + 1) * way,
            (3 * square - 2 * share) * way,
        )
        rows = tuple(
            zip(
                self._nodes[index],
                self._nodes[index + 1],
                self._slopes[index],
                self._slopes[index + 1],
                strict=True,
            )
        )
        return Sample(
            # Between a node at a limit and the next one, a spline would pass the limit.
            tuple(
                min(max(first * a + last * b + out * m + into * n, lower), upper)
                for (a, b, m, n), lower, upper in zip(rows, self._lower, self._upper, strict=True)
            ),
            tuple((bend * (a - b) + leave * m + enter * n) * rate for a, b, m, n in rows),
        )


Planning = Generator[None, None, Path | NoPath]
"""Planning of a path, which it returns: each `next` has a bounded cost."""


def plan_joints(
    solver: Solver, start: Positions, target: Pose, limits: MotionLimits, *, exact: bool
) -> Planning:
    """Plan a motion in which all joints turn evenly from the start to the pose."""
    found = yield from solver.search(target, start, exact=exact)
    if not suffices(found.residual, exact):
        return NoPath(out_of_reach(found.residual, exact))
    return (yield from plan_positions(solver, start, found.positions, target, limits))


def plan_positions(
    solver: Solver, start: Positions, goal: Positions, target: Pose, limits: MotionLimits
) -> Planning:
    """Plan a motion in which all joints turn evenly from the start to goal positions."""
    for joint, at, low, high in zip(solver.chain.joints, goal, solver.lower, solver.upper, strict=True):
        if not low - _ROUNDING <= at <= high + _ROUNDING:
            return NoPath(f"the pose has {joint} outside its limits")
    ways = [b - a for a, b in zip(start, goal, strict=True)]
    count = _count(max(map(abs, ways)) / _NODE_RAD)
    places = [index / count for index in range(count + 1)]
    nodes = [tuple(a + place * way for a, way in zip(start, ways, strict=True)) for place in places[:-1]]
    return (yield from _timed(solver, places, [*nodes, goal], target, limits))


def plan_line(
    solver: Solver, start: Positions, target: Pose, limits: MotionLimits, *, exact: bool
) -> Planning:
    """Plan a motion in which the tip moves on a straight line and turns about one axis to the pose."""
    search = solver.search(target, start, exact=True) if exact else solver.search_place(target, start)
    found = yield from search
    if not suffices(found.residual, exact):
        return NoPath(out_of_reach(found.residual, exact))
    begin = solver.chain.pose(start)
    way, turn = distance(begin, target)
    length = math.hypot(*way)
    count = _count(max(length / _NODE_M, math.hypot(*turn) / _NODE_RAD))
    places, nodes = [0.0], [start]
    step = finest = 1.0 / count
    finest /= 2**_SPLITS
    while places[-1] < 1.0 - _LEAST:
        place = min(1.0, places[-1] + step)
        here = _along(begin, way, turn, place) if place < 1.0 else target
        found = yield from solver.search_from(
            here, _guess(places, nodes, place), exact=exact, leash=_LEASH_RAD
        )
        change = max(abs(a - b) for a, b in zip(found.positions, nodes[-1], strict=True))
        bend = _bend([*places[-2:], place], [*nodes[-2:], found.positions])
        smooth = change <= _JUMP_RAD and bend <= _BEND_RAD
        if suffices(found.residual, exact) and smooth:
            places.append(place)
            nodes.append(found.positions)
            step = min(2 * step, 1.0 / count)
        elif step > finest and len(nodes) < _MOST_SPLIT:
            step /= 2
        else:
            passed, whole = places[-1] * length * 1e3, length * 1e3
            return NoPath(
                f"the straight line ends after {passed:.0f} of {whole:.0f} mm, at a limit of a joint or "
                "where a joint would leap; write path=joints"
            )
        yield
    return (yield from _timed(solver, places, nodes, target, limits))


def out_of_reach(residual: Residual, exact: bool) -> str:
    """Return the reason why a pose is refused, with the distance of the nearest solution."""
    turn = f" and {math.degrees(residual.orientation):.1f} deg" if exact else ""
    return f"the pose is out of reach; the nearest is {residual.position * 1e3:.1f} mm{turn} away"


def suffices(residual: Residual, exact: bool) -> bool:
    """Return True if a solution has the position and, if `exact`, the orientation."""
    return residual.is_close if exact else residual.position <= CLOSE_M


def _count(needed: float) -> int:
    return min(_MOST_NODES, max(_FEWEST_NODES, math.ceil(needed)))


def _along(begin: Pose, way: Vector, turn: Vector, place: float) -> Pose:
    (x, y, z), (u, v, w), (a, b, c) = begin[1], way, turn
    rotation = times(rotation_by((a * place, b * place, c * place)), begin[0])
    return rotation, (x + u * place, y + v * place, z + w * place)


def _guess(places: Sequence[float], nodes: Sequence[Positions], place: float) -> Positions:
    """Return the positions at a place by the line through the last two nodes."""
    if len(nodes) < 2:
        return nodes[-1]
    share = (place - places[-1]) / (places[-1] - places[-2])
    return tuple(b + (b - a) * share for a, b in zip(nodes[-2], nodes[-1], strict=True))


def _bend(places: Sequence[float], nodes: Sequence[Positions]) -> float:
    """Return by how much a joint leaves the line through its last two nodes, rad or m; 0 for two nodes."""
    if len(nodes) < 3:
        return 0.0
    first, last = places[1] - places[0], places[2] - places[1]
    turns: list[float] = [abs((c - b) / last - (b - a) / first) for a, b, c in zip(*nodes, strict=True)]
    return min(first, last) * max(turns)


def _slopes(places: Sequence[float], nodes: Sequence[Positions]) -> list[Positions]:
    """Return the derivative of the positions by the place at each node, from its two neighbours."""
    steps = [
        tuple((b - a) / (t - s) for a, b in zip(first, last, strict=True))
        for s, t, first, last in zip(places, places[1:], nodes, nodes[1:], strict=False)
    ]
    slopes = [steps[0]]
    for index in range(1, len(steps)):
        before, after = places[index] - places[index - 1], places[index + 1] - places[index]
        share = after / (before + after)
        slopes.append(
            tuple(share * a + (1 - share) * b for a, b in zip(steps[index - 1], steps[index], strict=True))
        )
    return [*slopes, steps[-1]]


class _Node(msgspec.Struct):
    """Greatest speed and change of speed of the place at a node, 1/s and 1/s^2."""

    speed: float
    change: float


def _timed(
    solver: Solver, places: Sequence[float], nodes: Sequence[Positions], target: Pose, limits: MotionLimits
) -> Planning:
    """Give each node its time."""
    poses: list[Pose] = []
    for node in nodes:
        poses.append(solver.chain.pose(node))
        yield
    residual = residual_of(poses[-1], target)
    count = len(nodes)
    slopes = _slopes(places, nodes)
    yield
    steps: list[_Segment] = []
    for index in range(count - 1):
        steps.append(_segment(places, nodes, slopes, poses, index))
        if index % 8 == 0:
            yield
    if all(max(step.rates) < _LEAST for step in steps):
        return Path(places, nodes, [0.0] * count, [0.0] * count, residual=residual, solver=solver)
    bounds: list[_Node] = []
    for index in range(count):
        near = steps[max(0, index - 1) : index + 1]
        bounds.append(_bounds(near, limits))
        if index % 8 == 0:
            yield
    speeds = [bound.speed for bound in bounds]
    speeds[0] = speeds[-1] = 0.0
    # Forward, no node is passed faster than the acceleration before it allows; backward, than braking does.
    for index in range(1, count):
        speeds[index] = min(speeds[index], _faster(speeds[index - 1], bounds, places, index - 1))
    yield
    for index in range(count - 2, -1, -1):
        speeds[index] = min(speeds[index], _faster(speeds[index + 1], bounds, places, index))
    yield
    moments = [0.0]
    for index in range(count - 1):
        way = places[index + 1] - places[index]
        moments.append(moments[-1] + 2 * way / (speeds[index] + speeds[index + 1]))
    return Path(places, nodes, moments, speeds, residual=residual, solver=solver)


def _faster(speed: float, bounds: Sequence[_Node], places: Sequence[float], index: int) -> float:
    """Return the speed at the other end of a segment that begins or ends with `speed`."""
    change = min(bounds[index].change, bounds[index + 1].change)
    return math.sqrt(speed * speed + 2 * change * (places[index + 1] - places[index]))


class _Segment(msgspec.Struct, frozen=True):
    """Derivatives by the place between two nodes, and the length of the segment."""

    way: float
    rates: Positions
    """Largest first derivative of each joint on the spline."""
    bends: Positions
    """Largest second derivative of each joint on the spline, which is at one of its ends."""
    linear: Vector
    angular: float


def _segment(
    places: Sequence[float],
    nodes: Sequence[Positions],
    slopes: Sequence[Positions],
    poses: Sequence[Pose],
    index: int,
) -> _Segment:
    way = places[index + 1] - places[index]
    (x, y, z), turn = distance(poses[index], poses[index + 1])
    rates, bends = [], []
    for a, b, m, n in zip(nodes[index], nodes[index + 1], slopes[index], slopes[index + 1], strict=True):
        chord = (b - a) / way
        middle = 1.5 * chord - (m + n) / 4
        rates.append(max(abs(m), abs(n), abs(middle)))
        bends.append(max(abs(6 * chord - 4 * m - 2 * n), abs(6 * chord - 2 * m - 4 * n)) / way)
    return _Segment(way, tuple(rates), tuple(bends), (x / way, y / way, z / way), math.hypot(*turn) / way)


def _bounds(near: Sequence[_Segment], limits: MotionLimits) -> _Node:
    """Return the bounds at a node between one or two segments."""
    speed = change = math.inf
    first, last = near[0], near[-1]
    for segment in near:
        for rate, bend, top, most in zip(
            segment.rates, segment.bends, limits.velocity, limits.acceleration, strict=True
        ):
            speed = min(speed, top / max(rate, _LEAST), math.sqrt(_SHARE * most / max(bend, _LEAST)))
            change = min(change, _SHARE * most / max(rate, _LEAST))
    linear = max(math.hypot(*first.linear), math.hypot(*last.linear), _LEAST)
    angular = max(first.angular, last.angular, _LEAST)
    between = (first.way + last.way) / 2
    bend = math.hypot(*(b - a for a, b in zip(first.linear, last.linear, strict=True))) / between
    # Changes of speed act along the path and curvature across it, so each may have 0.7 of the limit.
    most = 0.7 * limits.linear_acceleration
    speed = min(speed, limits.linear_velocity / linear, limits.angular_velocity / angular)
    speed = min(speed, math.sqrt(most / max(bend, _LEAST)))
    return _Node(speed, min(change, most / linear, limits.angular_acceleration / angular))


def shifted(pose: Pose, way: Vector, turn: Vector) -> Pose:
    """Return a pose that is moved and turned in the axes of its parent."""
    (x, y, z), (u, v, w) = pose[1], way
    return times(rotation_by(turn), pose[0]), (x + u, y + v, z + w)
