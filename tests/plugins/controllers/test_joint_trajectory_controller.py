"""The trajectory controller: properties of any trajectories; single cases are in `scripts/trajectory.txt`."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import Stage

from dxlrun import Outcome
from dxlrun_controllers.motions.joint_trajectory_controller import SPEED_SLOPE, JointTrajectoryController

ONE = {"joints": ["a"]}
TWO = {"joints": ["a", "b"]}
POSVEL = {"command_interface": "posvel"}
LOWER = ("lower",)


def thesis(t):
    """The head of the thesis: position and velocity."""
    return 0.5 * (np.sin(2 * t) - np.sin(4 * t)), np.cos(2 * t) - 2 * np.cos(4 * t)


def points(times, *, velocities=True):
    keys = ("positions", "velocities") if velocities else ("positions",)
    return [
        {"time": float(t)} | {key: [float(v)] for key, v in zip(keys, thesis(t), strict=False)} for t in times
    ]


def one(*positions, time=1.0):
    return [{"time": time, "positions": list(positions)}]


def started(parameters=ONE, **options):
    return Stage(JointTrajectoryController, parameters, **options).activate()


def chunk(robot, at, times, positions, now=None):
    given = [
        {"time": float(time), "positions": [float(row)]} for time, row in zip(times, positions, strict=True)
    ]
    robot.send(at, "chunk", points=given, now=at if now is None else now)


def observed(robot, begin_s, duration_s, step_s=1e-3):
    """Return positions and velocities of a controller that is `into` another one, shape (steps, joints)."""
    positions, velocities = [], []
    for index in range(round(duration_s / step_s) + 1):
        positions.append(robot.update(begin_s + index * step_s))
        velocities.append(robot.commands.velocity.copy())
    return np.array(positions), np.array(velocities)


@settings(max_examples=25, deadline=None)
@given(gaps=st.lists(st.floats(0.001, 0.4), min_size=20, max_size=80))
def test_it_samples_by_time_however_irregular_the_periods(gaps):
    robot = started()
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 20, 300)), start_in=1.0)
    for time in 1.0 + np.cumsum(gaps):
        if time < 20.99:
            position = robot.update(time)
            np.testing.assert_allclose(position, thesis(robot.time_ns * 1e-9 - 1.0)[0], atol=2e-4)
            np.testing.assert_array_equal(robot.update(time), position)


@pytest.mark.parametrize("velocities", [True, False])
def test_posvel_commands_the_magnitude_of_the_desired_velocity(velocities):
    robot = started(ONE | POSVEL)
    times = np.linspace(0, 20, 2000)
    robot.send(0.0, "trajectory", points=points(times, velocities=velocities), start_in=1.0)
    for time in np.arange(1.005, 20.9, 0.37):
        robot.update(time)
        np.testing.assert_allclose(robot.commands.velocity, abs(thesis(time - 1.0)[1]), atol=0.05)


ways = st.lists(
    st.tuples(st.sampled_from("abc"), st.floats(0.05, 0.6), st.floats(-1, 1), st.booleans()), max_size=9
)


@settings(max_examples=40, deadline=None)
@given(goals=ways, speed=st.sampled_from([1.0, 0.6]), gap=st.sampled_from([0.1, 0.23]))
def test_each_joint_moves_as_if_its_goals_were_all_there_are(goals, speed, gap):
    keys = POSVEL | {"speed": speed}
    whole = started({"joints": list("abc")} | keys, into=LOWER)
    alone = {
        joint: started({"joints": [joint]} | keys, into=LOWER, present=-0.2 if joint == "b" else 0.3)
        for joint in "abc"
    }
    for index, (joint, time, to, splice) in enumerate(goals):
        point = {"time": time, "positions": [to], "velocities": [0.5 * to]}
        for robot in (whole, alone[joint]):
            robot.send(index * gap, "trajectory", joints=[joint], points=[point], start_in=0.1 * splice)
        for at in index * gap + np.linspace(0, gap, 4):
            expected = [alone[name].update(at)[0] for name in "abc"]
            np.testing.assert_allclose(whole.update(at), expected, atol=1e-9)
            speeds = [alone[name].commands.velocity[0] for name in "abc"]
            np.testing.assert_allclose(whole.commands.velocity, speeds, atol=1e-8)


@pytest.mark.parametrize("joints", [["a"], ["a", "b"]])
def test_a_spliced_trajectory_leaves_the_one_before_where_it_starts(joints):
    robot = started(TWO | POSVEL, into=LOWER)
    robot.send(0.0, "trajectory", points=one(1.3, 0.8))
    robot.update(0.2)
    to = [-0.4, 0.5][: len(joints)]
    robot.send(0.2, "trajectory", joints=joints, points=one(*to, time=0.5), start_in=0.4, splice=True)
    path, speed = observed(robot, 0.2, 1.5)
    np.testing.assert_allclose(path[:400, 0], np.linspace(0.5, 0.9, 400, endpoint=False))
    np.testing.assert_allclose(path[900], [-0.4, 0.5 if len(joints) == 2 else 0.8], atol=1e-9)
    assert np.abs(np.diff(speed[:, 0])).max() < 0.1  # of a quintic: some 80 rad/s^2
    assert robot.goal.ended[0][:2] == (Outcome.REACHED, "after 0.900 s")


def test_chunks_of_a_policy_are_followed_smoothly_whenever_they_come():
    def wave(t):
        return 0.3 + 0.4 * np.sin(2 * np.asarray(t))

    random = np.random.default_rng(5)
    robot = started(ONE | POSVEL, into=LOWER, limits={"velocity": 2.0})
    begun = np.arange(0.0, 6.0, 0.3)
    due = begun + random.uniform(0.01, 0.25, len(begun))
    path, speed = [], []
    for at in np.arange(1, 600) * 0.01:
        while len(due) and due[0] <= at:
            times = 100.0 + begun[0] + 0.05 * np.arange(20)  # some of it is past when it comes
            chunk(robot, at, times, wave(times - 100.0), now=100.0 + at)
            begun, due = begun[1:], due[1:]
        path.append((at, robot.update(at)[0]))
        speed.append(robot.commands.velocity[0])
    times, found = np.array(path).T
    assert np.abs(found - wave(times))[times > 0.5].max() < 0.01
    assert np.abs(np.diff(speed))[60:].max() < 0.1
    assert np.abs(speed).max() <= 2.0
    assert np.abs(speed)[60:].max() < 1.0


def test_the_way_into_a_chunk_is_no_faster_than_the_joint_may_move():
    robot = started(ONE | POSVEL, into=LOWER, limits={"velocity": 1.5}, present=0.0)
    chunk(robot, 0.0, [0.0, 0.1, 5.0], [2.0, 2.0, 2.0])
    path, speed = observed(robot, 0.0, 5.0)
    assert 1.4 < speed.max() <= 1.5 + 1e-9
    np.testing.assert_allclose(path[[2600, -1], 0], 2.0)
    chunk(robot, 6.0, [6.1, 6.2], [0.0, 0.0])  # that is over before the joint can be there
    path, speed = observed(robot, 6.0, 3.0)
    assert np.abs(speed).max() <= 1.5 + 1e-9
    np.testing.assert_allclose(path[-1], 0.0)


def test_feedback_comes_ten_times_a_second_with_progress_and_distance():
    robot = started()
    robot.send(0.0, "trajectory", points=one(1.3))
    for step in range(1, 100):
        robot.states.position[:] = 0.3 + step * 0.01 - 0.05
        robot.update(step * 0.01, follow=False)
    expected = [(progress, 0.05) for progress in np.arange(0.1, 0.95, 0.1)]
    np.testing.assert_allclose(robot.goal.progresses, expected)


def test_beginning_a_long_trajectory_copies_none_of_its_points():
    robot = started(limits={"lower": -2.0, "upper": 2.0})
    times = [0.01, *(0.02 + index * 0.01 for index in range(3_000))]
    data = robot.prepare("trajectory", points=[point for time in times for point in one(0.3, time=time)])
    robot.prepare = lambda kind, **_: data
    tracemalloc.start()
    robot.send(0.0, "trajectory")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < data.nbytes / 3


values = st.floats(-1.0, 1.0)
point = st.tuples(st.floats(0.1, 0.6), st.tuples(values, values), st.tuples(values, values))
FIELDS = st.sampled_from([(), ("velocities",), ("velocities", "accelerations")])


def timed(drawn, fields):
    points, time = [], 0.0
    for gap, positions, others in drawn:
        time += gap
        full = {"time": time, "positions": positions, "velocities": others, "accelerations": others[::-1]}
        points.append({key: full[key] for key in ("time", "positions", *fields)})
    return points


@settings(max_examples=40, deadline=None)
@given(first=st.lists(point, min_size=1, max_size=4), fields=FIELDS, share=st.floats(0.02, 1.1))
def test_however_it_is_cancelled_it_stops_within_its_deceleration_and_its_limits(first, fields, share):
    step, most = 1e-3, np.array([6.0, 25.0])
    parameters = TWO | POSVEL | {"deceleration": {"a": "6 rad/s^2", "b": "25 rad/s^2"}}
    robot = started(parameters, into=LOWER, limits={"lower": -1.5, "upper": 1.5})
    points = timed(first, fields)
    robot.send(0.0, "trajectory", points=points)
    at = round(share * points[-1]["time"], 3)
    before, before_speed = observed(robot, at - 2 * step, 2 * step)
    if robot.goal.ended:
        return
    robot.cancel(at)
    after, speed = observed(robot, at, 4.0)
    np.testing.assert_allclose(after[0], before[-1], atol=1e-9)
    way = np.where(before_speed[-1] > 0, 1.5 - before[-1], 1.5 + before[-1])
    inside = before_speed[-1] ** 2 / 2 / most <= way
    np.testing.assert_allclose(speed[0][way > 0], before_speed[-1][way > 0], atol=1e-9)
    deceleration = np.abs(np.diff(speed, axis=0)).max(axis=0) / step
    assert (deceleration[inside] <= most[inside] * (1 + 1e-6)).all()
    stopped = np.abs(after[-1] - after[0])
    np.testing.assert_allclose(stopped[inside], (before_speed[-1] ** 2 / 2 / most)[inside], atol=1e-9)
    assert (np.abs(after) <= np.maximum(1.5, np.abs(before[-1])) + 1e-9).all()
    np.testing.assert_array_equal(speed[-1], 0.0)
    assert robot.goal.outcome is Outcome.CANCELLED


@settings(max_examples=80, deadline=None)
@given(
    first=st.lists(point, min_size=1, max_size=4),
    second=st.lists(point, min_size=1, max_size=3),
    fields=st.tuples(FIELDS, FIELDS),
    share=st.floats(0.02, 1.1),
    speed=st.sampled_from([1.0, 0.4, 1.7]),
    cancelled=st.booleans(),
    changed=st.sampled_from([None, 0.0, 2.5]),
)
def test_whenever_a_goal_takes_over_position_velocity_and_acceleration_continue(  # noqa: PLR0917
    first, second, fields, share, speed, cancelled, changed
):
    robot = started(TWO | POSVEL | {"speed": speed}, into=LOWER)
    points = timed(first, fields[0])
    robot.send(0.0, "trajectory", points=points)
    at = share * points[-1]["time"] / speed
    if cancelled:
        robot.update(at - 0.02)
        if not robot.goal.ended:
            robot.cancel(at - 0.01)
    if changed is not None:
        robot.update(at - 0.006)
        robot.change(at - 0.005, speed=changed)
    robot.update(at)
    before = [row.copy() for row in robot.controller._desired.rows]
    robot.send(at, "trajectory", points=timed(second, fields[1]))
    robot.update(at)
    after = [row.copy() for row in robot.controller._desired.rows]
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)
    if before[1].any():  # from rest, a linear piece begins with its speed: that is what linear means
        np.testing.assert_allclose(after[1], before[1], atol=1e-9)
        np.testing.assert_allclose(after[2], before[2], atol=1e-8)


@pytest.mark.parametrize("period", [0.02, 0.001, 0.25])
def test_a_speed_that_changes_in_a_run_bends_the_time_smoothly_whatever_the_periods(period):
    robot = started(ONE | POSVEL, into=LOWER)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 10, 400)))
    robot.update(2.0)
    robot.change(2.0, speed=0.0)
    speeds = [robot.commands.velocity[0]]
    for time in 2.0 + period * np.arange(1, round(2 / period)):
        since = min(time - 2.0, 1 / SPEED_SLOPE)
        bent = 2.0 + since - SPEED_SLOPE * since**2 / 2
        np.testing.assert_allclose(robot.update(time), thesis(bent)[0], atol=1e-4)
        speeds.append(robot.commands.velocity[0])
    assert speeds[-1] == 0.0
    if period == 0.001:
        assert np.abs(np.diff(speeds)).max() < (SPEED_SLOPE * 3 + 10) * period
    robot.change(4.0, speed=2.0)
    bent = 2 + 1 / (2 * SPEED_SLOPE) + 2 * 2.0 - 2**2 / (2 * SPEED_SLOPE)
    np.testing.assert_allclose(robot.update(6.0), thesis(bent)[0], atol=1e-3)
    assert robot.goal.outcome is None
    robot.change(6.0, speed=10.0)
    robot.update(8.0)
    robot.update(9.0)
    assert robot.goal.outcome is Outcome.REACHED


def test_while_the_speed_changes_the_desired_acceleration_is_that_of_the_desired_velocity():
    robot = started(ONE | POSVEL, into=LOWER)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 10, 2000)))
    robot.update(2.0)
    robot.change(2.0, speed=0.2)
    desired = []
    for step in range(600):
        robot.update(2.0 + step * 1e-3)
        desired.append([row[0] for row in robot.controller._desired.rows])
    position, velocity, acceleration = np.array(desired).T
    assert np.abs(np.gradient(position, 1e-3) - velocity)[1:-1].max() < 5e-3
    assert np.median(np.abs(np.gradient(velocity, 1e-3) - acceleration)[1:-1]) < 0.05
