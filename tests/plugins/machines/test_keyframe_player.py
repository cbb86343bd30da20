"""keyframe_player: poses at their times, smoothly, at a speed, again and after one another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun import Outcome
from dxlrun.channels.cycle import Torque
from dxlrun_controllers.motions.keyframe_player import KeyframePlayer


def step(time="500 ms", pause="0 s", pose=(("a", 0.5),), **more):
    return {
        "time": time,
        "pause": pause,
        "pose": {joint: f"{angle} rad" for joint, angle in dict(pose).items()},
        **more,
    }


def steps(*poses, **more):
    return {"steps": [step(pose=pose) for pose in poses], **more}


WAVE = {"steps": [step(), step(pose={"a": -0.5, "b": 0.2}, pause="200 ms")]}
PLAYER = {"joints": ["a", "b"], "approach": "10 rad/s", "motions": {"wave": WAVE}}
POSVEL = {"command_interface": "posvel"}
PARTIAL = {"partial": True, "tolerance": "0.01 rad"}


def player(**motions):
    return PLAYER | {"motions": motions}


def play(robot, seconds, *, follow=True):
    """Return time since now and positions, after each period."""
    begun_ns, found = robot.time_ns, []
    for _ in range(round(seconds / robot.period_s)):
        robot.step()
        if follow:
            robot.states.position[:] = robot.commands.position
        found.append(((robot.time_ns - begun_ns) * 1e-9, *robot.commands.position))
    return np.array(found)


def begun(parameters=PLAYER, **options):
    return standing(KeyframePlayer, parameters, **options).activate()


def playing(parameters=PLAYER, motion="wave", speed=1.0, **options):
    """Return a player that begins with a motion."""
    robot = begun(parameters, **options)
    robot.ask("play", motion=motion, speed=speed)
    return robot


def cubic(t, time, start, end):
    s = np.clip(t / time, 0, 1)
    return start + (end - start) * (3 * s**2 - 2 * s**3)


def wave(t):
    return np.where(t <= 0.5, cubic(t, 0.5, 0.0, 0.5), cubic(t - 0.5, 0.5, 0.5, -0.5))


TORQUE = player(wave={"steps": [step(torque={"a": 0.3})]})


def test_poses_are_reached_at_their_times_on_cubics():
    robot = playing()
    t, a, b = play(robot, 2.0).T
    np.testing.assert_allclose(a, wave(t), atol=1e-12)
    np.testing.assert_allclose(b, cubic(t - 0.5, 0.5, 0.0, 0.2), atol=1e-12)
    assert (robot.goal.outcome, robot.goal.text) == (Outcome.REACHED, "played wave")
    progress = robot.goal.steps
    assert progress == sorted(progress)
    assert progress[0] == pytest.approx(0.02 / 1.2)
    assert progress[-1] == pytest.approx(1.0, abs=0.02)
    assert len(progress) * 0.02 == pytest.approx(1.2, abs=0.03)


def test_a_motion_begins_with_the_controller_from_the_first_update_on():
    robot = begun(PLAYER | {"start": "wave"})
    for _ in range(2):  # the second time is another activation
        before = robot.commands.position[0]
        t, a, _ = play(robot, 0.5).T
        np.testing.assert_allclose(a, cubic(t, 0.5, before, 0.5), atol=1e-12)
        robot.activate()
    goal = robot.ask("play", motion="wave")
    play(robot, 2.0)
    assert goal.outcome == Outcome.REACHED


def test_a_motion_of_the_activation_waits_for_joints_that_have_not_answered():
    robot = standing(KeyframePlayer, PLAYER | {"start": "wave"})
    robot.states.position[1] = np.nan
    np.testing.assert_array_equal(play(robot.activate(), 0.3, follow=False)[:, 1], 0.0)
    robot.states.position[1] = 0.0
    t, a, _ = play(robot, 0.5).T
    np.testing.assert_allclose(a, cubic(t, 0.5, 0.0, 0.5), atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    speed=st.floats(0.2, 3),
    page_speed=st.floats(0.5, 2),
    periods=st.lists(st.floats(0.2, 4), min_size=5, max_size=150),
)
def test_time_decides_whatever_the_periods_and_the_speed(speed, page_speed, periods):
    robot = playing(player(wave=WAVE | {"speed": page_speed}) | {"approach": "1000 rad/s"}, speed=speed)
    for gap in periods:
        robot.step(periods=gap)
        t = robot.time_ns * 1e-9 * speed * page_speed
        np.testing.assert_allclose(robot.commands.position[0], wave(t), atol=1e-6)


def test_linear_steps_have_one_speed_and_pauses_stand_still():
    linear = step(pose={"a": 1.0}, interpolation="linear", pause="1 s")
    robot = playing(player(ramp={"steps": [step(pose={"a": 0.0}), linear, step(pose={"a": 0})]}), "ramp")
    t, a, _ = play(robot, 2.0).T
    np.testing.assert_allclose(a, np.clip((t - 0.5) * 2, 0, 1), atol=1e-12)


def test_repeated_and_followed_by_others():
    rest = {"steps": [step(time="1 s", pose={"a": 0.1, "b": 0.3})], "speed": 2.0}
    robot = begun(player(nod=steps({"b": 0.4}, {"b": 0.0}, repeat=2, next="rest"), rest=rest))
    goal = robot.ask("play", motion="nod", repeat=3)
    t, _, b = play(robot, 4.0).T
    for peak in (0.5, 1.5, 2.5):
        assert b[np.searchsorted(t, peak - 1e-9)] == pytest.approx(0.4)
        assert b[np.searchsorted(t, peak + 0.5 - 1e-9)] == pytest.approx(0.0, abs=1e-9)
    assert goal.text == "played rest"
    assert len(goal.steps) * 0.02 == pytest.approx(3.5, abs=0.03)
    np.testing.assert_allclose(robot.commands.position, [0.1, 0.3])


def test_the_rest_of_a_period_counts_in_the_next_motion_at_its_speed():
    second = {"steps": [step(time="1 s", pose={"a": -0.5}, interpolation="linear")], "speed": 2.0}
    robot = playing(player(one={"steps": [step(time="510 ms")], "next": "two"}, two=second), "one")
    t, a, _ = play(robot, 0.9).T
    late = t > 0.51
    np.testing.assert_allclose(a[late], 0.5 - 2.0 * (t[late] - 0.51), atol=1e-12)


FAR = player(far={"steps": [step(time="10 ms", pose={"a": 2.0})]})


def test_the_first_pose_is_approached_softly():
    t, a, _ = play(playing(FAR | {"approach": "1 rad/s"}, "far", speed=3.0), 5.0).T
    assert (np.diff(a) / 0.02).max() == pytest.approx(1.0, abs=1e-3)
    assert t[np.searchsorted(a, 2.0 - 1e-9)] == pytest.approx(3.0, abs=0.03)


def test_a_joint_that_has_not_answered_ends_a_goal_and_begins_where_it_is_heard():
    robot = standing(KeyframePlayer, FAR)
    robot.states.position[:] = np.nan, 0.3
    refused = robot.activate().ask("play", motion="far")
    assert refused.ended[0][:3] == (Outcome.ABORTED, "joint a has not answered yet", "a")
    robot.step()
    assert np.isnan(robot.commands.position[0])
    for heard in (-0.4, -0.5):  # it is held where it was heard first
        robot.states.position[0] = heard
        robot.step()
        np.testing.assert_array_equal(robot.commands.position, [-0.4, 0.3])
    robot.ask("play", motion="far")
    speeds = np.diff(play(robot, 1.0)[:, 1]) / 0.02
    assert 1.0 < speeds.max() <= 10.0 + 1e-9


def test_a_cancel_just_before_a_limit_brakes_harder_and_stays_inside():
    robot = playing(limits={"upper": 0.3, "acceleration": 0.5})
    play(robot, 0.24)
    robot.cancel()
    path = play(robot, 3.0)[:, 1]
    assert robot.goal.outcome is Outcome.CANCELLED
    assert path.max() <= 0.3 + 1e-12
    assert np.diff(path).min() >= -1e-12
    assert np.diff(path, 2).max() <= 1e-12  # one deceleration, no stop at the limit


def test_a_new_goal_takes_over_with_the_speed_of_before():
    robot = playing(speed=0.5)
    before = play(robot, 0.4)
    robot.ask("play", motion="wave", speed=2.0)
    after = play(robot, 1.0)
    assert [goal.outcome for goal in robot.goals] == [Outcome.PREEMPTED, Outcome.REACHED]
    speeds = np.diff(np.concatenate([before, after])[:, 1]) / 0.02
    seam = len(before) - 1
    assert abs(speeds[seam] - speeds[seam - 1]) < 0.3  # rad/s; 1.4 without the speed of before


@settings(max_examples=50, deadline=None)
@given(at=st.integers(1, 48), deceleration=st.floats(1, 50), speed=st.floats(0.3, 3))
def test_a_cancel_decelerates_each_joint_within_its_limit(at, deceleration, speed):
    robot = playing(PLAYER | {"approach": "1000 rad/s"}, speed=speed, limits={"acceleration": deceleration})
    path = [play(robot, at * 0.02)]
    if robot.goal.outcome is not None:
        return
    robot.cancel()
    robot.cancel()  # twice is once
    velocity = robot.controller._now.velocity.copy()
    path.append(play(robot, 8.0))
    assert robot.goal.outcome is Outcome.CANCELLED
    assert robot.goal.text.startswith("stopped in step")
    positions = np.concatenate(path)[at - 1 :, 1:]
    speeds = np.diff(positions, axis=0) / 0.02
    changes = np.abs(np.diff(speeds, axis=0)) / 0.02
    # the first mean speed after the cancel, from the speed at the cancel
    assert np.abs(speeds[0] - velocity).max() <= deceleration * 0.02 / 2 * (1 + 1e-6)
    assert changes.max() <= deceleration * (1 + 1e-6) + 1e-6
    assert np.abs(speeds[-1]).max() < 1e-12


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_a_cancel_begins_with_the_speed_of_the_joints_and_not_of_the_motion(speed):
    robot = playing(speed=speed, limits={"acceleration": 1.0})
    path = play(robot, 0.2)[:, 1]
    robot.cancel()
    speeds = np.diff(np.append(path, play(robot, 0.1)[:, 1])) / 0.02
    assert abs(speeds[9] - speeds[8]) < 0.15 * speeds[8]


def test_torques_count_from_their_step_on():
    torques = ({"a": 0.3}, {"b": 0.2}, {"a": 0.1})
    robot = playing(player(push={"steps": [step(torque=torque) for torque in torques]}), "push")
    for wanted in ([0.3, np.nan], [0.3, 0.2], [0.1, 0.2]):
        play(robot, 0.48)
        np.testing.assert_array_equal(robot.commands.effort, wanted)
        play(robot, 0.02)


@pytest.mark.parametrize("into", [(), ("pid",)])
def test_posvel_has_magnitudes_for_servos_and_signs_for_references(into):
    robot, speeds = playing(PLAYER | POSVEL, speed=2.0, into=into), []
    for _ in range(50):
        robot.step()
        speeds.append(robot.commands.velocity[0])
    peak = 1.5 * 1.0 / 0.25  # between 0.5 and -0.5 rad, in half of 500 ms
    if into:
        assert min(speeds) == pytest.approx(-peak, rel=0.03)
        assert speeds[-1] == 0.0
    else:
        assert max(speeds) == pytest.approx(peak, rel=0.03)
        assert min(speeds) == 0.5


def test_servos_that_stay_behind_miss():
    robot = playing(PLAYER | {"tolerance": "0.05 rad", "settle": "300 ms"})
    play(robot, 1.3, follow=False)
    assert robot.goal.outcome is None
    play(robot, 0.3, follow=False)
    assert robot.goal.ended == [
        (Outcome.MISSED, "joint a is 28.65 deg off; played wave", "a", pytest.approx(0.5))
    ]
    goal = robot.ask("play", motion="wave")
    play(robot, 1.3, follow=False)
    robot.states.position[:] = robot.commands.position + 0.04
    play(robot, 0.02, follow=False)
    assert (goal.outcome, goal.error) == (Outcome.REACHED, pytest.approx(0.04))


def test_a_cancel_while_it_settles_ends_at_once():
    robot = playing(PLAYER | {"tolerance": "0.05 rad"})
    play(robot, 1.3, follow=False)
    robot.cancel()
    assert robot.goal.outcome is Outcome.CANCELLED


def test_poses_stay_within_the_limits():
    _, a, _ = play(playing(limits={"lower": -0.2, "upper": 0.3}), 2.0).T
    assert (a.min(), a.max()) == (-0.2, 0.3)


def test_a_live_speed_counts_in_the_middle_of_a_motion():
    robot = playing()
    play(robot, 0.26)
    robot.change(speed=2.0)
    play(robot, 0.12)
    assert robot.commands.position[0] == pytest.approx(0.5)


# Joints without torque


def led_by_hand(robot, position):
    robot.states.torque[1], robot.states.position[1] = Torque.RELEASED, position


def follow_with_a(robot, cycles):
    for _ in range(cycles):
        robot.step()
        robot.states.position[0] = robot.commands.position[0]


def test_joints_without_torque_are_left_out_and_join_in_with_the_next_step():
    robot = playing(player(wave=steps({"a": 0.5, "b": 0.5}, {"a": -0.5, "b": -0.5})) | PARTIAL)
    play(robot, 0.2)
    led_by_hand(robot, 0.7)
    for _ in range(10):
        follow_with_a(robot, 1)
        assert robot.commands.position[1] == 0.7
    robot.states.torque[1] = Torque.ON
    b = play(robot, 0.8)[:, 2]
    assert (b[0], b[-1]) == (0.7, -0.5)
    assert np.abs(np.diff(b)).max() == pytest.approx(0.072, abs=0.001), "a cubic, no jump"
    goal = robot.goal
    assert (goal.outcome, goal.text) == (Outcome.REACHED, "played wave, without b (no torque)")
    assert goal.judged == ["a", "b"]


def test_a_released_joint_is_not_judged_and_a_motion_of_it_alone_is_aborted():
    robot = begun(player(wave=WAVE, alone=steps({"b": 0.2})) | PARTIAL)
    robot.states.torque[1] = Torque.RELEASED
    goal = robot.ask("play", motion="wave")
    follow_with_a(robot, 80)
    assert (goal.outcome, goal.judged) == (Outcome.REACHED, ["a"])
    goal = robot.ask("play", motion="alone")
    play(robot, 1.0, follow=False)
    told = "joint b is limp: its torque was switched off; played alone, without b (no torque)"
    assert (goal.outcome, goal.text) == (Outcome.ABORTED, told)


def test_a_joint_that_gets_torque_at_rest_stays_where_it_was_led():
    robot = begun(PLAYER | {"partial": True})
    led_by_hand(robot, 0.7)
    play(robot, 0.1, follow=False)
    robot.states.torque[1], robot.states.position[1] = Torque.ON, 0.65
    play(robot, 0.1, follow=False)
    assert robot.commands.position.tolist() == [0.0, 0.7]


def test_a_pose_beyond_a_limit_is_missed_as_it_was_asked():
    """The player clamps the pose; the goal is judged by the pose of the robot file."""
    robot = playing(limits={"lower": -0.3})
    play(robot, 3.0)
    told = "joint a is 11.46 deg off; played wave"
    assert robot.goal.ended == [(Outcome.MISSED, told, "a", pytest.approx(0.2))]


def test_without_a_tolerance_a_motion_is_judged_by_those_of_the_joints():
    robot = playing()
    play(robot, 2.1, follow=False)
    assert robot.goal.outcome is None
    play(robot, 0.2, follow=False)
    assert robot.goal.outcome is Outcome.MISSED
