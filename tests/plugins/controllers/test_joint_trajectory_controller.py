"""The trajectory controller: by time, without jumps, with tolerances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dxlrun_controllers.joint_trajectory_controller import CLOSING_SPEED, JointTrajectoryController

ONE = {"joints": ["a"]}
TWO = {"joints": ["a", "b"]}


def thesis(t):
    """The head of the thesis: position and velocity."""
    return 0.5 * (np.sin(2 * t) - np.sin(4 * t)), np.cos(2 * t) - 2 * np.cos(4 * t)


def points(times, *, velocities=True):
    return [
        {"time": float(t), "positions": [float(thesis(t)[0])]}
        | ({"velocities": [float(thesis(t)[1])]} if velocities else {})
        for t in times
    ]


def started(stage, parameters=ONE, **options):
    robot = stage(JointTrajectoryController, parameters, **options)
    robot.controller.on_activate(0)
    return robot


def test_what_it_claims():
    for interface, claims in (("position", ("position",)), ("posvel", ("position", "velocity"))):
        parameters = JointTrajectoryController.Parameters.model_validate(
            TWO | {"command_interface": interface}
        )
        found = JointTrajectoryController.interfaces(parameters, ("a", "b", "c"))
        assert (found.joints, found.command) == (("a", "b"), claims)


def test_it_holds_until_its_first_command(stage):
    robot = started(stage, TWO)
    for time in (0.0, 0.02, 5.0):
        np.testing.assert_array_equal(robot.update(time), [0.3, -0.2])
    assert robot.said == []


@settings(max_examples=25, deadline=None)
@given(gaps=st.lists(st.floats(0.001, 0.4), min_size=20, max_size=80))
def test_it_samples_by_time_however_irregular_the_periods(stage, gaps):
    robot = started(stage)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 20, 300)), start_in=1.0)
    for time in 1.0 + np.cumsum(gaps):
        if time < 20.99:
            time_ns = round(time * 1e9)
            position = robot.update(time)
            np.testing.assert_allclose(position, thesis(time_ns * 1e-9 - 1.0)[0], atol=2e-4)


def test_two_updates_at_one_time_command_the_same(stage):
    robot = started(stage)
    robot.send(0.0, "trajectory", points=points([0.5, 1.0]))
    np.testing.assert_array_equal(robot.update(0.7), robot.update(0.7))


@pytest.mark.parametrize("velocities", [True, False])
def test_posvel_commands_the_magnitude_of_the_wanted_velocity(stage, velocities):
    robot = started(stage, ONE | {"command_interface": "posvel"})
    times = np.linspace(0, 20, 2000)
    robot.send(0.0, "trajectory", points=points(times, velocities=velocities), start_in=1.0)
    for time in np.arange(1.005, 20.9, 0.37):
        robot.update(time)
        wanted = abs(thesis(time - 1.0)[1])
        np.testing.assert_allclose(robot.context.commands.velocity, wanted, atol=0.05)


def test_position_mode_commands_no_velocity(stage):
    robot = started(stage)
    robot.send(0.0, "trajectory", points=points([0.5, 1.0]))
    for time in (0.0, 0.7, 2.0):
        robot.update(time)
        assert np.isnan(robot.context.commands.velocity).all()


@pytest.mark.parametrize("at", [0.4, 1.7, 30.0])
def test_a_new_trajectory_takes_over_without_a_jump(stage, at):
    robot = started(stage)
    robot.send(0.0, "trajectory", points=points(np.linspace(0, 5, 100)), start_in=1.0)
    before = robot.update(at - 1e-6)
    robot.send(at, "trajectory", points=[{"time": 2, "positions": [-0.9], "velocities": [0.0]}])
    path = [robot.update(at + step * 1e-3) for step in range(2100)]
    np.testing.assert_allclose(path[0], before, atol=1e-5)
    assert np.abs(np.diff(path, axis=0)).max() < 0.005
    np.testing.assert_allclose(path[-1], -0.9)
    if at < 6:
        np.testing.assert_allclose(path[1] - path[0], path[0] - before, atol=4e-3)  # the speed goes on, too
        assert robot.said[0] == f"trajectory preempted after {at:.3f} s"


def test_a_command_between_two_updates_starts_from_what_is_wanted_then(stage):
    robot = started(stage)
    robot.send(0.0, "trajectory", points=[{"time": 1, "positions": [1.3]}])
    robot.update(0.1)
    robot.send(0.5, "trajectory", points=[{"time": 1, "positions": [0.0]}])
    np.testing.assert_allclose(robot.update(0.5), 0.8)


def test_the_delay_is_the_bridge_and_without_it_the_first_point_is_at_once(stage):
    robot = started(stage)
    robot.send(
        0.0,
        "trajectory",
        points=[{"time": 0, "positions": [1.3]}, {"time": 1, "positions": [2.3]}],
        start_in=1,
    )
    np.testing.assert_allclose([robot.update(t)[0] for t in (0, 0.5, 1.0, 1.5)], [0.3, 0.8, 1.3, 1.8])
    robot.send(3.0, "trajectory", points=[{"time": 0, "positions": [0.1]}])
    np.testing.assert_allclose(robot.update(3.0), 0.1)


def test_at_the_end_it_holds_and_logs_that_once(stage):
    robot = started(stage, ONE | {"command_interface": "posvel"})
    robot.send(0.0, "trajectory", points=points([0.5, 1.0]))
    for time in (0.2, 0.99, 1.0, 1.02, 9.0):
        robot.update(time)
    np.testing.assert_allclose(robot.context.commands.position, thesis(1.0)[0])
    np.testing.assert_array_equal(robot.context.commands.velocity, CLOSING_SPEED)
    assert robot.said == ["trajectory reached its goal after 1.000 s"]


def test_closing_in_respects_a_slower_limit(stage):
    robot = started(stage, ONE | {"command_interface": "posvel"}, speed=0.2)
    robot.send(0.0, "trajectory", points=points([0.5, 1.0]))
    robot.update(2.0)
    np.testing.assert_array_equal(robot.context.commands.velocity, 0.2)


def test_off_the_path_it_aborts_and_holds(stage):
    robot = started(stage, TWO | {"tolerances": {"path": "0.1 rad"}})
    robot.send(0.0, "trajectory", points=[{"time": 1, "positions": [1.3, -0.2]}])
    for time in (0.05, 0.09, 0.15, 0.5, 2.0):
        position = robot.update(time, follow=False)
    np.testing.assert_allclose(position, [0.45, -0.2])
    assert robot.said == ["trajectory aborted after 0.150 s: joint a is 0.1500 rad off, holding"]


def test_a_silent_servo_does_not_abort_a_path(stage):
    robot = started(stage, ONE | {"tolerances": {"path": "0.1 rad"}})
    robot.send(0.0, "trajectory", points=[{"time": 1, "positions": [1.3]}])
    robot.context.states.valid[:] = False
    robot.context.states.position[:] = np.nan
    np.testing.assert_allclose(robot.update(0.5, follow=False), 0.8)
    assert robot.said == []


GOAL = ONE | {"tolerances": {"goal": "2 deg", "goal_time": "500 ms"}}


def test_a_goal_may_be_reached_within_its_time(stage):
    robot = started(stage, GOAL)
    robot.send(0.0, "trajectory", points=[{"time": 1, "positions": [1.3]}])
    for time in (0.5, 1.0, 1.3):
        robot.update(time, follow=False)
    assert robot.said == []
    robot.context.states.position[:] = 1.28
    robot.update(1.4, follow=False)
    robot.update(2.4, follow=False)
    assert robot.said == ["trajectory reached its goal after 1.400 s"]


@pytest.mark.parametrize(
    ("answers", "told"), [(True, "joint a is 1.0000 rad off"), (False, "joint a does not answer")]
)
def test_a_missed_goal_is_logged(stage, answers, told):
    robot = started(stage, GOAL)
    robot.send(0.0, "trajectory", points=[{"time": 1, "positions": [1.3]}])
    robot.context.states.valid[:] = answers
    for time in (0.5, 1.0, 1.4, 1.6, 3.0):
        position = robot.update(time, follow=False)
    assert robot.said == [f"trajectory missed its goal after 1.600 s: {told}, holding"]
    np.testing.assert_allclose(position, 1.3)


def test_what_all_points_give_decides_the_spline(stage):
    robot = started(stage)
    full = {"positions": [0.1], "velocities": [0.2], "accelerations": [0.3]}
    orders = {
        6: [full, full],
        4: [full, {"positions": [0.1], "velocities": [0.2]}],
        2: [full, {"positions": [0.1], "accelerations": [0.2]}],
    }
    for order, given_points in orders.items():
        timed = [point | {"time": time} for time, point in enumerate(given_points)]
        assert robot.prepare("trajectory", points=timed)[2] == order


def test_times_may_have_units(stage):
    robot = started(stage)
    bare = robot.prepare("trajectory", points=[{"time": 0.5, "positions": [1]}], start_in=0.25)
    written = robot.prepare("trajectory", points=[{"time": "500 ms", "positions": [1]}], start_in="250 ms")
    np.testing.assert_array_equal(bare, written)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ([{"time": 1, "positions": [1, 2]}], r"2 positions in point 1 for 1 joints \(a\)"),
        ([{"time": 1, "positions": [1], "velocities": []}], "0 velocities in point 1"),
        (
            [{"time": 1, "positions": [1]}, {"time": 1, "positions": [1]}],
            "the times of a trajectory must grow: point 2 is at 1 s",
        ),
    ],
)
def test_a_trajectory_that_does_not_fit_is_refused_in_words(stage, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        started(stage).prepare("trajectory", points=wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"points": []},
        {"points": [{"time": -1, "positions": [1]}]},
        {"points": [{"time": "1 deg", "positions": [1]}]},
    ],
)
def test_a_command_of_the_wrong_form_is_refused(stage, wrong):
    with pytest.raises(ValidationError):
        started(stage).prepare("trajectory", **wrong)


def test_parameters_survive_the_plan(stage):
    written = GOAL | {"command_interface": "posvel"}
    model = JointTrajectoryController.Parameters.model_validate(written)
    assert model.tolerances.goal_time == 500_000_000
    assert JointTrajectoryController.Parameters.model_validate_json(model.model_dump_json()) == model
