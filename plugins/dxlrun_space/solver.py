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
FIRST_STARTS: Final = 8
"""Starts of a search before it asks whether the position is in reach: the present positions, the middle of
the limits, then positions spread over the limits."""
STARTS: Final = 100
"""Most starts. One in six leads to a solution of the worst arm that was tried, a Koch."""
_NEAR_M: Final = 1e-3
"""Position error of the first starts, m, beyond which a pose counts as out of reach."""
_POSTURE: Final = 1e-5
"""Weight of the distance from the posture, as a fraction of the arm's length, m/rad."""
_PULL: Final = 0.02
"""Weight of the posture of an arm with more joints than a pose needs, as a fraction of the length, m/rad."""
_LONGEST_STEP: Final = 1.0
"""Largest change of a joint in a step, rad or m: the linear model is not valid for more."""
_STILL: Final = 1e-7
"""Change of all joints below which a search has converged, rad or m."""
_DAMPING: Final = (1e-3, 1e-12, 1e3)
"""First, smallest and largest damping, as a fraction of the square of the arm's length."""
_POSE: Final = 6
"""Degrees of freedom of a pose. Joints in addition leave a choice."""
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
        self._redundant = len(chain.joints) > _POSE and any(each is not None for each in self._posture)
        self._tendency = (_POSTURE * chain.length) ** 2

    def search(self, target: Pose, start: Sequence[float], *, exact: bool) -> Search:
        """Search from several starts; the first is `start`. The best solution is returned.

        The result is close to the target, or the nearest that was found: by position first unless `exact`.
        """
        best = yield from self.search_from(target, start, exact=True)
        for number in range(1, FIRST_STARTS):
            if best.residual.is_close:
                return best
            found = yield from self.search_from(target, self._start(number, start), exact=True)
            best = min(best, found, key=lambda one: _cost(one.residual, exact))
        # Position and orientation are not reached together: is the position in reach at all?
        nearest = best
        for each in (best.positions, *(self._start(number, start) for number in range(FIRST_STARTS))):
            found = yield from self.search_from(target, each, exact=False, steps=2 * STEPS)
            nearest = min(nearest, found, key=lambda one: _cost(one.residual, exact=False))
        if nearest.residual.position > _NEAR_M:
            return best if exact else nearest
        for number in range(FIRST_STARTS, STARTS):
            found = yield from self.search_from(target, self._start(number, start), exact=True)
            if found.residual.is_close:
                return found
            best = min(best, found, key=lambda one: _cost(one.residual, exact))
        return best if exact else nearest

    def _start(self, number: int, start: Sequence[float]) -> tuple[float, ...]:
        """Return the positions at which a search begins: a Halton sequence after the first two."""
        if number == 0:
            return tuple(start)
        positions = []
        for index, (lower, upper) in enumerate(zip(self.lower, self.upper, strict=True)):
            low, high = max(lower, -math.pi), min(upper, math.pi)
            share = 0.5 if number == 1 else _halton(number + 3, _PRIMES[index % len(_PRIMES)])
            positions.append(low + share * (high - low))
        return tuple(positions)

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
        self, target: Pose, start: Sequence[float], weight: float, steps: int, leash: float
    ) -> Search:
        scale = self.chain.length
        weight = (weight * scale) ** 2
        damping, least, most = (each * scale * scale for each in _DAMPING)
        now = self._inside(start)
        posture = [
            a if b is None else min(max(b, a - leash), a + leash)
            for a, b in zip(now, self._posture, strict=True)
        ]
        model = self._model(target, now, posture, weight)
        for _ in range(steps):
            if model.residual.is_exact and self._tendency < model.weight * 1e-3:
                break
            change = self._step(model, now, damping)
            trial = self._inside([a + b for a, b in zip(now, change, strict=True)])
            if max(abs(a - b) for a, b in zip(trial, now, strict=True)) < _STILL:
                break
            yield
            tried = self._model(target, trial, posture, weight)
            if tried.cost < model.cost:
                now, model, damping = trial, tried, max(least, damping * 0.1)
            elif damping >= most:
                break
            else:
                damping = max(damping, 1e-9 * scale * scale) * 5
        return Solution(now, model.residual)

    def _inside(self, positions: Sequence[float]) -> tuple[float, ...]:
        return tuple(
            min(max(each, lower), upper)
            for each, lower, upper in zip(positions, self.lower, self.upper, strict=True)
        )

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

    def _step(self, model: _Model, now: Sequence[float], damping: float) -> list[float]:
        """Return the change of the joints that minimizes the model; joints at a limit do not move outward."""
        gradient = model.gradient
        free = [
            index
            for index, slope in enumerate(gradient)
            if not (slope > 0 and now[index] >= self.upper[index])
            and not (slope < 0 and now[index] <= self.lower[index])
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
