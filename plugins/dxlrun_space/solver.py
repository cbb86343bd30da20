"""Solver: joint positions for a pose of the tip, by damped least squares within the joints' limits.

Levenberg-Marquardt with projection onto the limits (J. J. Moré, "The Levenberg-Marquardt algorithm", 1978;
for inverse kinematics T. Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method", IEEE T-RO 2011). A step has a bounded cost, so a cycle affords a fixed number of steps.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import Final

import msgspec
import numpy as np

from dxlrun_space.chain import Chain, Column, Pose, Vector, inverted, rotation_vector, times

EXACT: Final = 0.3
"""Weight of the orientation where it must be reached, as a fraction of the arm's length, m/rad."""
NEAREST: Final = 0.002
"""Weight where position comes first: 1 rad of orientation moves the solution by less than 0.01 mm."""
CLOSE_M: Final = 2e-5
"""Position error of a solution, m. A tick of 0.088 deg moves the tip of an arm of 0.3 m by 0.5 mm."""
CLOSE_RAD: Final = 2e-4
"""Orientation error of a solution, rad."""
STEPS: Final = 20
"""Steps per start of a search."""
SAMPLES: Final = 1000
"""Positions whose poses are known beforehand. A search begins at those with the nearest poses."""
STARTS: Final = 64
"""Most starts for position and orientation; 42 were the most of 2000 poses of four arms."""
FIRST_PLACES: Final = 4
PLACES: Final = 8
"""Starts for the position alone. Where the arm is folded, limits keep some of them from a place in reach."""
_FAR: Final = 0.05
"""Position error, as a fraction of the length, beyond which a pose counts as out of reach after the first."""
_FAILING: Final = 0.8
"""A start is given up when two steps together do not reduce the cost to this fraction."""
_STALLING: Final = 1 - 1e-5
"""Ratio of two costs beyond which the nearest position is found: the rest is 0.01 mm in 1 m."""
_POSTURE: Final = 1e-5
"""Weight of the distance from the posture, as a fraction of the arm's length, m/rad."""
_PULL: Final = 0.02
"""Weight of the posture of an arm with more joints than a pose needs, as a fraction of the length, m/rad."""
_LONGEST_STEP: Final = 1.0
"""Largest change of a joint in a step, rad or m: the linear model is not valid for more."""
_STILL: Final = 1e-7
"""Change of all joints below which a search has converged, rad or m."""
_DAMPING: Final = (1e-3, 1e-7, 1e-12, 1e3)
"""First damping, that of a start near the solution, smallest, and largest: parts of the squared length."""
FULL: Final = 6
"""Degrees of freedom of a pose. Fewer joints lack orientations, and more leave a choice."""
_PRIMES: Final = (2, 3, 5, 7, 11, 13, 17, 19, 23)


class Residual(msgspec.Struct, frozen=True):
    """Distance of a pose from its target."""

    position: float
    """m"""
    orientation: float
    """rad"""

    @property
    def is_close(self) -> bool:
        """True if position and orientation are those of the target."""
        return self.position <= CLOSE_M and self.orientation <= CLOSE_RAD

    @property
    def is_exact(self) -> bool:
        """True if another step would not matter, even between nodes of a path that are close together."""
        return self.position <= CLOSE_M / 20 and self.orientation <= CLOSE_RAD / 20


class Solution(msgspec.Struct, frozen=True):
    """Joint positions with their distance from the target."""

    positions: tuple[float, ...]
    residual: Residual


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


def distance(pose: Pose, target: Pose) -> tuple[Vector, Vector]:
    """Return the way from a pose to its target: translation, m, and rotation vector, rad, in the base."""
    (x, y, z), (u, v, w) = pose[1], target[1]
    return (u - x, v - y, w - z), rotation_vector(times(target[0], inverted(pose[0])))


def residual_of(pose: Pose, target: Pose) -> Residual:
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
        self._tendency = (_POSTURE * chain.length) ** 2
        self._unlimited = (-math.inf,) * len(self.lower), (math.inf,) * len(self.upper)
        self._samples = [self._spread(number) for number in range(SAMPLES)]
        poses = [(*place, *rotation) for rotation, place in map(chain.pose, self._samples)]
        self._table = np.array(poses).T.copy()
        """Position and rotation matrix of each sample, one column each."""

    def _spread(self, number: int) -> tuple[float, ...]:
        """Return positions that are spread evenly over the limits: a Halton sequence."""
        positions = []
        for index, (lower, upper) in enumerate(zip(self.lower, self.upper, strict=True)):
            low, high = max(lower, -math.pi), min(upper, math.pi)
            positions.append(low + _halton(number + 1, _PRIMES[index % len(_PRIMES)]) * (high - low))
        return tuple(positions)

    def _nearest(self, target: Pose, weight: float) -> list[tuple[float, ...]]:
        """Return the samples, the one with the nearest pose first.

        Sums and products of single elements only, which are the same on each processor.
        """
        half = (weight * self.chain.length) ** 2 / 2
        far = np.zeros(SAMPLES)
        for index, value in enumerate((*target[1], *target[0])):
            far += (self._table[index] - value) ** 2 * (half if index > 2 else 1.0)
        return [self._samples[index] for index in far.argsort(kind="stable")[:STARTS].tolist()]

    def search(self, target: Pose, start: Sequence[float], *, exact: bool) -> Search:
        """Search from several starts; the first is `start`. The best solution is returned.

        The result is close to the target, or the nearest that was found: by position first unless `exact`.
        """
        best = yield from self._descend(target, start, EXACT, is_patient=False)
        if not best.residual.is_close:
            place = yield from self.search_place(target, best.positions)
            if place.residual.position > _FAR * self.chain.length:
                return (yield from self.search_from(target, place.positions, exact=False))
            best = yield from self._search_samples(target, best, exact)
            if not exact and not best.residual.is_close:
                place = min(place, best, key=lambda one: one.residual.position)
                best = yield from self.search_from(target, place.positions, exact=False, steps=2 * STEPS)
        if self._redundant:
            best = yield from self.search_from(target, best.positions, exact=True)
        return best

    def search_place(self, target: Pose, start: Sequence[float]) -> Search:
        """Search for the nearest position, with any orientation."""
        best = yield from self._descend(target, start, 0.0)
        for number, each in enumerate(self._nearest(target, 0.0)[:PLACES]):
            far = best.residual.position
            if far <= CLOSE_M or (number >= FIRST_PLACES and far > _FAR * self.chain.length):
                break
            found = yield from self._descend(target, each, 0.0, 2 * STEPS)
            best = min(best, found, key=lambda one: one.residual.position)
        return best

    def _search_samples(self, target: Pose, best: Solution, exact: bool) -> Search:
        for each in self._nearest(target, EXACT):
            # Limits stop most descents early, so the way may pass them. Whole turns back, its end is a start.
            free = yield from self._descend(target, each, EXACT, is_patient=False, is_limited=False)
            back = self.chain.without_turns(free.positions)
            found = yield from self._descend(target, back, EXACT, is_patient=False)
            best = min(best, found, key=lambda one: _cost(one.residual, exact))
            if best.residual.is_close:
                return best
        return (yield from self._descend(target, best.positions, EXACT, 5 * STEPS))

    def search_from(
        self,
        target: Pose,
        start: Sequence[float],
        *,
        exact: bool,
        steps: int = STEPS,
        leash: float = math.inf,
    ) -> Search:
        """Search from one start, without a leap to another solution.

        Args:
            target: Pose of the tip in the base.
            start: Joint positions.
            exact: The orientation counts as much as the position; otherwise position comes first.
            steps: Most steps.
            leash: Largest distance from the start in which the posture attracts a joint, rad or m.
        """
        weight = EXACT if exact else NEAREST
        if self._redundant:
            # First a strong pull, which moves the tip by 0.1 mm, then the pose from there.
            self._tendency = (_PULL * self.chain.length) ** 2
            start = (yield from self._descend(target, start, weight, steps, leash)).positions
            self._tendency, leash = (_POSTURE * self.chain.length) ** 2, 0.0
        found = yield from self._descend(target, start, weight, steps, leash)
        if not exact and found.residual.position > CLOSE_M:
            # Near a singularity even the small weight of the orientation moves the position.
            found = yield from self._descend(target, found.positions, 0.0, steps, leash)
        return found

    def _descend(
        self,
        target: Pose,
        start: Sequence[float],
        weight: float,
        steps: int = STEPS,
        leash: float = math.inf,
        *,
        is_patient: bool = True,
        is_limited: bool = True,
    ) -> Search:
        scale, limits = self.chain.length, (self.lower, self.upper) if is_limited else self._unlimited
        weight = (weight * scale) ** 2
        first, near, least, most = (each * scale * scale for each in _DAMPING)
        damping = near if is_patient else first
        now = _inside(start, limits)
        posture = [
            a if b is None else min(max(b, a - leash), a + leash)
            for a, b in zip(now, self._posture, strict=True)
        ]
        model = self._model(target, now, posture, weight)
        before = last = math.inf
        for _ in range(steps):
            if model.residual.is_exact and self._tendency < model.weight * 1e-3:
                break
            if weight == 0.0 and model.residual.position <= CLOSE_M / 20:
                break
            change = self._step(model, now, damping, limits)
            trial = _inside([a + b for a, b in zip(now, change, strict=True)], limits)
            if max(abs(a - b) for a, b in zip(trial, now, strict=True)) < _STILL:
                break
            yield
            tried = self._model(target, trial, posture, weight)
            if tried.cost < model.cost:
                is_still = weight == 0.0 and tried.cost > _STALLING * model.cost
                now, model, damping = trial, tried, max(least, damping * 0.1)
                if is_still:
                    break
            elif damping >= most:
                break
            else:
                damping = max(damping, 1e-9 * scale * scale) * 5
            if not is_patient and model.cost > _FAILING * before and not model.residual.is_close:
                break
            before, last = last, model.cost
        return Solution(now, model.residual)

    def _model(
        self, target: Pose, positions: Sequence[float], posture: Sequence[float], weight: float
    ) -> _Model:
        """Return the linear model of the error at joint positions: cost, gradient, and normal matrix."""
        way, turn = distance(self.chain.pose(positions), target)
        columns = self.chain.jacobian()
        (x, y, z), (u, v, w) = way, (turn[0] * weight, turn[1] * weight, turn[2] * weight)
        pulls = [b - a for a, b in zip(positions, posture, strict=True)]
        tendency = self._tendency
        gradient = [
            a * x + b * y + c * z + d * u + e * v + f * w + tendency * pull
            for (a, b, c, d, e, f), pull in zip(columns, pulls, strict=True)
        ]
        far, off = math.hypot(x, y, z), math.hypot(*turn)
        cost = far * far + weight * off * off + tendency * sum(pull * pull for pull in pulls)
        return _Model(cost, gradient, columns, weight, Residual(far, off))

    def _step(self, model: _Model, now: Sequence[float], damping: float, limits: _Limits) -> list[float]:
        """Return the change of the joints that minimizes the model; joints at a limit do not move outward."""
        gradient, (lower, upper) = model.gradient, limits
        free = [
            index
            for index, slope in enumerate(gradient)
            if not (slope > 0 and now[index] >= upper[index])
            and not (slope < 0 and now[index] <= lower[index])
        ]
        change = [0.0] * len(now)
        solved = solve(
            normal_matrix([model.columns[index] for index in free], model.weight, damping + self._tendency),
            [gradient[index] for index in free],
        )
        longest = max((abs(each) for each in solved), default=0.0)
        scale = _LONGEST_STEP / longest if longest > _LONGEST_STEP else 1.0
        for index, each in zip(free, solved, strict=True):
            change[index] = each * scale
        return change


_Limits = tuple[tuple[float, ...], tuple[float, ...]]


def _inside(positions: Sequence[float], limits: _Limits) -> tuple[float, ...]:
    return tuple(min(max(each, lower), upper) for each, lower, upper in zip(positions, *limits, strict=True))


class _Model(msgspec.Struct, frozen=True):
    cost: float
    gradient: list[float]
    columns: list[Column]
    weight: float
    residual: Residual


def _cost(residual: Residual, exact: bool) -> tuple[float, float]:
    """Return the order of solutions: position first unless `exact`, where one rad counts as 0.1 m."""
    if exact:
        return residual.position + 0.1 * residual.orientation, 0.0
    return max(residual.position, CLOSE_M), residual.orientation


def _halton(number: int, prime: int) -> float:
    """Return the number-th member of the van der Corput sequence, 0..1."""
    value, share = 0.0, 1.0
    while number:
        share /= prime
        number, digit = divmod(number, prime)
        value += digit * share
    return value


def normal_matrix(columns: Sequence[Column], weight: float, damping: float) -> list[list[float]]:
    """Return the lower triangle of J^T W J + damping, with a weight, m^2/rad^2, for the orientation."""
    rows: list[list[float]] = []
    for index, (a, b, c, d, e, f) in enumerate(columns):
        g, h, i = d * weight, e * weight, f * weight
        rows.append(
            [a * u + b * v + c * w + g * x + h * y + i * z for u, v, w, x, y, z in columns[: index + 1]]
        )
        rows[index][index] += damping
    return rows


def solve(lower: list[list[float]], right: Sequence[float]) -> list[float]:
    """Solve a positive definite system, given by its lower triangle, which is overwritten (Cholesky)."""
    values: list[float] = []
    for index, row in enumerate(lower):
        for column in range(index):
            other = lower[column]
            total = row[column]
            for a, b in zip(row[:column], other, strict=False):
                total -= a * b
            row[column] = total / other[column]
        square = row[index]
        total = right[index]
        for a, b in zip(row[:index], values, strict=False):
            square -= a * a
            total -= a * b
        row[index] = root = math.sqrt(max(square, 1e-300))
        values.append(total / root)
    for index in range(len(values) - 1, -1, -1):
        total = values[index]
        for below in range(index + 1, len(values)):
            total -= lower[below][index] * values[below]
        values[index] = total / lower[index][index]
    return values
