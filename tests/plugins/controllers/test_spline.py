"""Our coefficients against scipy's, and against what a spline must keep."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun import Polynomial
from dxlrun_controllers.laws.spline import (
    CUBIC,
    LINEAR,
    QUINTIC,
    SplineSample,
    StopTrajectory,
    Trajectory,
    flatten,
    peak_velocities,
    smooth_velocities,
    solve,
)

values = st.floats(-10, 10)
boundary = st.tuples(values, values, values)


@pytest.mark.parametrize("order", [LINEAR, CUBIC, QUINTIC])
def test_the_peak_of_a_piece_is_that_of_its_roots(order):
    """The velocity has its extremes at the ends and at the roots of its derivative."""
    chance = np.random.default_rng(order)
    for duration in (0.05, 0.7, 3.0):
        piece = chance.normal(size=(order, 200)) * chance.uniform(0, 3) ** np.arange(order)[:, None]
        found, times = peak_velocities(piece, duration)
        for column, speed, at in zip(piece.T, found, times, strict=True):
            velocity = np.polynomial.Polynomial(column).deriv()
            roots = velocity.deriv().roots() if order > LINEAR else []
            inner = [root.real for root in roots if abs(root.imag) < 1e-9 and 0 < root.real < duration]
            highest = max(abs(velocity(time)) for time in (0.0, duration, *inner))
            assert abs(speed) == pytest.approx(highest, rel=1e-9)
            assert velocity(at) == pytest.approx(speed, rel=1e-9)


@settings(max_examples=160, deadline=None)
@given(
    order=st.sampled_from([CUBIC, QUINTIC]),
    start=boundary,
    end=boundary,
    duration=st.floats(0.01, 10),
    share=st.floats(0, 1),
)
def test_a_piece_is_scipys(order, start, end, duration, share):
    from scipy.interpolate import BPoly

    piece, found, at = np.empty((order, 1)), SplineSample(1), share * duration
    solve(order, duration, np.array(start)[:, None], np.array(end)[:, None], piece)
    theirs = BPoly.from_derivatives([0, duration], [start[: order // 2], end[: order // 2]])
    scale = max(1.0, *np.abs(start), *np.abs(end)) * max(1.0, duration**2)
    polynomial = Polynomial(QUINTIC, 1)
    polynomial.set_piece(np.ones((QUINTIC, 1)))  # an earlier piece leaves nothing
    polynomial.set_piece(piece)
    np.copyto(found.rows, polynomial.evaluate(at))
    assert found.position[0] == pytest.approx(float(theirs(at)), abs=1e-12 * scale)
    assert found.velocity[0] == pytest.approx(float(theirs(at, 1)), abs=1e-11 * scale / duration)
    assert found.acceleration[0] == pytest.approx(float(theirs(at, 2)), abs=1e-10 * scale / duration**2)


@settings(max_examples=60, deadline=None)
@given(
    gaps=st.lists(st.floats(0.01, 1), min_size=1, max_size=8),
    heights=st.lists(st.integers(-9, 9), min_size=9, max_size=9),
)
def test_smooth_velocities_are_those_of_scipys_pchip_interpolator(gaps, heights):
    from scipy.interpolate import PchipInterpolator

    times = np.cumsum([0.0, *gaps])
    positions = np.array(heights[: len(times)], dtype=float)[:, None]
    theirs = PchipInterpolator(times, positions)(times, 1)
    scale = max(1.0, float(np.abs(theirs).max()))
    np.testing.assert_allclose(smooth_velocities(times, positions), theirs, atol=1e-9 * scale)


def loaded(order, times, points, start_in=0.0, now=None):
    trajectory = Trajectory(points.shape[2])
    trajectory.load(
        flatten([order] * len(times), times, points, start_in), now or SplineSample(points.shape[2])
    )
    return trajectory


def sampled(trajectory, times, joints):
    sample, found = SplineSample(joints), []
    for time in times:
        trajectory.sample(time, sample)
        found.append((sample.position.copy(), sample.velocity.copy(), sample.acceleration.copy()))
    return np.array(found)


def test_each_piece_is_by_what_both_its_points_give():
    times, points = np.array([0.0, 1.0, 2.0, 3.0]), np.zeros((4, 3, 1))
    points[:, 0, 0] = 0.0, 1.0, 2.0, 0.0
    points[2:, 1, 0] = 0.5, 0.0
    trajectory = Trajectory(1)
    trajectory.load(flatten([LINEAR, LINEAR, CUBIC, CUBIC], times, points, 0.0), SplineSample(1))
    found = sampled(trajectory, [0.5, 1.5, 2.0, 2.5], 1)[:, :2, 0]
    np.testing.assert_allclose(found, [[0.5, 1.0], [1.5, 1.0], [2.0, 0.5], [1.0625, -3.125]])


@pytest.mark.parametrize("order", [LINEAR, CUBIC, QUINTIC])
@pytest.mark.parametrize("start_in", [0.0, 0.7])
def test_the_bridge_leads_from_now_to_the_first_point(order, start_in):
    now = SplineSample(1)
    now.position[:], now.velocity[:], now.acceleration[:] = 0.4, -0.3, 0.9
    points = np.array([[[1.0], [0.5], [0.2]], [[2.0], [0.1], [0.0]]])
    trajectory = loaded(order, np.array([0.5, 1.5]), points, start_in, now)
    end = start_in + 0.5
    (first, before, after) = sampled(trajectory, [0.0, end - 1e-9, end], 1)[:, : order // 2, 0]
    np.testing.assert_allclose(first, [0.4, -0.3, 0.9][: order // 2])
    np.testing.assert_allclose(before, [1.0, 0.5, 0.2][: order // 2], atol=1e-6)
    np.testing.assert_allclose(after, [1.0, 0.5, 0.2][: order // 2], atol=1e-12)
    assert trajectory.duration_s == start_in + 1.5


def test_a_bridge_from_a_motion_that_is_about_to_begin_keeps_its_velocity_of_none():
    now = SplineSample(1)
    now.acceleration[:] = 0.9
    trajectory = loaded(LINEAR, np.array([1.0]), np.array([[[1.0], [0.0], [0.0]]]), 0.0, now)
    np.testing.assert_allclose(sampled(trajectory, [0.0], 1)[0, :, 0], [0.0, 0.0, 0.9])


@settings(max_examples=80, deadline=None)
@given(state=boundary, most=st.floats(0.1, 50), share=st.floats(0, 1.2), room=st.floats(0, 30))
def test_a_stop_is_a_constant_deceleration_that_ends_before_the_limit(state, most, share, room):
    now, found, stop = SplineSample(1), SplineSample(1), StopTrajectory(1)
    position, velocity, _ = state
    now.position[:], now.velocity[:] = position, velocity
    lower, upper = (-np.inf, position + room) if velocity > 0 else (position - room, np.inf)
    stop.load(now, np.array([most]), np.array([lower]), np.array([upper]))
    room = upper - position if velocity > 0 else position - lower  # as it was rounded
    way = velocity**2 / (2 * most)
    used = most if way <= room else velocity**2 / (2 * room) if room else np.inf
    assert stop.duration_s == pytest.approx(abs(velocity) / used)
    t = min(share, 1.0) * stop.duration_s
    stop.sample(share * stop.duration_s, found)
    pull = np.sign(velocity) * used if stop.duration_s else 0.0
    assert found.position[0] == pytest.approx(position + velocity * t - pull * t**2 / 2, abs=1e-9)
    assert found.velocity[0] == pytest.approx(velocity - pull * t if stop.duration_s else 0.0, abs=1e-9)
    if share < 0.99:
        assert found.acceleration[0] == pytest.approx(-pull)
    assert lower - 1e-9 <= found.position[0] <= upper + 1e-9
