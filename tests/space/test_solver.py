"""Poses are solved within limits, judged by matrices of our own and by pinocchio; distances are true."""

import math
import random
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.judged_arms import Arm, apart, arms, as_pose, six_axis

from dxlrun_space.path import MotionLimits, plan_joints
from dxlrun_space.solver import Solver

NAMES = ("open_manipulator_x", "koch", "op3", "poppy_ergo_jr", "six", "seven", "sliding")
MOST_STEPS = 1000  # 0.3 s of planning
SPEED, RATE = 4.0, 20.0  # rad/s, rad/s^2
all_arms = cache(arms)


def found_by(search: Any) -> Any:
    """Return what a search finds, and count its steps."""
    for _ in range(MOST_STEPS):
        try:
            next(search)
        except StopIteration as done:
            return done.value
    raise AssertionError("the search has no end")


@pytest.mark.parametrize("name", NAMES)
@campaign(ci=1, night=20, release=400)
def test_reachable_poses_are_solved_without_a_jump(name: str, number: int, chance: random.Random) -> None:
    arm = all_arms()[name]
    count = len(arm.joints)
    limits = MotionLimits((1e3, 1e3, *(SPEED,) * count), (1e3, 1e3, *(RATE,) * count))
    for _ in range(25):
        goal, start = arm.drawn(chance), arm.drawn(chance)
        path = found_by(plan_joints(arm.solver, start, arm.target(goal), limits, exact=arm.exact))
        far, off = apart(arm.matrix(path.last), arm.matrix(goal))
        assert far < 1e-4, (goal, start)
        assert off < math.radians(0.1), (goal, start)
        rows = np.array(
            [path.sample(0.02 * cycle)[0] for cycle in range(math.ceil(path.duration_s * 50) + 1)]
        )
        assert rows[0] == pytest.approx(start)
        assert all(arm.within(row) for row in rows)
        assert np.abs(np.diff(rows, axis=0)).max() <= SPEED * 0.02 * 1.001
        assert np.abs(np.diff(rows, 2, axis=0)).max(initial=0.0) <= RATE * 0.02**2 * 1.001


@pytest.mark.parametrize("name", NAMES)
@campaign(ci=4, night=100, release=1000)
def test_unreachable_poses_have_a_true_distance(name: str, amount: int, chance: random.Random) -> None:
    """No position of thousands is nearer than what was found."""
    arm, dice = all_arms()[name], np.random.default_rng(chance.randrange(1 << 30))
    draws = dice.uniform(arm.lower, arm.upper, (2000, len(arm.joints)))
    tips = np.array([arm.chain.pose(row).translation for row in draws.tolist()])
    for _ in range(amount):
        goal = arm.matrix(arm.drawn(chance))
        way = dice.normal(size=3)
        goal[:3, 3] = goal[:3, 3] + way / np.linalg.norm(way) * arm.chain.length * 2
        solution = found_by(arm.solver.search(as_pose(goal), arm.drawn(chance), exact=False))
        far, _ = apart(arm.matrix(solution.positions), goal)
        assert solution.residual.position == pytest.approx(far, abs=1e-9)
        assert far <= np.linalg.norm(tips - goal[:3, 3], axis=1).min() + 1e-4
        assert arm.within(solution.positions)


@pytest.mark.parametrize("name", NAMES)
def test_the_chain_has_the_poses_and_the_jacobian_of_the_urdf(name: str) -> None:
    arm, chance = all_arms()[name], random.Random(1)
    for _ in range(20):
        at = arm.drawn(chance)
        pose = arm.chain.pose(at)
        columns, here = arm.chain.jacobian(), arm.matrix(at)
        assert abs(np.dot(pose.rotation, as_pose(here).rotation)) == pytest.approx(1.0, abs=1e-12)
        assert pose.translation == pytest.approx(here[:3, 3], abs=1e-12)
        for joint, column in enumerate(columns):
            moved = [each + 1e-6 * (row == joint) for row, each in enumerate(at)]
            slope = (arm.matrix(moved) - here) / 1e-6
            spin = slope[:3, :3] @ here[:3, :3].T
            assert column[:3] == pytest.approx(slope[:3, 3], abs=1e-5)
            assert column[3:] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_pinocchio_agrees(name: str) -> None:
    pytest.importorskip("pinocchio", reason="pin has 380 MB, so only the extra `full` has it")
    arm, chance = all_arms()[name], random.Random(2)
    for _ in range(20):
        at = arm.drawn(chance)
        assert arm.matrix_of_pinocchio(at) == pytest.approx(arm.matrix(at), abs=1e-12)


def test_an_arm_with_seven_joints_tends_to_its_posture() -> None:
    arm, chance = six_axis(more=True), random.Random(3)
    wanted = [0.0] * 7
    tending = Solver(arm.chain, arm.lower, arm.upper, wanted)
    norms = np.zeros(2)
    for _ in range(20):
        goal = arm.drawn(chance, 0.5)
        start = [each + chance.uniform(-0.3, 0.3) for each in goal]
        found = [found_by(one.search(arm.target(goal), start, exact=True)) for one in (arm.solver, tending)]
        assert all(one.residual.suffices(exact=True) for one in found)
        norms += [math.hypot(*one.positions) for one in found]
    assert norms[1] < 0.95 * norms[0], norms
    # From here the way to the posture ends 0.9 mm off the pose.
    goal, start = (
        (1.227, 0.663, 1.717, -1.976, -0.032, -2.893, 1.687),
        (1.575, 1.955, -2.65, 0.2, -0.1, -2.2, -1.7),
    )
    assert found_by(tending.search(arm.target(goal), start, exact=True)).residual.suffices(exact=True)


def test_a_search_is_the_same_each_time_also_after_one_that_was_dropped() -> None:
    arm = six_axis(more=True)
    solver, target = Solver(arm.chain, arm.lower, arm.upper, [0.0] * 7), arm.target((0.4,) * 7)
    once = found_by(solver.search(target, (0.1,) * 7, exact=True))
    for steps in range(0, 40, 3):
        dropped = solver.search(target, (0.2,) * 7, exact=True)
        for _ in range(steps):
            next(dropped, None)
        assert found_by(solver.search(target, (0.1,) * 7, exact=True)) == once


def test_the_orientation_moves_no_position_near_a_singularity() -> None:
    arm, at = all_arms()["koch"], (2.436, 2.392, -2.368, -2.217, 1.792)
    goal = arm.matrix(at)
    goal[:3, :3] = goal[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    solution = found_by(arm.solver.search_from(as_pose(goal), at, exact=False))
    assert apart(arm.matrix(solution.positions), goal)[0] < 2e-5


def test_position_comes_first_where_the_orientation_cannot_be_reached() -> None:
    arm: Arm = all_arms()["op3"]
    goal = arm.matrix((0.3, 0.2, 0.9))
    goal[:3, :3] = goal[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    solution = found_by(arm.solver.search(as_pose(goal), (0.0, 0.0, 0.0), exact=False))
    assert solution.residual.position < 1e-4
    assert solution.residual.orientation > 0.1
