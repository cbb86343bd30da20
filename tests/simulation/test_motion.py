from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.simulation import motion

SPEED = 6.0
ACCELERATION = 100.0
SLACK = 1e-9


def samples(one: motion.Motion, until_ns: int, step_ns: int = 1_000_000) -> list[tuple[float, float, float]]:
    return [one.at(now) for now in range(one.start_ns, until_ns + step_ns, step_ns)]


angles = st.floats(0, 5.2)
speeds = st.floats(0.01, SPEED)


@settings(max_examples=80, deadline=None)
@given(angles, angles, speeds)
def test_from_rest_it_reaches_the_goal_and_never_passes_it(start: float, goal: float, speed: float) -> None:
    one = motion.move_to(5, start, 0.0, goal, speed=speed, acceleration=ACCELERATION)
    assert one.end_ns is not None
    step = max(1_000_000, one.end_ns // 200)
    seen = samples(one, one.end_ns + step, step)
    low, high = min(start, goal), max(start, goal)
    assert all(low - SLACK <= angle <= high + SLACK for angle, _, _ in seen)
    assert all(abs(velocity) <= speed + SLACK for _, velocity, _ in seen)
    assert all(abs(acceleration) <= ACCELERATION for _, _, acceleration in seen)
    assert seen[-1] == (goal, 0.0, 0.0)


@settings(max_examples=80, deadline=None)
@given(angles, st.floats(-SPEED, SPEED), angles, speeds)
def test_from_any_speed_angle_and_velocity_stay_continuous(
    start: float, velocity: float, goal: float, speed: float
) -> None:
    one = motion.move_to(0, start, velocity, goal, speed=speed, acceleration=ACCELERATION)
    assert one.end_ns is not None
    assert one.at(0)[:2] == pytest.approx((start, velocity))
    # The last piece ends where the goal is: what is given at the end is no jump.
    angle, last, _ = one.at(one.end_ns - 1)
    assert angle == pytest.approx(goal, abs=1e-6)
    assert last == pytest.approx(0.0, abs=1e-6)
    bound = max(abs(velocity), speed) + SLACK
    step = 500_000
    seen = (
        samples(one, one.end_ns, step)
        if one.end_ns < 2_000_000_000
        else [one.at(t * step) for t in range(500)]
    )
    for (angle0, velocity0, _), (angle1, velocity1, _) in itertools.pairwise(seen):
        assert abs(velocity1) <= bound
        assert abs(velocity1 - velocity0) <= ACCELERATION * step * 1e-9 + 1e-6
        assert abs(angle1 - angle0) <= bound * step * 1e-9 + 1e-6


def test_a_long_way_takes_the_time_of_a_trapezoid() -> None:
    one = motion.move_to(0, 0.0, 0.0, 3.0, speed=2.0, acceleration=10.0)
    # 0.2 s up to 2 rad/s, 0.2 s down, 0.4 rad in both: 2.6 rad at 2 rad/s between
    assert one.end_ns == pytest.approx((0.2 + 1.3 + 0.2) * 1e9, abs=2)
    assert one.at(850_000_000) == pytest.approx((1.5, 2.0, 0.0))


def test_a_short_way_takes_the_time_of_a_triangle() -> None:
    one = motion.move_to(0, 1.0, 0.0, 0.9, speed=2.0, acceleration=10.0)
    assert one.end_ns == pytest.approx(2 * math.sqrt(0.1 / 10) * 1e9, abs=2)
    assert one.at(100_000_000)[1] == pytest.approx(-1.0)


def test_too_fast_to_stop_it_passes_the_goal_and_comes_back() -> None:
    one = motion.move_to(0, 0.0, 2.0, 0.1, speed=2.0, acceleration=10.0)  # it needs 0.2 rad to stop
    assert one.end_ns is not None
    assert max(angle for angle, _, _ in samples(one, one.end_ns)) == pytest.approx(0.2, abs=1e-4)
    assert one.at(one.end_ns)[0] == 0.1


def test_a_lower_speed_is_reached_by_braking_only() -> None:
    one = motion.move_to(0, 0.0, 4.0, 3.0, speed=1.0, acceleration=10.0)
    assert one.at(300_000_000)[1] == pytest.approx(1.0)
    assert one.at(150_000_000)[2] == -10.0


def test_turning_keeps_its_speed_for_ever() -> None:
    one = motion.turn(0, 1.0, 0.0, -2.0, 10.0)
    assert one.at(100_000_000)[1] == pytest.approx(-1.0)
    assert one.at(10_200_000_000) == pytest.approx((1.0 - 0.2 - 20.0, -2.0, 0.0))
    assert one.end_ns is None


def test_rest_stays() -> None:
    assert motion.rest(7, 1.5).at(10**12) == (1.5, 0.0, 0.0)
    assert motion.rest(7, 1.5).at(0) == (1.5, 0.0, 0.0)
