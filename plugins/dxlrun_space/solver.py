"""Solver: joint positions for a pose of the tip, by damped least squares within the joints' limits.

Levenberg-Marquardt with projection onto the limits (J. J. Moré, "The Levenberg-Marquardt algorithm", 1978;
for inverse kinematics T. Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method", IEEE T-RO 2011). A step has a bounded cost, so a cycle affords a fixed number of steps.

An orientation error counts as an arc, m: the angle times a lever, which is a fraction of the arm's length.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from itertools import compress
from operator import mul
from typing import Final

import msgspec
import numpy as np

from dxlrun.tooling.robots import Transform, conjugate, product
from dxlrun_space.chain import Chain, Column, Vector, rotation_vector, scaled, spread

EXACT: Final = 0.3
"""Lever of the orientation where it must be reached."""
NEAREST: Final = 0.002
"""Lever where position comes first: 1 rad of orientation moves the solution by less than 0.01 mm."""
CLOSE_M: Final = 2e-5
"""Position error of a solution, m. A tick of 0.088 deg moves the tip of an arm of 0.3 m by 0.5 mm."""
CLOSE_RAD: Final = 2e-4
"""Orientation error of a solution, rad."""
STEPS: Final = 20
"""Steps per start of a search."""
SAMPLES: Final = 2000
"""Positions whose poses are known beforehand. A search begins at those with the nearest poses."""
STARTS: Final = 160
"""Starts for position and orientation; of 6,000 poses in reach of six joints, one needed 116."""
PLACES: Final = 8
"""Starts for the position alone, each to its end: of 6,000 poses out of reach, some have a nearer one."""
_NEAR: Final = 0.05
"""Position error, as a fraction of the length, within which orientations are tried."""
_FAILING: Final = 0.8
"""A start is given up when two steps together do not reduce the cost to this fraction."""
_STALLING: Final = 1 - 1e-6
"""Ratio of two costs beyond which the nearest pose is found: the rest of its distance is 0.1 mm in 1 m."""
_PULL: Final = 0.02
"""Lever of the posture of an arm with more joints than a pose needs."""
_FINE: Final = 0.05
"""Part of a solution's errors below which a step would not matter, even between close nodes of a path."""
_LEASH: Final = 0.05
"""Largest distance in which the posture attracts a joint without a leap, rad or m."""
_LONGEST_STEP: Final = 1.0
"""Largest change of a joint in a step, rad or m: the linear model is not valid for more."""
_STILL: Final = 1e-7
"""Change of all joints below which a search has converged, rad or m."""
_DAMPING: Final = (1e-3, 1e-7, 1e-10)
"""First damping, that of a start near the solution, and smallest: parts of the squared length."""
FULL: Final = 6
"""Degrees of freedom of a pose. Fewer joints lack orientations, and more leave a choice."""


class Residual(msgspec.Struct, frozen=True):
    """Distance of a pose from its target."""

    position: float
    """m"""
    orientation: float
    """rad"""

    def suffices(self, exact: bool, share: float = 1.0) -> bool:
        """Return True if a pose has the position of its target and, if `exact`, the orientation.

        `share` is the part of the errors of a solution that is permitted.
        """
        return self.position <= share * CLOSE_M and (not exact or self.orientation <= share * CLOSE_RAD)


class Solution(msgspec.Struct, frozen=True):
    """Joint positions with their distance from the target, and the linear model of that distance."""

    positions: tuple[float, ...]
    residual: Residual
    cost: float
    """Squared distance with all levers, m^2."""
    gradient: list[float]
    """Descent of half the cost by each joint."""
    columns: list[Column]


Search = Generator[None, None, Solution]
"""Search for a solution, which it returns: each `next` makes one step."""


def finish_search(search: Search) -> Solution:
    """Make all steps of a search, and return its solution."""
    while True:
        try:
            next(search)
        except StopIteration as done:
            found: Solution = done.value
            return found


def distance(pose: Transform, target: Transform) -> tuple[Vector, Vector]:
    """Return the way from a pose to its target: translation, m, and rotation vector, rad, in the base."""
    (x, y, z), (u, v, w) = pose.translation, target.translation
    return (u - x, v - y, w - z), rotation_vector(product(target.rotation, conjugate(pose.rotation)))


def residual_of(pose: Transform, target: Transform) -> Residual:
    """Return the distance of a pose from its target."""
    way, turn = distance(pose, target)
    return Residual(math.hypot(*way), math.hypot(*turn))


class Solver:
    """Inverse kinematics of a chain.

    Args:
        chain: The chain.
        lower: Lowest position of each joint, rad or m; may be infinite.
        upper: Highest position of each joint.
        posture: Position to which each joint tends where the pose leaves a choice; None: where it starts.
    """

    def __init__(
        self,
        chain: Chain,
        lower: Sequence[float],
        upper: Sequence[float],
        posture: Sequence[float | None] = (),
    ) -> None:
        self.chain = chain
        self.lower, self.upper = tuple(lower), tuple(upper)
        self._posture = tuple(posture) or (None,) * len(chain.joints)
        self._redundant = len(chain.joints) > FULL and any(each is not None for each in self._posture)
        self._samples = [*map(tuple, spread(lower, upper, SAMPLES).tolist())]
        self._table = np.array(
            [(*pose.translation, *pose.rotation) for pose in map(chain.pose, self._samples)]
        ).T.copy()
        """Position and quaternion of each sample, one column each."""

    def _nearest(self, target: Transform, lever: float, count: int) -> list[tuple[float, ...]]:
        """Return the samples with the nearest poses.

        Sums and products of single elements only, which are the same on each processor.
        """
        x, y, z, *turn = self._table
        a, b, c = target.translation
        far = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
        alike = sum(one * other for one, other in zip(turn, target.rotation, strict=True))
        far -= (2 * lever * self.chain.length * alike) ** 2
        return [self._samples[index] for index in far.argsort(kind="stable")[:count].tolist()]

    def search(self, target: Transform, start: Sequence[float], *, exact: bool) -> Search:
        """Search from several starts; the first is `start`. The best solution is returned.

        The result is close to the target, or the nearest that was found: by position first unless `exact`.
        """
        best = yield from self._descend(target, start, EXACT, is_patient=False)
        if not best.residual.suffices(exact=True):
            place = yield from self.search_place(target, best.positions)
            if place.residual.position > _NEAR * self.chain.length:
                return (yield from self.search_from(target, place.positions, exact=False))
            best = yield from self._try_starts(target, best, EXACT, STARTS)
            if not exact and not best.residual.suffices(exact=True):
                best = yield from self.search_from(target, best.positions, exact=False)
                if best.residual.position > max(CLOSE_M, place.residual.position):
                    best = yield from self.search_from(target, place.positions, exact=False)
        if self._redundant:
            posed = yield from self.search_from(target, best.positions, exact=True, leash=math.inf)
            # The way to the posture may end where the pose cannot be reached.
            best = posed if posed.residual.suffices(exact=True) else best
        return best

    def search_place(self, target: Transform, start: Sequence[float]) -> Search:
        """Search for the nearest position, with any orientation."""
        best = yield from self._descend(target, start, 0.0, is_patient=False)
        return (yield from self._try_starts(target, best, 0.0, PLACES))

    def _try_starts(self, target: Transform, best: Solution, lever: float, count: int) -> Search:
        for each in self._nearest(target, lever, count):
            if best.residual.suffices(exact=lever > 0):
                return best
            found = yield from self._descend(target, each, lever, is_patient=not lever)
            best = min(best, found, key=lambda one: one.cost)
        return (yield from self._descend(target, best.positions, lever, 5 * STEPS))

    def search_from(
        self,
        target: Transform,
        start: Sequence[float],
        *,
        exact: bool,
        steps: int = STEPS,
        leash: float = _LEASH,
    ) -> Search:
        """Search from one start, without a leap to another solution.

        Args:
            target: Pose of the tip in the base.
            start: Joint positions.
            exact: The orientation counts as much as the position; otherwise position comes first.
            steps: Most steps.
            leash: Largest distance from the start in which the posture attracts a joint, rad or m.
        """
        lever = EXACT if exact else NEAREST
        if self._redundant:
            # First toward the posture, which moves the tip by 0.1 mm, then the pose from there.
            pairs = zip(self._inside(start), self._posture, strict=True)
            near = [a if b is None else min(max(b, a - leash), a + leash) for a, b in pairs]
            start = (yield from self._descend(target, start, lever, steps, near)).positions
        found = yield from self._descend(target, start, lever, steps)
        if not exact and not found.residual.suffices(exact=False):
            # Near a singularity even the small lever of the orientation moves the position.
            found = yield from self._descend(target, found.positions, 0.0, steps)
        return found

    def _descend(
        self,
        target: Transform,
        start: Sequence[float],
        lever: float,
        steps: int = STEPS,
        posture: Sequence[float] | None = None,
        *,
        is_patient: bool = True,
    ) -> Search:
        scale = self.chain.length
        lever, tendency = lever * scale, 0.0 if posture is None else (_PULL * scale) ** 2
        first, near, least = (each * scale * scale for each in _DAMPING)
        damping = near if is_patient else first
        now = self._inside(start)
        posture = posture or now
        best = self._estimate(target, now, posture, lever, tendency)
        before = last = math.inf
        for _ in range(steps):
            if not tendency and best.residual.suffices(lever > 0, _FINE):
                break
            change = self._step(best, damping + tendency)
            trial = self._inside([a + b for a, b in zip(best.positions, change, strict=True)])
            if max(abs(a - b) for a, b in zip(trial, best.positions, strict=True)) < _STILL:
                break
            yield
            tried = self._estimate(target, trial, posture, lever, tendency)
            if tried.cost < best.cost:
                is_still = tried.cost > _STALLING * best.cost
                best, damping = tried, max(least, damping * 0.1)
                if is_still:
                    break
            else:
                damping = max(damping, 1e-9 * scale * scale) * 5
            if not is_patient and best.cost > _FAILING * before and not best.residual.suffices(exact=True):
                break
            before, last = last, best.cost
        return best

    def _estimate(
        self,
        target: Transform,
        positions: tuple[float, ...],
        posture: Sequence[float],
        lever: float,
        tendency: float,
    ) -> Solution:
        """Return the distance at joint positions with its linear model; the lever is in m/rad."""
        way, turn = distance(self.chain.pose(positions), target)
        columns = self.chain.jacobian(lever)
        ways = [b - a for a, b in zip(positions, posture, strict=True)]
        (x, y, z), (u, v, w) = way, scaled(turn, lever)
        gradient = [
            a * x + b * y + c * z + d * u + e * v + f * w + tendency * each
            for (a, b, c, d, e, f), each in zip(columns, ways, strict=True)
        ]
        far, off = math.hypot(*way), math.hypot(*turn)
        cost = far * far + (lever * off) ** 2 + tendency * math.fsum(map(mul, ways, ways))
        return Solution(positions, Residual(far, off), cost, gradient, columns)

    def _step(self, model: Solution, damping: float) -> list[float]:
        """Return the change of the joints that minimizes the model; joints at a limit do not move outward."""
        rows = zip(model.gradient, model.positions, self.lower, self.upper, strict=True)
        free = [not (now >= upper if slope > 0 else now <= lower) for slope, now, lower, upper in rows]
        columns = [*compress(model.columns, free)]
        solved = solve(columns, [*compress(model.gradient, free)], damping)
        longest = max(map(abs, solved), default=0.0)
        scale = _LONGEST_STEP / longest if longest > _LONGEST_STEP else 1.0
        moves = iter(solved)
        return [next(moves) * scale if each else 0.0 for each in free]

    def _inside(self, positions: Sequence[float]) -> tuple[float, ...]:
        return tuple(map(min, map(max, positions, self.lower), self.upper))


def solve(columns: Sequence[Column], right: Sequence[float], damping: float) -> list[float]:
    """Solve (J^T J + damping) x = right by elimination; this matrix needs no pivots."""
    # Upper triangle, with the right side as last column.
    rows = [
        [a * u + b * v + c * w + d * x + e * y + f * z for u, v, w, x, y, z in columns[index:]]
        for index, (a, b, c, d, e, f) in enumerate(columns)
    ]
    for row, value in zip(rows, right, strict=True):
        row[0] += damping
        row.append(value)
    for index, (first, *rest) in enumerate(rows, 1):
        for place, below in enumerate(rows[index:]):
            share = rest[place] / first
            below[:] = [a - share * b for a, b in zip(below, rest[place:], strict=False)]
    solution: list[float] = []
    for first, *rest, value in reversed(rows):
        # By `fsum`, because `sum` rounds in another way from Python 3.12 on.
        solution.insert(0, (value - math.fsum(map(mul, rest, solution))) / first)
    return solution
