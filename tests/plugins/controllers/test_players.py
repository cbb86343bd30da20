"""Players of keyframes and of rows, by time, under any periods; single cases are in `scripts`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import Stage, standing

from dxlrun import Outcome
from dxlrun_controllers.motions.keyframe_player import KeyframePlayer
from dxlrun_controllers.motions.sample_player import MOST_PIECES, SamplePlayer

WAVE = {
    "steps": [
        {"time": "500 ms", "pose": {"a": "0.5 rad"}},
        {"time": "500 ms", "pose": {"a": "-0.5 rad", "b": "0.2 rad"}, "pause": "200 ms"},
    ]
}
PLAYER = {"joints": ["a", "b"], "approach": "1000 rad/s", "motions": {"wave": WAVE}}


def playing(speed=1.0, page_speed=1.0, **options):
    """Return a player that begins with the wave."""
    keys = PLAYER | {"motions": {"wave": WAVE | {"speed": page_speed}}}
    robot = standing(KeyframePlayer, keys, **options).activate()
    robot.ask("play", motion="wave", speed=speed)
    return robot


def play(robot, seconds):
    """Return the positions of the first joint after each period; the servos follow."""
    found = []
    for _ in range(round(seconds / robot.period_s)):
        robot.step()
        robot.states.position[:] = robot.commands.position
        found.append(robot.commands.position[0])
    return np.array(found)


def wave(t):
    def cubic(t, start, end):
        s = np.clip(t / 0.5, 0, 1)
        return start + (end - start) * (3 * s**2 - 2 * s**3)

    return np.where(t <= 0.5, cubic(t, 0.0, 0.5), cubic(t - 0.5, 0.5, -0.5))


@settings(max_examples=50, deadline=None)
@given(
    speed=st.floats(0.2, 3),
    page_speed=st.floats(0.5, 2),
    periods=st.lists(st.floats(0.2, 4), min_size=5, max_size=150),
)
def test_time_decides_whatever_the_periods_and_the_speed(speed, page_speed, periods):
    robot = playing(speed, page_speed)
    for gap in periods:
        robot.step(periods=gap)
        t = robot.time_ns * 1e-9 * speed * page_speed
        np.testing.assert_allclose(robot.commands.position[0], wave(t), atol=1e-6)


def test_progress_grows_to_1_once_a_cycle():
    robot = playing()
    play(robot, 2.0)
    progress = robot.goal.steps
    assert progress == sorted(progress)
    assert (progress[0], progress[-1]) == (pytest.approx(0.02 / 1.2), pytest.approx(1.0, abs=0.02))
    assert len(progress) * 0.02 == pytest.approx(1.2, abs=0.03)


def test_a_new_goal_takes_over_with_the_speed_of_before():
    robot = playing(speed=0.5)
    before = play(robot, 0.4)
    robot.ask("play", motion="wave", speed=2.0)
    speeds = np.diff(np.concatenate([before, play(robot, 1.0)])) / 0.02
    seam = len(before) - 1
    assert abs(speeds[seam] - speeds[seam - 1]) < 0.3  # rad/s; 1.4 without the speed of before


@settings(max_examples=50, deadline=None)
@given(at=st.integers(1, 48), deceleration=st.floats(1, 50), speed=st.floats(0.3, 3))
def test_a_cancel_decelerates_each_joint_within_its_limit(at, deceleration, speed):
    robot = playing(speed, limits={"acceleration": deceleration})
    path = [play(robot, at * 0.02)]
    if robot.goal.outcome is not None:
        return
    robot.cancel()
    robot.cancel()  # twice is once
    velocity = robot.controller._now.velocity[0]
    path.append(play(robot, 8.0))
    assert robot.goal.outcome is Outcome.CANCELLED
    assert robot.goal.text.startswith("stopped in step")
    speeds = np.diff(np.concatenate(path)[at - 1 :]) / 0.02
    # the first mean speed after the cancel, from the speed at the cancel
    assert abs(speeds[0] - velocity) <= deceleration * 0.02 / 2 * (1 + 1e-6)
    assert np.abs(np.diff(speeds)).max() / 0.02 <= deceleration * (1 + 1e-6) + 1e-6
    assert abs(speeds[-1]) < 1e-12


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_a_cancel_begins_with_the_speed_of_the_joints_and_not_of_the_motion(speed):
    robot = playing(speed, limits={"acceleration": 1.0})
    path = play(robot, 0.2)
    robot.cancel()
    speeds = np.diff(np.append(path, play(robot, 0.1))) / 0.02
    assert abs(speeds[9] - speeds[8]) < 0.15 * speeds[8]


ROWS = [[0.3, -0.2], [0.4, -0.1]]


def player() -> Stage:
    return Stage(SamplePlayer, {"joints": ["a", "b"], "command_interface": "position"}).activate()


def test_wake_ups_that_scatter_play_each_row_once():
    stage = player()
    rng = np.random.default_rng(1)
    rows = [[0.001 * n, 0.0] for n in range(200)]
    stage.send(0.009, "samples", period=0.02, rows=rows)  # this one was late by 9 ms of 20
    times = 0.02 * np.arange(200) + rng.uniform(0, 0.009, 200)
    times[0] = 0.009
    seen = [round(float(stage.update(at)[0]) / 0.001) for at in times]
    assert seen == list(range(200))


def test_too_many_pieces_abort_their_goal_and_no_more():
    stage = player()
    for _ in range(MOST_PIECES):
        stage.send(0.0, "rows", rows=ROWS[:1])
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    assert stage.goal.ended[0][:2] == (Outcome.ABORTED, "its table has more than 256 pieces")
    stage.send(0.1, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.1).tolist() == ROWS[0]
    assert not stage.goal.ended
