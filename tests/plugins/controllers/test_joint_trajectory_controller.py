"""The trajectory controller: by time, without jumps, with tolerances."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import Stage

from dxlrun import LINEAR, Outcome
from dxlrun.channels.cycle import Torque
from dxlrun_controllers.motions.joint_trajectory_controller import (
    CLOSING_SPEED,
    DECELERATION,
    SPEED_SLOPE,
    JointTrajectoryController,
)

ONE = {"joints": ["a"]}
TWO = {"joints": ["a", "b"]}
POSVEL = {"command_interface": "posvel"}
GOAL = ONE | {"tolerances": {"goal": "2 deg", "goal_time": "500 ms"}}
LOWER = ("lower",)


def thesis(t):
    """The head of the thesis: position and velocity."""
    return 0.5 * (np.sin(2 * t) - np.sin(4 * t)), np.cos(2 * t) - 2 * np.cos(4 * t)


def points(times, *, velocities=True):
    return [
        {"time": float(t), "positions": [float(thesis(t)[0])]}
        | ({"velocities": [float(thesis(t)[1])]} if velocities else {})
        for t in times
    ]


def one(*positions, time=1.0):
    return [{"time": time, "positions": list(positions)}]


def started(parameters=ONE, **options):
    return Stage(JointTrajectoryController, parameters, **options).activate()


def moving(parameters=ONE, to=(1.3,), **options):
    """Return one on its way to these positions within a second, from 0.3 and -0.2 rad."""
    robot = started(parameters, **options)
    robot.send(0.0, "trajectory", points=one(*to))
    return robot


def outcomes(robot):
    return [ended[0] for ended in robot.goal.ended]


def seen(robot, times, **options):
    """Return the positions that are commanded at these times, shape (times, joints)."""
    return np.array([robot.update(time, **options) for time in times])


def test_it_holds_until_its_first_command():
    robot = started(TWO)
    np.testing.assert_array_equal(seen(robot, (0.0, 0.02, 5.0)), [[0.3, -0.2]] * 3)
    assert robot.said == []


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
def test_posvel_commands_the_magnitude_of_the_wanted_velocity(velocities):
    robot = started(ONE | POSVEL)
    times = np.linspace(0, 20, 2000)
    robot.send(0.0, "trajectory", points=points(times, velocities=velocities), start_in=1.0)
    for time in np.arange(1.005, 20.9, 0.37):
        robot.update(time)
        np.testing.assert_allclose(robot.commands.velocity, abs(thesis(time - 1.0)[1]), atol=0.05)


@pytest.mark.parametrize("at", [0.4, 1.7, 30.0])
def test_a_new_trajectory_takes_over_without_a_jump(at):
    robot = started()
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 5, 100)), start_in=1.0)
    before = robot.update(at - 1e-6)
    robot.send(at, "trajectory", points=[{"time": 2, "positions": [-0.9], "velocities": [0.0]}])
    path = seen(robot, at + np.arange(2100) * 1e-3)
    np.testing.assert_allclose(path[0], before, atol=1e-5)
    assert np.abs(np.diff(path, axis=0)).max() < 0.005
    np.testing.assert_allclose(path[-1], -0.9)
    assert np.isnan(robot.commands.velocity).all(), "position mode commands no velocity"
    if at < 6:
        np.testing.assert_allclose(path[1] - path[0], path[0] - before, atol=4e-3)  # the speed goes on, too
        assert robot.goals[0].outcome is Outcome.PREEMPTED


def test_a_command_between_two_updates_starts_from_what_is_wanted_then():
    robot = moving()
    robot.update(0.1)
    robot.send(0.5, "trajectory", points=one(0.0))
    np.testing.assert_allclose(robot.update(0.5), 0.8)


def test_the_delay_is_the_bridge_and_without_it_the_first_point_is_at_once():
    robot = started()
    robot.send(0.0, "trajectory", points=[*one(1.3, time=0), *one(2.3)], start_in=1)
    np.testing.assert_allclose(seen(robot, (0, 0.5, 1.0, 1.5))[:, 0], [0.3, 0.8, 1.3, 1.8])
    robot.send(3.0, "trajectory", points=one(0.1, time=0))
    np.testing.assert_allclose(robot.update(3.0), 0.1)


@pytest.mark.parametrize(("limit", "closing"), [(np.nan, CLOSING_SPEED), (0.2, 0.2)])
def test_at_the_end_it_holds_and_the_goal_is_reached_once(limit, closing):
    robot = started(ONE | POSVEL, limits={"velocity": limit})
    robot.send(0.0, "trajectory", points=points([9, 10]) if np.isnan(limit) else one(0.8, time=10.0))
    seen(robot, (0.2, 9.99, 10.0, 10.02, 19.0))
    np.testing.assert_allclose(robot.commands.position, thesis(10.0)[0] if np.isnan(limit) else 0.8)
    assert robot.commands.velocity[0] == closing
    assert robot.goal.ended == [(Outcome.REACHED, "after 10.000 s", "a", pytest.approx(0, abs=0.02))]


def test_off_the_path_it_aborts_and_holds():
    robot = moving(TWO | {"tolerances": {"path": "0.1 rad"}}, to=(1.3, -0.2))
    path = seen(robot, (0.05, 0.09, 0.15, 0.5, 2.0), follow=False)
    np.testing.assert_allclose(path[-1], [0.45 + 1.0 / 2 / DECELERATION, -0.2])
    told = "after 0.150 s, joint a is 8.59 deg off its path, stopping"
    assert robot.goal.ended == [(Outcome.ABORTED, told, "a", pytest.approx(0.15))]


def test_a_silent_servo_does_not_abort_a_path():
    robot = moving(ONE | {"tolerances": {"path": "0.1 rad"}})
    robot.states.valid[:], robot.states.position[:] = False, np.nan
    np.testing.assert_allclose(robot.update(0.5, follow=False), 0.8)
    assert robot.goal.outcome is None


def test_a_goal_may_be_reached_within_its_time():
    robot = moving(GOAL)
    seen(robot, (0.5, 1.0, 1.3), follow=False)
    assert robot.goal.outcome is None
    robot.states.position[:] = 1.28
    seen(robot, (1.4, 2.4), follow=False)
    assert robot.goal.ended == [(Outcome.REACHED, "after 1.400 s", "a", pytest.approx(0.02))]


@pytest.mark.parametrize(
    ("answers", "outcome", "told", "error"),
    [
        (True, Outcome.MISSED, "joint a is 57.30 deg off", 1.0),
        (False, Outcome.ABORTED, "joint a has not answered; it is 57.30 deg off", 1.0),
    ],
)
def test_a_missed_goal_says_by_how_much(answers, outcome, told, error):
    robot = moving(GOAL)
    robot.states.valid[:] = answers
    path = seen(robot, (0.5, 1.0, 1.4, 1.6, 3.0), follow=False)
    expected = (outcome, f"after 1.600 s, {told}", "a", pytest.approx(error, nan_ok=True))
    assert robot.goal.ended == [expected]
    np.testing.assert_allclose(path[-1], 1.3)


def test_without_tolerances_a_goal_is_judged_by_those_of_the_joint():
    robot = moving()
    robot.states.position[:] = 1.2
    seen(robot, (0.5, 1.0, 1.5, 1.98), follow=False)
    assert robot.goal.outcome is None
    robot.update(2.0, follow=False)
    told = "after 2.000 s, joint a is 5.73 deg off"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(0.1))]


def test_a_goal_is_missed_while_its_joint_moves():
    robot = moving()
    robot.states.position[:], robot.states.velocity[:] = 1.3, 4.38
    seen(robot, (1.0, 2.0), follow=False)
    told = "after 2.000 s, joint a still moves at 250.96 deg/s"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(0.0))]


@pytest.mark.parametrize(
    ("given", "outcome"),
    [
        ({"goal_tolerance": {"a": 0.2}}, Outcome.REACHED),
        ({"goal_tolerance": {"a": "12 deg"}}, Outcome.REACHED),
        ({"goal_tolerance": {"a": {"position": "inf"}}}, Outcome.REACHED),
        ({"goal_tolerance": {"a": 0.05}}, Outcome.MISSED),
        ({"goal_tolerance": {"a": {"velocity": 1.0}}}, Outcome.MISSED),
        ({"goal_tolerance": {"a": {"position": 0.2, "velocity": "1 deg/s"}}}, Outcome.MISSED),
    ],
)
def test_a_goal_has_tolerances_of_its_own(given, outcome):
    robot = started(ONE | {"tolerances": {"goal": "8 deg"}})
    robot.send(0.0, "trajectory", points=one(1.3), goal_time_tolerance="200 ms", **given)
    robot.states.position[:], robot.states.velocity[:] = 1.15, np.radians(2.0)
    seen(robot, (1.0, 1.2), follow=False)
    assert outcomes(robot) == [outcome]


def test_a_goal_has_path_tolerances_of_its_own():
    for most in (0.1, {"velocity": 0.9}):
        robot = started()
        robot.send(0.0, "trajectory", points=one(1.3), path_tolerance={"a": most})
        robot.update(0.05, follow=False)
        robot.update(0.15, follow=False)
        assert outcomes(robot) == [Outcome.ABORTED]
        robot.send(1.0, "trajectory", points=one(1.3))
        robot.update(1.5, follow=False)
        assert robot.goal.outcome is None, "they were those of one goal"


def test_a_tolerance_of_a_joint_that_is_not_moved_is_refused():
    for key in ("goal_tolerance", "path_tolerance"):
        with pytest.raises(ValueError, match=f"{key} names b, but the moved joints are a"):
            started(TWO).prepare("trajectory", points=one(1.3), joints=["a"], **{key: {"b": 0.1}})


FULL = {"positions": [0.1], "velocities": [0.2], "accelerations": [0.3]}


@pytest.mark.parametrize(
    ("order", "left_out"), [(6, ()), (4, ("accelerations",)), (2, ("velocities",))], ids=str
)
def test_what_all_points_give_decides_the_spline(order, left_out):
    second = {key: value for key, value in FULL.items() if key not in left_out}
    given_points = [FULL | {"time": 0}, second | {"time": 1}]
    assert started().prepare("trajectory", points=given_points)[2] == order


def test_times_may_have_units():
    written = [
        started().prepare("trajectory", points=one(1, time=time), start_in=start_in)
        for time, start_in in ((0.5, 0.25), ("500 ms", "250 ms"))
    ]
    np.testing.assert_array_equal(*written)


# Interfaces with a law of their own


@pytest.mark.parametrize("interface", ["velocity", "effort"])
def test_velocity_and_effort_follow_by_pid_and_feed_forward(interface):
    gains = {"p": 3.0, "d": 0.5, "acceleration": 0.2, "friction": 0.1}
    robot = started(ONE | {"command_interface": interface, "gains": gains})
    command = getattr(robot.commands, interface)
    robot.update(0.0, follow=False)
    assert command[0] == 0.0
    cubic = [{"time": t, "positions": [p], "velocities": [0.0]} for t, p in ((1, 0.3), (2, 1.3))]
    robot.send(0.0, "trajectory", points=cubic)
    robot.states.position[:], robot.states.velocity[:] = 0.4, 0.9
    robot.update(1.25, follow=False)
    t = 0.25
    desired = 0.3 + 3 * t**2 - 2 * t**3, 6 * t - 6 * t**2, 6 - 12 * t
    forward = desired[1] * (interface == "velocity") + 0.2 * desired[2] + 0.1
    assert command[0] == pytest.approx(3.0 * (desired[0] - 0.4) + 0.5 * (desired[1] - 0.9) + forward)
    assert np.isnan(robot.commands.position).all()


@pytest.mark.parametrize("interface", ["velocity", "effort"])
def test_a_law_goes_on_with_what_was_sent_keeps_it_without_a_reply_and_ends_at_its_limit(interface):
    limits = {"velocity": 1.0, "effort": 1.2}
    parameters = ONE | {"command_interface": interface, "gains": {"p": 1.0, "i": 50.0, "friction": 0.5}}
    robot = Stage(JointTrajectoryController, parameters, limits=limits)
    getattr(robot.sent, interface)[:] = 0.7
    command, sent = getattr(robot.activate().commands, interface), []
    # 0.2 rad for 40 ms are 0.4, and p makes 0.2
    for position, valid in ((0.3, True), (0.1, False), (0.1, True), (9.0, True)):
        sent.append(command[0])
        robot.states.position[:], robot.states.valid[:] = position, valid
        robot.step()
    limit = limits[interface]
    assert [*sent, command[0]] == pytest.approx([0.7, 0.7, 0.7, limit, -limit])


def test_friction_is_that_of_the_desired_motion():
    robot = moving(ONE | {"command_interface": "effort", "gains": {"friction": 0.5}})
    robot.states.velocity[:] = -1.0
    robot.update(0.5, follow=False)
    assert robot.commands.effort[0] == 0.5


def test_at_rest_an_effort_holds_the_joint_against_its_load():
    robot = started(ONE | {"command_interface": "effort", "gains": {"p": 2.0}})
    robot.states.position[:] = 0.25
    robot.update(0.0, follow=False)
    assert robot.commands.effort[0] == pytest.approx(0.1)
    robot.change(0.0, gains={"p": 4.0})
    robot.update(0.02, follow=False)
    assert robot.commands.effort[0] == pytest.approx(0.2)


def test_into_another_controller_the_velocity_has_its_sign_and_is_zero_at_rest():
    robot = started(ONE | POSVEL, into=LOWER)
    found = []
    for time in (0.0, 0.5, 1.5):
        robot.update(time)
        found.append(robot.commands.velocity[0])
        if not time:
            robot.send(0.0, "trajectory", points=one(-0.7))
    assert found == pytest.approx([0.0, -1.0, 0.0])


# Some joints


def test_joints_that_a_goal_does_not_name_hold():
    robot = started(TWO)
    robot.send(0.0, "trajectory", joints=["b"], points=one(0.8))
    for time in (0.25, 0.5, 1.0, 2.0):
        np.testing.assert_allclose(robot.update(time), [0.3, -0.2 + min(time, 1.0)])
    assert robot.goal.ended == [(Outcome.REACHED, "after 1.000 s", "b", pytest.approx(0.0))]


def test_joints_that_a_goal_does_not_name_go_on_with_theirs_until_a_cancel_stops_all():
    robot = moving(TWO | POSVEL | {"deceleration": "2 rad/s^2"}, to=(1.3, 0.8))
    robot.update(0.4)
    robot.send(0.5, "trajectory", joints=["b"], points=one(0.3, time=0.2))
    np.testing.assert_allclose(robot.update(0.7), [1.0, 0.3])
    assert robot.goal.ended == [(Outcome.REACHED, "after 0.200 s", "b", pytest.approx(0.0))]
    np.testing.assert_allclose(robot.commands.velocity, [1.0, CLOSING_SPEED])
    robot.send(0.8, "trajectory", joints=["b"], points=one(-0.7))
    np.testing.assert_allclose(robot.update(0.9)[0], 1.2)
    robot.cancel(0.9)
    np.testing.assert_allclose(seen(robot, (1.0, 1.4, 3.0))[:, 0], [1.29, 1.45, 1.45])
    assert outcomes(robot) == [Outcome.CANCELLED]


ways = st.lists(
    st.tuples(st.sampled_from("abc"), st.floats(0.05, 0.6), st.floats(-1, 1), st.booleans()), max_size=9
)


@settings(max_examples=40, deadline=None)
@given(goals=ways, speed=st.sampled_from([1.0, 0.6]), gap=st.sampled_from([0.1, 0.23]))
def test_each_joint_moves_as_if_its_goals_were_all_there_are(goals, speed, gap):
    keys = POSVEL | {"speed": speed}
    whole = started({"joints": list("abc")} | keys, into=LOWER)
    alone = {joint: started({"joints": [joint]} | keys, into=LOWER, present=0.3) for joint in "ac"}
    alone["b"] = started({"joints": ["b"]} | keys, into=LOWER, present=-0.2)
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
    robot = moving(TWO | POSVEL, to=(1.3, 0.8), into=LOWER)
    robot.update(0.2)
    to = [-0.4, 0.5][: len(joints)]
    robot.send(0.2, "trajectory", joints=joints, points=one(*to, time=0.5), start_in=0.4, splice=True)
    path, speed = observed(robot, 0.2, 1.5)
    np.testing.assert_allclose(path[:400, 0], np.linspace(0.5, 0.9, 400, endpoint=False))
    np.testing.assert_allclose(path[900], [-0.4, 0.5 if len(joints) == 2 else 0.8], atol=1e-9)
    assert np.abs(np.diff(speed[:, 0])).max() < 0.1  # of a quintic: some 80 rad/s^2
    assert outcomes(robot) == [Outcome.REACHED]
    assert robot.goal.ended[0][1] == "after 0.900 s"


def test_a_splice_where_nothing_is_played_begins_at_once_and_one_that_is_too_fast_stops():
    robot = started(ONE, limits={"velocity": 2.0})
    robot.send(0.0, "trajectory", points=one(1.3), start_in=1.0, splice=True)
    np.testing.assert_allclose(seen(robot, (1.0, 2.0))[:, 0], [0.8, 1.3])
    robot.send(2.0, "trajectory", points=one(0.3))
    robot.send(2.1, "trajectory", points=one(1.3, time=0.1), start_in=0.4, splice=True)
    np.testing.assert_allclose(seen(robot, (2.4, 2.5, 3.0))[:, 0], [0.9, 0.8, 0.8 - 1 / 2 / DECELERATION])
    outcome, told, *_ = robot.goal.ended[0]
    assert outcome is Outcome.ABORTED
    assert told.startswith("joint a needs 9.819 a second to the first point (0.5 in 0.1 s)")


def test_a_splice_after_the_end_of_the_one_before_is_waited_for_and_played():
    robot = moving()
    robot.update(0.2)
    robot.send(0.2, "trajectory", points=one(-0.4, time=0.5), start_in=1.3, splice=True)
    np.testing.assert_allclose(seen(robot, (1.0, 1.2, 1.49))[:, 0], 1.3)
    assert outcomes(robot) == []
    np.testing.assert_allclose(seen(robot, (1.5, 1.75, 2.0))[:, 0], [1.3, 0.45, -0.4])
    assert robot.goal.ended[0][:2] == (Outcome.REACHED, "after 1.800 s")


def test_a_cancel_before_its_start_ends_a_spliced_trajectory():
    robot = moving()
    robot.send(0.2, "trajectory", points=one(-1.0), start_in=0.5, splice=True)
    robot.update(0.4)
    robot.cancel(0.4)
    np.testing.assert_allclose(seen(robot, (0.6, 3.0))[:, 0], 0.7 + 1 / 2 / DECELERATION)
    assert outcomes(robot) == [Outcome.CANCELLED]


# Chunks


def chunk(robot, at, times, positions, now=None, **more):
    points = [
        {"time": float(time), "positions": np.atleast_1d(row).tolist()}
        for time, row in zip(times, positions, strict=True)
    ]
    robot.send(at, "chunk", points=points, now=at if now is None else now, **more)


def wave(t):
    return 0.3 + 0.4 * np.sin(2 * np.asarray(t))


def test_chunks_of_a_policy_are_followed_smoothly_whenever_they_come():
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


def test_points_that_are_past_are_left_out_and_a_chunk_that_is_past_changes_nothing():
    robot = started(ONE)
    chunk(robot, 5.0, [7.0, 7.8, 8.0], [0.5, 0.9, 0.9], now=7.5)  # the clock of its sender is 2.5 s ahead
    np.testing.assert_allclose(seen(robot, (5.5, 6.0))[:, 0], 0.9)
    late = {"now": 8.4, "blend": 0}  # by 0.1 s
    chunk(robot, 6.0, [8.0, 9.5, 9.9, 10.0], [-9.0, 0.5, 0.6, 0.6], **late)
    np.testing.assert_allclose(seen(robot, (7.0, 7.4, 7.5))[:, 0], [0.5, 0.6, 0.6])
    chunk(robot, 8.0, [10.0, 10.4], [3.0, 3.0], now=10.4)
    np.testing.assert_allclose(seen(robot, (8.0, 9.0))[:, 0], 0.6)


def test_behind_its_end_a_chunk_brings_its_joints_to_rest_inside_of_their_limits():
    limits = {"upper": [1.4, 9.0]}
    robot = started(TWO | POSVEL | {"deceleration": "2 rad/s^2"}, into=LOWER, limits=limits, present=0.0)
    times = np.linspace(0, 1, 11)
    chunk(robot, 0.0, times, np.column_stack([times, times]))
    path, speed = observed(robot, 0.0, 3.0)
    np.testing.assert_allclose(path[1000], [1.0, 1.0])
    np.testing.assert_allclose(path[-1], [1.25, 1.25])
    np.testing.assert_allclose(speed[[1000, 1250, -1], 0], [1.0, 0.5, 0.0], atol=1e-9)
    assert (np.abs(np.diff(speed[1000:], axis=0)) < 2.1e-3).all()
    chunk(robot, 4.0, 4 + times[:2], [[1.3, 1.3], [1.39, 1.3]])
    path, _ = observed(robot, 4.0, 3.0)
    assert path.max() <= 1.4 + 1e-9


def test_the_way_into_a_chunk_is_no_faster_than_the_joint_may_go():
    robot = started(ONE | POSVEL, into=LOWER, limits={"velocity": 1.5}, present=0.0)
    chunk(robot, 0.0, [0.0, 0.1, 5.0], [2.0, 2.0, 2.0])
    path, speed = observed(robot, 0.0, 5.0)
    assert 1.4 < speed.max() <= 1.5 + 1e-9
    np.testing.assert_allclose(path[[2600, -1], 0], 2.0)
    chunk(robot, 6.0, [6.1, 6.2], [0.0, 0.0])  # that is over before the joint can be there
    path, speed = observed(robot, 6.0, 3.0)
    assert np.abs(speed).max() <= 1.5 + 1e-9
    np.testing.assert_allclose(path[-1], 0.0)


def test_a_chunk_takes_the_place_of_a_goal_for_its_joints_and_a_goal_that_of_a_chunk():
    robot = moving(TWO, to=(1.3, 0.8))
    robot.update(0.5)
    chunk(robot, 0.5, [0.7, 0.8], [0.3, 0.3], joints=["b"])
    told = "after 0.500 s, replaced by a chunk of positions"
    assert robot.goal.ended == [(Outcome.PREEMPTED, told, "a", pytest.approx(0, abs=1e-9))]
    np.testing.assert_allclose(seen(robot, (0.8, 1.0, 2.0)), [[1.1, 0.3], [1.3, 0.3], [1.3, 0.3]])
    chunk(robot, 2.0, [3.0], [[0.0, 0.0]])
    robot.send(2.5, "trajectory", points=one(1.0, 1.0))
    np.testing.assert_allclose(robot.update(3.5), [1.0, 1.0])
    assert outcomes(robot) == [Outcome.REACHED]


def test_after_the_joints_were_held_a_chunk_begins_where_they_are():
    robot = started(ONE | POSVEL, into=LOWER)
    chunk(robot, 0.0, [1.0, 9.0], [1.3, 9.3])
    held = robot.update(0.5)
    robot.states.torque[0] = Torque.LOST
    for time_s in (1.0, 1.5):
        robot.update(time_s, follow=False)
        robot.sent.position[:] = held
    robot.states.torque[0] = Torque.ON
    chunk(robot, 2.0, [2.5, 3.0], [0.0, 0.0], now=2.2)
    np.testing.assert_allclose(robot.update(2.0), held)
    assert robot.commands.velocity[0] == 0.0
    np.testing.assert_allclose(robot.update(3.0), 0.0, atol=1e-9)


def test_a_chunk_for_a_joint_that_never_answered_is_left_out():
    robot = Stage(JointTrajectoryController, TWO)
    robot.sent.position[1] = robot.states.position[1] = np.nan
    robot.activate()
    chunk(robot, 0.0, [0.5], [[1.0, 1.0]])
    assert np.isnan(robot.update(0.5, follow=False)[1])
    np.testing.assert_allclose(robot.update(0.6, follow=False)[0], 0.3)


def test_only_joints_of_the_goal_are_judged():
    robot = started(TWO | {"tolerances": {"path": "0.1 rad", "goal": "0.1 rad"}})
    robot.states.position[:] = 9.0, -0.15
    robot.send(0.0, "trajectory", joints=["b"], points=one(-0.2))
    seen(robot, (0.5, 1.0), follow=False)
    assert outcomes(robot) == [Outcome.REACHED]


# Results


def test_a_tolerance_is_for_each_joint_and_the_worst_one_is_named():
    robot = moving(TWO | {"tolerances": {"path": {"b": "0.1 rad"}, "goal": {"a": "0.2 rad"}}}, to=(1.3, -0.2))
    robot.states.position[:] = 0.3, -0.15
    robot.update(0.9, follow=False)
    assert robot.goal.outcome is None
    seen(robot, (1.0, 2.0), follow=False)
    told = "after 2.000 s, joint a is 57.30 deg off"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(1.0))]
    robot.states.position[1] = -0.31
    robot.send(3.0, "trajectory", points=one(1.3, -0.2))
    robot.update(3.1, follow=False)
    assert robot.goal.ended[0][2:] == ("b", pytest.approx(0.11))


def test_feedback_comes_ten_times_a_second_with_progress_and_distance():
    robot = moving()
    for step in range(1, 100):
        robot.states.position[:] = 0.3 + step * 0.01 - 0.05
        robot.update(step * 0.01, follow=False)
    expected = [(progress, 0.05) for progress in np.arange(0.1, 0.95, 0.1)]
    np.testing.assert_allclose(robot.goal.progresses, expected)


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_goal_that_takes_longer_than_its_time_out_is_missed_and_the_joints_stop(speed):
    robot = started(ONE | {"speed": speed})
    robot.send(0.0, "trajectory", timeout=0.5, points=one(1.3))
    position = seen(robot, (0.4, 0.5, 0.52, 2.0))[-1]
    outcome, told, joint, _ = robot.goal.ended[0]
    assert (outcome, joint) == (Outcome.MISSED, "a")
    assert told.startswith("joint a is ")
    assert told.endswith(" deg off; timeout after 0.520 s")
    assert position == pytest.approx(0.3 if not speed else 0.82 + 1 / 2 / DECELERATION)


def test_the_time_out_ends_a_goal_that_is_waited_for_too():
    robot = started(ONE | {"tolerances": {"goal": "2 deg", "goal_time": "5 s"}})
    robot.send(0.0, "trajectory", timeout=2, points=one(1.3))
    seen(robot, (1.0, 1.9, 2.1, 9.0), follow=False)
    told = "after 2.100 s, joint a is 57.30 deg off"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(1.0))]


def test_beginning_a_long_trajectory_copies_none_of_its_points():
    robot = started(limits={"lower": -2.0, "upper": 2.0})
    data = robot.prepare("trajectory", points=[*one(0.3, time=0.01)] + [
        point for index in range(3_000) for point in one(0.3, time=0.02 + index * 0.01)
    ])  # fmt: skip
    robot.prepare = lambda kind, **_: data
    tracemalloc.start()
    robot.send(0.0, "trajectory")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < data.nbytes / 3


def test_a_timed_out_goal_is_judged_by_its_last_point():
    robot = started(ONE | {"speed": 0.0})
    robot.send(0.0, "trajectory", timeout=0.5, points=one(1.3))
    seen(robot, (0.4, 0.52))
    told = "joint a is 57.30 deg off; timeout after 0.520 s"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(1.0))]


def test_a_goal_that_times_out_before_its_splice_names_no_joint():
    robot = moving()
    robot.send(0.2, "trajectory", splice=True, start_in=0.6, timeout=0.3, points=one(0.3))
    seen(robot, (0.3, 0.5, 0.52))
    told = "timeout after 0.320 s, before its start"
    assert [end[:3] for end in robot.goal.ended] == [(Outcome.MISSED, told, "")]


@pytest.mark.parametrize(
    ("joints", "outcome"), [(["a"], Outcome.MISSED), (["b"], Outcome.ABORTED), (["a", "b"], Outcome.ABORTED)]
)
def test_a_goal_that_times_out_before_its_splice_is_aborted_only_for_its_own_limp_joints(joints, outcome):
    robot = moving(TWO, to=(1.3, 0.0))
    given = one(*[0.3] * len(joints))
    robot.send(0.2, "trajectory", splice=True, start_in=0.6, timeout=0.3, joints=joints, points=given)
    robot.states.torque[1] = Torque.RELEASED
    seen(robot, (0.3, 0.5, 0.52))
    assert outcomes(robot) == [outcome]


def test_a_speed_off_the_path_is_named_with_the_desired_and_the_allowed_one():
    robot = started()
    robot.send(0.0, "trajectory", path_tolerance={"a": {"velocity": 0.5}}, points=one(1.3))
    robot.states.velocity[:] = 0.2
    robot.update(0.1)
    told = (
        "after 0.100 s, joint a moves at 11.46 deg/s instead of 57.30 deg/s (tolerance 28.65 deg/s), stopping"
    )
    assert [end[1] for end in robot.goal.ended] == [told]


def test_a_linear_joint_off_its_path_is_named_in_millimetres():
    robot = Stage(JointTrajectoryController, ONE | {"tolerances": {"path": "10 mm"}}, unit=LINEAR).activate()
    robot.send(0.0, "trajectory", points=one(1.3))
    robot.update(0.02, follow=False)
    assert [end[1] for end in robot.goal.ended] == [
        "after 0.020 s, joint a is 20.00 mm off its path, stopping"
    ]


def test_a_joint_that_never_answered_aborts_the_goal_at_once():
    robot = Stage(JointTrajectoryController, TWO)
    robot.sent.position[1] = robot.states.position[1] = np.nan
    robot.activate().send(0.0, "trajectory", points=one(1.3, 0.0))
    assert robot.goal.ended[0][:3] == (Outcome.ABORTED, "joint b has not answered yet", "b")
    assert np.isnan(robot.update(0.02, follow=False)[1])
    robot.states.position[1] = 0.6
    np.testing.assert_array_equal(robot.update(0.04, follow=False), [0.3, 0.6])


@pytest.mark.parametrize(("time", "needed"), [(0.5, "2.4"), (0.0, "60")])
def test_a_way_to_the_first_point_that_is_too_fast_for_the_joint_is_refused(time, needed):
    robot = started(TWO, limits={"velocity": 2.0})
    robot.send(0.0, "trajectory", points=one(0.3, 1.0, time=time))
    told = (
        f"joint b needs {needed} a second to the first point (1.2 in {time or 0.02} s), above its limit of "
        "2; set the point's time or start_in to 0.6 s or more"
    )
    assert robot.goal.ended == [(Outcome.ABORTED, told, "b", pytest.approx(1.2))]
    np.testing.assert_array_equal(robot.update(0.02), [0.3, -0.2])
    robot.send(0.1, "trajectory", points=one(0.3, 1.0, time=0.6))
    assert robot.goal.outcome is None
    robot.send(0.1, "trajectory", joints=["a"], points=one(0.33, time=0))
    assert robot.goal.outcome is None, "it does not move b, and a jump within a period is none"


def test_the_way_to_the_first_point_is_judged_by_its_peak():
    """From rest to rest on a cubic: 1.5 times the mean speed."""
    robot = started(ONE, limits={"velocity": 2.0})
    there = [{"time": 0.5, "positions": [1.1], "velocities": [0.0]}]
    robot.send(0.0, "trajectory", points=there)
    told = "joint a needs 2.4 a second to the first point (0.8 in 0.5 s), above its limit of 2"
    assert robot.goal.ended[0][1].startswith(f"{told}; set the point's time or start_in to 0.6 s or more")
    robot.send(0.1, "trajectory", points=[there[0] | {"time": 0.6}])
    assert robot.goal.outcome is None


def test_a_refused_trajectory_brings_a_motion_to_rest():
    robot = moving(ONE | {"deceleration": "4 rad/s^2"}, limits={"velocity": 2.0})
    robot.update(0.5)
    robot.send(0.5, "trajectory", points=one(-1.0, time=0))
    assert robot.goal.outcome is Outcome.ABORTED
    np.testing.assert_allclose(seen(robot, (0.5, 0.6, 0.75, 1.0))[:, 0], [0.8, 0.88, 0.925, 0.925])


# Stops


def observed(robot, begin_s, duration_s, step_s=1e-3):
    """Return positions and velocities of a controller that is `into` another one, shape (steps, joints)."""
    positions, velocities = [], []
    for index in range(round(duration_s / step_s) + 1):
        positions.append(robot.update(begin_s + index * step_s))
        velocities.append(robot.commands.velocity.copy())
    return np.array(positions), np.array(velocities)


def test_a_cancelled_goal_ends_when_its_joints_are_at_rest():
    robot = moving(ONE | POSVEL | {"deceleration": "4 rad/s^2"}, to=(2.3,))
    robot.update(0.5)
    robot.cancel(0.5)
    for time in (0.5, 0.75, 0.99):
        assert robot.update(time)[0] == pytest.approx(1.3 + 2 * (time - 0.5) - 2 * (time - 0.5) ** 2)
        assert robot.commands.velocity[0] == pytest.approx(2 - 4 * (time - 0.5))
        assert robot.goal.outcome is None
    assert robot.update(1.0)[0] == pytest.approx(1.3 + 0.5)
    assert robot.goal.ended == [(Outcome.CANCELLED, "after 1.000 s", "a", pytest.approx(0, abs=0.05))]
    assert robot.commands.velocity[0] == CLOSING_SPEED
    assert robot.update(9.0)[0] == pytest.approx(1.8)


def test_a_cancel_at_rest_ends_the_goal_at_once():
    robot = moving(GOAL)
    robot.update(1.2, follow=False)
    robot.cancel(1.3)
    assert outcomes(robot) == [Outcome.CANCELLED]
    np.testing.assert_allclose(robot.update(2.0), 1.3)


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
    gone = np.abs(after[-1] - after[0])
    np.testing.assert_allclose(gone[inside], (before_speed[-1] ** 2 / 2 / most)[inside], atol=1e-9)
    assert (np.abs(after) <= np.maximum(1.5, np.abs(before[-1])) + 1e-9).all()
    np.testing.assert_array_equal(speed[-1], 0.0)
    assert outcomes(robot) == [Outcome.CANCELLED]


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
def test_whenever_a_goal_takes_over_position_velocity_and_acceleration_go_on(  # noqa: PLR0917
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


def test_a_goal_that_comes_in_a_stop_while_the_speed_is_0_begins_with_the_velocity_of_then():
    robot = moving(ONE | POSVEL | {"deceleration": "2 rad/s^2"}, into=LOWER)
    robot.update(0.5)
    robot.cancel(0.5)
    robot.change(0.6, speed=0.0)
    robot.update(0.7)
    robot.send(0.7, "trajectory", points=one(1.3))
    robot.update(0.7)
    assert robot.controller._desired.acceleration[0] == pytest.approx(-2.0)
    _, speed = observed(robot, 0.7, 1.0)
    assert speed[0, 0] == pytest.approx(1.0 - 2 * 0.2)
    assert np.abs(np.diff(speed, axis=0)).max() < 0.02
    assert speed[-1, 0] == 0.0


def test_a_linear_trajectory_is_joined_without_a_jump_of_its_velocity_at_both_ends():
    robot = moving(ONE | POSVEL, into=LOWER)
    robot.update(0.5)
    robot.send(0.5, "trajectory", points=[*one(1.0), *one(0.4, time=2)])
    _, speed = observed(robot, 0.5, 1.9)
    np.testing.assert_allclose(speed[[0, 1000, -1], 0], [1.0, -0.6, -0.6], atol=1e-9)
    assert np.abs(np.diff(speed, axis=0)).max() < 0.02


# The speed


def test_a_slower_speed_stretches_the_time_of_a_trajectory():
    robot = started(ONE | POSVEL | {"speed": 0.5}, into=LOWER)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 5, 200)), start_in=1.0)
    for time in (2.5, 4.0, 7.3):
        position, velocity = thesis(time / 2 - 1.0)
        np.testing.assert_allclose(robot.update(time), position, atol=1e-4)
        np.testing.assert_allclose(robot.commands.velocity, 0.5 * velocity, atol=2e-3)


@pytest.mark.parametrize("period", [0.02, 0.001, 0.25])
def test_a_speed_that_changes_in_a_run_bends_the_time_smoothly_whatever_the_periods(period):
    robot = started(ONE | POSVEL, into=LOWER)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 10, 400)))
    robot.update(2.0)
    robot.change(2.0, speed=0.0)
    speeds = [robot.commands.velocity[0]]
    for time in 2.0 + period * np.arange(1, round(2 / period)):
        since = min(time - 2.0, 1 / SPEED_SLOPE)
        gone = 2.0 + since - SPEED_SLOPE * since**2 / 2
        np.testing.assert_allclose(robot.update(time), thesis(gone)[0], atol=1e-4)
        speeds.append(robot.commands.velocity[0])
    assert speeds[-1] == 0.0
    if period == 0.001:
        assert np.abs(np.diff(speeds)).max() < (SPEED_SLOPE * 3 + 10) * period
    robot.change(4.0, speed=2.0)
    gone = 2 + 1 / (2 * SPEED_SLOPE) + 2 * 2.0 - 2**2 / (2 * SPEED_SLOPE)
    np.testing.assert_allclose(robot.update(6.0), thesis(gone)[0], atol=1e-3)
    assert robot.goal.outcome is None
    robot.change(6.0, speed=10.0)
    seen(robot, (8.0, 9.0))
    assert outcomes(robot) == [Outcome.REACHED]


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


@pytest.mark.parametrize(
    ("written", "limit", "expected"),
    [({}, np.nan, DECELERATION), ({}, 35.0, 35.0), ({"deceleration": "4 rad/s^2"}, 3.0, 3.0)],
)
def test_joints_stop_within_their_own_acceleration_limit(written, limit, expected):
    robot = moving(ONE | written, to=(2.3,), limits={"acceleration": limit})
    robot.update(0.5)
    robot.cancel(0.5)
    assert robot.update(5.0)[0] == pytest.approx(1.3 + 4 / 2 / expected)
