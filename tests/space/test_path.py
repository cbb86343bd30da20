"""Paths: straight, within all limits also through singularities, without jumps; what has none is refused."""

import math
import random
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.judged_arms import Arm, arms, as_pose, six_axis, turn

from dxlrun_space.path import MotionLimits, NoPath, Path, plan_joints, plan_line

all_arms = cache(arms)
SPEED, RATE = 4.0, 20.0
"""Limits of joints, rad/s and rad/s^2"""


def limits_of(arm: Arm) -> MotionLimits:
    count = len(arm.joints)
    return MotionLimits((0.2, 1.5, *(SPEED,) * count), (0.5, 6.0, *(RATE,) * count))


def planned(planning: Any) -> Any:
    for _ in range(100_000):
        try:
            next(planning)
        except StopIteration as done:
            return done.value
    raise AssertionError("planning has no end")


def sampled(arm: Arm, path: Path, period_s: float = 0.005) -> tuple[Any, Any]:
    """Return joint positions each period, and the tip's positions."""
    count = math.ceil(path.duration_s / period_s)
    rows = np.array([path.sample(index * period_s)[0] for index in range(count + 1)])
    return rows, np.array([arm.chain.pose(row).translation for row in rows.tolist()])


def assert_within(arm: Arm, rows: Any, tips: Any, period_s: float = 0.005) -> None:
    """Speeds and accelerations are those of the limits; the splines between nodes take 5 % more."""
    assert np.abs(np.diff(rows, axis=0)).max() / period_s <= SPEED * 1.05
    assert np.abs(np.diff(rows, 2, axis=0)).max() / period_s**2 <= RATE * 1.05
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / period_s <= 0.2 * 1.05
    rates = np.linalg.norm(np.diff(tips, 2, axis=0), axis=1) / period_s**2
    assert np.quantile(rates, 0.95) <= 0.5 * 1.05
    assert rates.max() <= 0.5 * 4  # where a joint comes to its limit, for a moment
    assert all(arm.within(row) for row in rows)


def deviation(tips: Any) -> float:
    """Return the largest distance of the tip from the line of its first and last place."""
    way = tips[-1] - tips[0]
    off = tips - tips[0]
    along = off @ way / (way @ way)
    assert (np.diff(along) * np.linalg.norm(way) >= -2e-5).all()
    return float(np.linalg.norm(off - np.outer(along, way), axis=1).max())


@pytest.mark.parametrize("name", ["open_manipulator_x", "koch", "poppy_ergo_jr", "six"])
@campaign(ci=4, night=100, release=500)
def test_lines_are_straight_and_within_all_limits(name: str, amount: int, chance: random.Random) -> None:
    arm, played = all_arms()[name], 0
    for _ in range(amount):
        start, dice = arm.drawn(chance, 0.6), np.random.default_rng(chance.randrange(1 << 30))
        goal, way = arm.matrix(start), dice.normal(size=3)
        goal[:3, 3] += 0.4 * chance.random() * arm.chain.length * way / np.linalg.norm(way)
        try:
            path = planned(plan_line(arm.solver, start, as_pose(goal), limits_of(arm), exact=arm.exact))
        except NoPath:
            continue
        played += 1
        rows, tips = sampled(arm, path)
        assert deviation(tips) < 2e-4
        assert tips[-1] == pytest.approx(goal[:3, 3], abs=1e-4)
        assert rows[0] == pytest.approx(start)
        assert_within(arm, rows, tips)
    assert played


def test_a_line_of_20_cm() -> None:
    arm = all_arms()["open_manipulator_x"]
    start = planned(
        plan_joints(arm.solver, (0.0, -0.5, 0.5, 0.5), as_pose(shifted(arm, (0, 0, 0, 0), (0.2, -0.1, 0.15))),
                    limits_of(arm), exact=False)
    ).last  # fmt: skip
    goal = arm.matrix(start)
    goal[1, 3] += 0.2
    path = planned(plan_line(arm.solver, start, as_pose(goal), limits_of(arm), exact=False))
    rows, tips = sampled(arm, path)
    assert deviation(tips) < 5e-5
    assert_within(arm, rows, tips)
    assert path.duration_s == pytest.approx(0.2 / 0.2 + 0.2 / 0.35, rel=0.05)  # 0.7 of the acceleration


def shifted(arm: Arm, at: tuple[float, ...], place: tuple[float, ...]) -> Any:
    found = arm.matrix(at)
    found[:3, 3] = place
    return found


def test_speeds_are_kept_through_a_singularity_of_the_wrist() -> None:
    """The wrist of a six-axis arm passes j4 = 0, where j3 and j5 turn about the same axis."""
    arm = six_axis()
    start = (0.0, -0.6, 0.9, 0.0, 0.05, 0.0)
    goal = arm.matrix(start)
    goal[:3, :3] = turn((0, 1, 0), 0.6) @ turn((1, 0, 0), 0.05) @ goal[:3, :3]
    fast = MotionLimits((0.2, 500.0, *(SPEED,) * 6), (0.5, *(1e5,) * 7))
    path = planned(plan_line(arm.solver, start, as_pose(goal), fast, exact=True))
    rows, tips = sampled(arm, path)
    assert np.abs(np.diff(rows, axis=0)).max() / 0.005 <= SPEED * 1.05
    assert np.linalg.norm(tips - tips[0], axis=1).max() < 1e-3


def test_a_line_past_the_first_axis_is_slow_and_one_through_the_base_refused() -> None:
    arm, end = all_arms()["open_manipulator_x"], (0.0, 0.0, 0.0, 0.0)
    begin = planned(
        plan_joints(
            arm.solver, end, as_pose(shifted(arm, end, (0.06, -0.05, 0.28))), limits_of(arm), exact=False
        )
    ).last
    past = as_pose(shifted(arm, begin, (0.02, 0.05, 0.28)))
    path = planned(plan_line(arm.solver, begin, past, limits_of(arm), exact=False))
    assert_within(arm, *sampled(arm, path))
    start, through = (1.4, 0.0, 0.3, -0.1), as_pose(shifted(arm, begin, (-0.15, -0.2, -0.05)))
    with pytest.raises(NoPath, match=r"the straight line ends after [0-9]+ of 5[0-9]{2} mm, at a limit"):
        planned(plan_line(arm.solver, start, through, limits_of(arm), exact=False))
    around = planned(plan_joints(arm.solver, start, through, limits_of(arm), exact=False))
    assert_within(arm, *sampled(arm, around))


@pytest.mark.parametrize("name", ["open_manipulator_x", "koch", "op3", "six"])
def test_all_joints_turn_evenly_to_a_pose(name: str) -> None:
    arm, chance = all_arms()[name], random.Random(4)
    for _ in range(5):
        start, end = arm.drawn(chance, 0.7), arm.drawn(chance)
        path = planned(plan_joints(arm.solver, start, arm.target(end), limits_of(arm), exact=arm.exact))
        rows, tips = sampled(arm, path)
        ways = rows[-1] - rows[0]
        shares = (rows - rows[0]) @ ways / (ways @ ways)
        assert rows == pytest.approx(rows[0] + np.outer(shares, ways), abs=1e-6)
        assert arm.matrix(rows[-1]) == pytest.approx(arm.matrix(end), abs=3e-4)
        assert_within(arm, rows, tips)


def test_no_motion_takes_no_time() -> None:
    arm = all_arms()["open_manipulator_x"]
    start = (0.1, 0.2, 0.3, 0.4)
    path = planned(plan_line(arm.solver, start, arm.target(start), limits_of(arm), exact=False))
    assert path.duration_s == 0.0
    assert path.sample(0.0)[0] == pytest.approx(start)
