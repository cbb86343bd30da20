"""Path: joint positions from a start to a pose, and the times at which they are passed within all limits.

A path is planned as a whole before anything moves, so what it cannot do is known then. Times follow from one
pass forward and one backward over the nodes (J. E. Bobrow et al., "Time-optimal control of robotic
manipulators along specified paths", 1985, with the limits of velocity and acceleration at each node).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Generator, Sequence
from itertools import accumulate
from typing import Final

import msgspec
import numpy as np

from dxlrun import Floats
from dxlrun.tooling.robots import Transform
from dxlrun_space.chain import scaled, shifted
from dxlrun_space.solver import Residual, Solver, distance, residual_of

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
_MARGIN: Final = 0.8
"""Part of the jump and bend limits that the next node is planned for."""
_SHARE: Final = 0.5
"""Part of a joint's acceleration limit for each of two terms: the path's curvature, and changes of speed."""
_TIP_SHARE: Final = 0.7
"""The same of the tip, where curvature acts across the path and changes of speed along it."""
_LEAST: Final = 1e-9
_ROUNDING: Final = 1e-6
"""Largest distance of a position from a limit in other digits of the same angle, rad or m."""


class MotionLimits(msgspec.Struct, frozen=True):
    """Limits of a motion, all above 0: of the tip's translation and rotation, and of each joint."""

    velocity: Positions  # m/s, rad/s, and rad/s or m/s
    acceleration: Positions


class NoPath(Exception):
    """Raised if no path is found; its text has the reason and the remaining distance."""


class Path:
    """Nodes of a motion with the time of each, joined by cubic Hermite splines of the time.

    Args:
        times: Time of each node, s.
        nodes: Joint positions of each node, rad or m.
        velocities: Velocities of the joints at each node.
        residual: Distance of the last node from the pose that was asked.
        solver: Its limits are those of the joints; a start outside of them is not changed.
    """

    def __init__(
        self, times: Sequence[float], nodes: Floats, velocities: Floats, residual: Residual, solver: Solver
    ) -> None:
        self._times, self._nodes, self._velocities = times, nodes, velocities
        self._lower, self._upper = np.minimum(solver.lower, nodes[0]), np.maximum(solver.upper, nodes[0])
        self.residual = residual
        self.duration_s = times[-1]

    @property
    def last(self) -> Positions:
        """Positions at the end of the path."""
        return tuple(self._nodes[-1].tolist())

    def sample(self, time_s: float) -> tuple[Positions, Positions]:
        """Return positions and velocities of the joints at a time since the start, s."""
        index = min(bisect_right(self._times, max(time_s, 0.0)), len(self._times) - 1)
        (a, b), (m, n) = self._nodes[index - 1 : index + 1], self._velocities[index - 1 : index + 1]
        begin, end = self._times[index - 1 : index + 1]
        if time_s >= end:  # after the last node
            return self.last, (0.0,) * len(b)
        span = end - begin
        share, leaving, entering = max(time_s - begin, 0.0) / span, m * span, n * span
        bend, twist = 3 * (b - a) - 2 * leaving - entering, leaving + entering - 2 * (b - a)
        positions = a + share * (leaving + share * (bend + share * twist))
        velocities = (leaving + share * (2 * bend + 3 * share * twist)) / span
        # Between a node at a limit and the next one, the spline would pass the limit.
        within = np.minimum(np.maximum(positions, self._lower), self._upper)
        return tuple(within.tolist()), tuple(velocities.tolist())


Planning = Generator[None, None, Path]
"""Planning of a path, which it returns, or raises NoPath: each `next` has a bounded cost."""


def plan_joints(
    solver: Solver, start: Positions, target: Transform, limits: MotionLimits, *, exact: bool
) -> Planning:
    """Plan a motion in which all joints turn evenly from the start to the pose."""
    found = yield from solver.search(target, start, exact=exact)
    if not found.residual.suffices(exact):
        raise NoPath(out_of_reach(found.residual, exact))
    return (yield from plan_positions(solver, start, found.positions, target, limits))


def plan_positions(
    solver: Solver, start: Positions, goal: Positions, target: Transform, limits: MotionLimits
) -> Planning:
    """Plan a motion in which all joints turn evenly from the start to goal positions."""
    for joint, at, low, high in zip(solver.chain.joints, goal, solver.lower, solver.upper, strict=True):
        if not low - _ROUNDING <= at <= high + _ROUNDING:
            raise NoPath(f"the pose has {joint} outside its limits")
    count = _count(max(abs(b - a) for a, b in zip(start, goal, strict=True)) / _NODE_RAD)
    places = np.arange(count + 1) / count
    nodes = np.array(start) + places[:, None] * (np.array(goal) - start)
    nodes[-1] = goal
    return (yield from _timed(solver, places, nodes, target, limits))


def plan_line(
    solver: Solver, start: Positions, target: Transform, limits: MotionLimits, *, exact: bool
) -> Planning:
    """Plan a motion in which the tip moves on a straight line and turns about one axis to the pose."""
    search = solver.search(target, start, exact=True) if exact else solver.search_place(target, start)
    found = yield from search
    if not found.residual.suffices(exact):
        raise NoPath(out_of_reach(found.residual, exact))
    begin = solver.chain.pose(start)
    way, turn = distance(begin, target)
    length = math.hypot(*way)
    longest = 1.0 / _count(max(length / _NODE_M, math.hypot(*turn) / _NODE_RAD))
    places, nodes, step = [0.0], [start], longest
    while places[-1] < 1.0:
        place = places[-1] + step
        place = 1.0 if place > 1.0 - _LEAST else place
        here = shifted(begin, scaled(way, place), scaled(turn, place))
        found = yield from solver.search_from(here, _guess(places, nodes, place), exact=exact)
        effort = _effort([*places[-2:], place], [*nodes[-2:], found.positions])
        is_solved = found.residual.suffices(exact)
        if is_solved and effort <= 1.0:
            places.append(place)
            nodes.append(found.positions)
        elif step <= longest * 0.5**_SPLITS or len(nodes) >= _MOST_SPLIT:
            passed, whole = places[-1] * length * 1e3, length * 1e3
            raise NoPath(
                f"the straight line ends after {passed:.0f} of {whole:.0f} mm, at a limit of a joint or "
                "where a joint would leap; write path=joints"
            )
        factor = min(2.0, max(0.25, _MARGIN / max(effort, _LEAST))) if is_solved else 0.5
        step = min(max(step * factor, longest * 0.5**_SPLITS), longest)
        yield
    return (yield from _timed(solver, np.array(places), np.array(nodes), target, limits))


def out_of_reach(residual: Residual, exact: bool) -> str:
    """Return the reason why a pose is refused, with the distance of the nearest solution."""
    turn = f" and {math.degrees(residual.orientation):.1f} deg" if exact else ""
    return f"the pose is out of reach; the nearest is {residual.position * 1e3:.1f} mm{turn} away"


def remark_on(residual: Residual) -> str:
    """Return what is not reached of a pose with an orientation; empty if all is."""
    if residual.suffices(exact=True):
        return ""
    return f"{math.degrees(residual.orientation):.1f} deg from the orientation, which the arm cannot reach"


def _count(needed: float) -> int:
    return min(_MOST_NODES, max(_FEWEST_NODES, math.ceil(needed)))


def _guess(places: Sequence[float], nodes: Sequence[Positions], place: float) -> Positions:
    """Return the positions at a place by the line through the last two nodes."""
    if len(nodes) < 2:
        return nodes[-1]
    share = (place - places[-1]) / (places[-1] - places[-2])
    return tuple(b + (b - a) * share for a, b in zip(nodes[-2], nodes[-1], strict=True))


def _effort(places: Sequence[float], nodes: Sequence[Positions]) -> float:
    """Return the part of the limits of jump and bend that the last of two or three nodes takes.

    The bend grows with the square of the distance of two nodes, so it counts by its root.
    """
    jump = max(abs(a - b) for a, b in zip(nodes[-2], nodes[-1], strict=True))
    if len(nodes) < 3:
        return jump / _JUMP_RAD
    first, last = places[1] - places[0], places[2] - places[1]
    turns = (abs((c - b) / last - (b - a) / first) for a, b, c in zip(*nodes, strict=True))
    return max(jump / _JUMP_RAD, math.sqrt(min(first, last) * max(turns) / _BEND_RAD))


def _timed(
    solver: Solver, places: Floats, nodes: Floats, target: Transform, limits: MotionLimits
) -> Planning:
    """Give each node its time."""
    poses: list[Transform] = []
    for node in nodes.tolist():
        poses.append(solver.chain.pose(node))
        if len(poses) % 3 == 0:  # as long as a step of a search
            yield
    ways = np.diff(places)
    slopes = np.gradient(nodes, places, axis=0)
    tops, gains = _bounds(ways, nodes, slopes, poses, limits)
    yield
    speeds = [0.0, *tops, 0.0]
    # Forward, no node is passed faster than the acceleration before it allows; backward, than braking does.
    for index, gain in enumerate(gains):
        speeds[index + 1] = min(speeds[index + 1], math.sqrt(speeds[index] ** 2 + gain))
    for index, gain in reversed([*enumerate(gains)]):
        speeds[index] = min(speeds[index], math.sqrt(speeds[index + 1] ** 2 + gain))
    times = [0.0] * len(nodes)
    if np.abs(slopes).max() >= _LEAST:
        pairs = zip(ways.tolist(), speeds, speeds[1:], strict=False)
        times = [*accumulate((2 * way / (a + b) for way, a, b in pairs), initial=0.0)]
    return Path(times, nodes, slopes * np.array(speeds)[:, None], residual_of(poses[-1], target), solver)


def _bounds(
    ways: Floats, nodes: Floats, slopes: Floats, poses: Sequence[Transform], limits: MotionLimits
) -> tuple[list[float], list[float]]:
    """Return bounds of the speed of the place.

    Returns:
        Highest speed at each node but the first and the last, 1/s; largest change of the squared speed
        between each two nodes, 1/s^2.
    """
    # Largest derivatives of each joint on the spline between two nodes; the second one is at one of its ends.
    chords, begin, end = np.diff(nodes, axis=0) / ways[:, None], slopes[:-1], slopes[1:]
    rates = np.maximum.reduce(np.abs((begin, end, 1.5 * chords - (begin + end) / 4)))
    bends = np.maximum.reduce(np.abs((6 * chords - 4 * begin - 2 * end, 6 * chords - 2 * begin - 4 * end)))
    places = np.diff([pose.translation for pose in poses], axis=0) / ways[:, None]
    # The length of a short turn is twice that of the way of its quaternion.
    turns = 2 * _lengths(np.diff([pose.rotation for pose in poses], axis=0)) / ways
    rates = np.maximum(np.column_stack((_lengths(places), turns, rates)), _LEAST)
    shares = np.array(limits.acceleration) * (_TIP_SHARE, 1.0, *(_SHARE,) * len(nodes[0]))
    tops = np.minimum(
        (limits.velocity / rates).min(axis=1),
        np.sqrt(shares[2:] / np.maximum(bends / ways[:, None], _LEAST)).min(axis=1),
    )
    bend = np.maximum(_lengths(np.diff(places, axis=0)) / ((ways[:-1] + ways[1:]) / 2), _LEAST)
    near = np.pad((shares / rates).min(axis=1), 1, "edge")
    gains = 2 * ways * np.minimum.reduce((near[:-2], near[1:-1], near[2:]))
    return np.minimum.reduce((tops[:-1], tops[1:], np.sqrt(shares[0] / bend))).tolist(), gains.tolist()


def _lengths(rows: Floats) -> Floats:
    lengths: Floats = np.sqrt(sum(column * column for column in rows.T))
    return lengths
