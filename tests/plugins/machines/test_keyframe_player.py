"""keyframe_player: poses at their times, smoothly, at a speed, again and after one another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.kit.stages import standing

from dxlrun import Outcome
from dxlrun.channels.cycle import Torque
from dxlrun_controllers.motions.keyframe_player import KeyframePlayer


def step(time="500 ms", pause="0 s", **more):
    pose = {joint: f"{angle} rad" for joint, angle in more.pop("pose", {"a": 0.5}).items()}
    return {"time": time, "pause": pause, "pose": pose, **more}


WAVE = {"steps": [step(pose={"a": 0.5}), step(pose={"a": -0.5, "b": 0.2}, pause="200 ms")]}
PLAYER = {"joints": ["a", "b"], "approach": "10 rad/s", "motions": {"wave": WAVE}}


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


def cubic(t, time, start, end):
    s = np.clip(t / time, 0, 1)
    return start + (end - start) * (3 * s**2 - 2 * s**3)


def test_what_it_claims_depends_on_speeds_and_torques():
    torque = player(wave={"steps": [step(torque={"a": 0.3})]})
    for parameters, claims in (
        (PLAYER, ("position",)),
        (PLAYER | {"command_interface": "posvel"}, ("position", "velocity")),
        (torque, ("position", "effort")),
        (torque | {"command_interface": "posvel"}, ("position", "velocity", "effort")),
    ):
        assert standing(KeyframePlayer, parameters).interfaces.command == claims


def test_poses_are_reached_at_their_times_on_cubics():
    robot = begun()
    goal = robot.ask("play", motion="wave")
    t, a, b = play(robot, 2.0).T
    wanted = np.where(t <= 0.5, cubic(t, 0.5, 0.0, 0.5), cubic(t - 0.5, 0.5, 0.5, -0.5))
    np.testing.assert_allclose(a, wanted, atol=1e-12)
    np.testing.assert_allclose(b, cubic(t - 0.5, 0.5, 0.0, 0.2), atol=1e-12)
    assert (goal.outcome, goal.text) == (Outcome.REACHED, "played wave")
    assert goal.steps == sorted(goal.steps)
    assert goal.steps[0] == pytest.approx(0.02 / 1.2)
    assert goal.steps[-1] == pytest.approx(1.0, abs=0.02)
    assert len(goal.steps) * 0.02 == pytest.approx(1.2, abs=0.03)


def test_a_motion_begins_with_the_controller_from_the_first_update_on():
    robot = begun(PLAYER | {"start": "wave", "approach": "10 rad/s"})
    for _ in range(2):  # the second time is another activation
        before = robot.commands.position[0]
        t, a, _ = play(robot, 0.5).T
        np.testing.assert_allclose(a, cubic(t, 0.5, before, 0.5), atol=1e-12)
        robot.activate()
    goal = robot.ask("play", motion="wave")
    play(robot, 2.0)
    assert goal.outcome == Outcome.REACHED


def test_a_motion_of_the_activation_waits_for_joints_that_have_not_answered():
    robot = standing(KeyframePlayer, PLAYER | {"start": "wave", "approach": "10 rad/s"})
    robot.states.position[1] = np.nan
    robot.activate()
    t, a, _ = play(robot, 0.3, follow=False).T
    np.testing.assert_array_equal(a, 0.0)
    robot.states.position[1] = 0.0
    t, a, _ = play(robot, 0.5).T
    np.testing.assert_allclose(a, cubic(t, 0.5, 0.0, 0.5), atol=1e-12)


def test_the_motion_of_the_activation_is_one_of_its_own():
    with pytest.raises(ValidationError, match="start is flap, which is none of its motions"):
        KeyframePlayer.Parameters.model_validate(PLAYER | {"start": "flap"})


@settings(max_examples=50, deadline=None)
@given(
    speed=st.floats(0.2, 3),
    page_speed=st.floats(0.5, 2),
    periods=st.lists(st.floats(0.2, 4), min_size=5, max_size=150),
)
def test_time_decides_whatever_the_periods_and_the_speed(speed, page_speed, periods):
    robot = begun(player(wave=WAVE | {"speed": page_speed}) | {"approach": "1000 rad/s"})
    robot.ask("play", motion="wave", speed=speed)
    for gap in periods:
        robot.step(periods=gap)
        t = robot.time_ns * 1e-9 * speed * page_speed
        wanted = cubic(t, 0.5, 0.0, 0.5) if t <= 0.5 else cubic(t - 0.5, 0.5, 0.5, -0.5)
        np.testing.assert_allclose(robot.commands.position[0], wanted, atol=1e-6)


def test_linear_steps_have_one_speed_and_pauses_stand_still():
    steps = [
        step(pose={"a": 0.0}),
        step(pose={"a": 1.0}, interpolation="linear", pause="1 s"),
        step(pose={"a": 0}),
    ]
    robot = begun(player(ramp={"steps": steps}))
    robot.ask("play", motion="ramp")
    t, a, _ = play(robot, 2.0).T
    np.testing.assert_allclose(a, np.clip((t - 0.5) * 2, 0, 1), atol=1e-12)


def test_repeated_and_followed_by_others():
    robot = begun(
        player(
            nod={"steps": [step(pose={"b": 0.4}), step(pose={"b": 0.0})], "repeat": 2, "next": "rest"},
            rest={"steps": [step(time="1 s", pose={"a": 0.1, "b": 0.3})], "speed": 2.0},
        ),
    )
    goal = robot.ask("play", motion="nod", repeat=3)
    t, _, b = play(robot, 4.0).T
    peaks = [0.5, 1.5, 2.5]
    for peak in peaks:
        assert b[np.searchsorted(t, peak - 1e-9)] == pytest.approx(0.4)
        assert b[np.searchsorted(t, peak + 0.5 - 1e-9)] == pytest.approx(0.0, abs=1e-9)
    assert goal.text == "played rest"
    assert len(goal.steps) * 0.02 == pytest.approx(3.5, abs=0.03)
    np.testing.assert_allclose(robot.commands.position, [0.1, 0.3])


def test_the_rest_of_a_period_counts_in_the_next_motion_at_its_speed():
    robot = begun(
        player(
            one={"steps": [step(time="510 ms", pose={"a": 0.5})], "next": "two"},
            two={"steps": [step(time="1 s", pose={"a": -0.5}, interpolation="linear")], "speed": 2.0},
        ),
    )
    robot.ask("play", motion="one")
    t, a, _ = play(robot, 0.9).T
    second = t > 0.51
    np.testing.assert_allclose(a[second], 0.5 - 2.0 * (t[second] - 0.51), atol=1e-12)


def test_the_first_pose_is_approached_softly():
    robot = begun(player(far={"steps": [step(time="10 ms", pose={"a": 2.0})]}) | {"approach": "1 rad/s"})
    robot.ask("play", motion="far", speed=3.0)
    t, a, _ = play(robot, 5.0).T
    speeds = np.diff(a) / 0.02
    assert speeds.max() == pytest.approx(1.0, abs=1e-3)
    assert t[np.searchsorted(a, 2.0 - 1e-9)] == pytest.approx(3.0, abs=0.03)


def test_a_joint_that_has_not_answered_ends_a_goal_and_begins_where_it_is_heard():
    robot = standing(KeyframePlayer, player(far={"steps": [step(time="10 ms", pose={"a": 2.0})]}))
    robot.states.position[:] = np.nan, 0.3
    robot.activate()
    refused = robot.ask("play", motion="far")
    assert (refused.outcome, refused.text, refused.joint) == (
        Outcome.ABORTED,
        "joint a has not answered yet",
        "a",
    )
    robot.step()
    assert np.isnan(robot.commands.position[0])
    robot.states.position[0] = -0.4
    robot.step()
    np.testing.assert_array_equal(robot.commands.position, [-0.4, 0.3])
    robot.states.position[0] = -0.5  # it is held where it was heard first
    robot.step()
    assert robot.commands.position[0] == -0.4
    robot.ask("play", motion="far")
    speeds = np.diff(play(robot, 1.0)[:, 1]) / 0.02
    assert 1.0 < speeds.max() <= 10.0 + 1e-9


def test_a_cancel_just_before_a_limit_brakes_harder_and_stays_inside():
    robot = begun(limits={"upper": 0.3, "acceleration": 0.5})
    goal = robot.ask("play", motion="wave")
    play(robot, 0.24)
    robot.cancel()
    path = play(robot, 3.0)[:, 1]
    assert goal.outcome is Outcome.CANCELLED
    assert path.max() <= 0.3 + 1e-12
    assert np.diff(path).min() >= -1e-12
    assert np.diff(path, 2).max() <= 1e-12  # one deceleration, no stop at the limit


def test_a_new_goal_takes_over_with_the_speed_of_before():
    robot = begun()
    first = robot.ask("play", motion="wave", speed=0.5)
    before = play(robot, 0.4)
    second = robot.ask("play", motion="wave", speed=2.0)
    after = play(robot, 1.0)
    assert (first.outcome, second.outcome) == (Outcome.PREEMPTED, Outcome.REACHED)
    speeds = np.diff(np.concatenate([before, after])[:, 1]) / 0.02
    seam = len(before) - 1
    assert abs(speeds[seam] - speeds[seam - 1]) < 0.3  # rad/s; 1.4 without the speed of before


@settings(max_examples=50, deadline=None)
@given(at=st.integers(1, 48), deceleration=st.floats(1, 50), speed=st.floats(0.3, 3))
def test_a_cancel_decelerates_each_joint_within_its_limit(at, deceleration, speed):
    robot = begun(PLAYER | {"approach": "1000 rad/s"}, limits={"acceleration": deceleration})
    goal = robot.ask("play", motion="wave", speed=speed)
    path = [play(robot, at * 0.02)]
    if goal.outcome is not None:
        return
    robot.cancel()
    robot.cancel()  # twice is once
    velocity = robot.controller._now.velocity.copy()
    path.append(play(robot, 8.0))
    assert goal.outcome is Outcome.CANCELLED
    assert goal.text.startswith("stopped in step")
    positions = np.concatenate(path)[at - 1 :, 1:]
    speeds = np.diff(positions, axis=0) / 0.02
    changes = np.abs(np.diff(speeds, axis=0)) / 0.02
    # the first mean speed after the cancel, from the speed at the cancel
    assert np.abs(speeds[0] - velocity).max() <= deceleration * 0.02 / 2 * (1 + 1e-6)
    assert changes.max() <= deceleration * (1 + 1e-6) + 1e-6
    assert np.abs(speeds[-1]).max() < 1e-12


def test_torques_count_from_their_step_on():
    steps = [step(torque={"a": 0.3}), step(torque={"b": 0.2}), step(torque={"a": 0.1})]
    robot = begun(player(push={"steps": steps}))
    robot.ask("play", motion="push")
    for wanted in ([0.3, np.nan], [0.3, 0.2], [0.1, 0.2]):
        play(robot, 0.48)
        np.testing.assert_array_equal(robot.commands.effort, wanted)
        play(robot, 0.02)


def test_posvel_has_magnitudes_for_servos_and_signs_for_references():
    for into in ((), ("pid",)):
        robot = begun(PLAYER | {"command_interface": "posvel"}, into=into)
        robot.ask("play", motion="wave", speed=2.0)
        speeds = []
        for _ in range(50):
            robot.step()
            speeds.append(robot.commands.velocity[0])
        wanted = -1.5 * 1.0 / 0.25  # the peak between 0.5 and -0.5 rad, in half of 500 ms
        if into:
            assert min(speeds) == pytest.approx(wanted, rel=0.03)
            assert speeds[-1] == 0.0
        else:
            assert max(speeds) == pytest.approx(-wanted, rel=0.03)
            assert min(speeds) == 0.5


def test_servos_that_stay_behind_miss():
    robot = begun(PLAYER | {"tolerance": "0.05 rad", "settle": "300 ms"})
    goal = robot.ask("play", motion="wave")
    play(robot, 1.3, follow=False)
    assert goal.outcome is None
    play(robot, 0.3, follow=False)
    assert (goal.outcome, goal.text, goal.joint) == (Outcome.MISSED, "a is off at its end", "a")
    assert goal.error == pytest.approx(0.5)
    goal = robot.ask("play", motion="wave")
    play(robot, 1.3, follow=False)
    robot.states.position[:] = robot.commands.position + 0.04
    play(robot, 0.02, follow=False)
    assert (goal.outcome, goal.error) == (Outcome.REACHED, pytest.approx(0.04))


def test_a_cancel_while_it_settles_ends_at_once():
    robot = begun(PLAYER | {"tolerance": "0.05 rad"})
    goal = robot.ask("play", motion="wave")
    play(robot, 1.3, follow=False)
    robot.cancel()
    assert goal.outcome is Outcome.CANCELLED


def test_poses_stay_within_the_limits():
    robot = begun(limits={"lower": -0.2, "upper": 0.3})
    robot.ask("play", motion="wave")
    _, a, _ = play(robot, 2.0).T
    assert (a.min(), a.max()) == (-0.2, 0.3)


def test_a_live_speed_counts_in_the_middle_of_a_motion():
    robot = begun()
    robot.ask("play", motion="wave")
    play(robot, 0.26)
    robot.change(speed=2.0)
    play(robot, 0.12)
    assert robot.commands.position[0] == pytest.approx(0.5)


def test_an_unknown_motion_is_refused_with_those_that_exist():
    robot = begun(player(wave=WAVE, bow=WAVE))
    with pytest.raises(ValueError, match=r"there is no motion 'wav'; there are wave, bow"):
        robot.prepare("play", motion="wav")
    for wrong in (
        {"motion": "wave", "speed": 0.0},
        {"motion": "wave", "repeat": 0},
        {"motion": "wave", "speed": 11},
    ):
        with pytest.raises(ValueError, match="validation error"):
            robot.prepare("play", **wrong)


@pytest.mark.parametrize(
    ("motions", "sentence"),
    [
        ({}, "at least 1 item"),
        ({"w": {"steps": []}}, "at least 1 item"),
        (
            {"w": {"steps": [step(pose={"c": 1.0})]}},
            r"step 1 of motion w names c, not one of its joints \(a, b\)",
        ),
        ({"w": {"steps": [step(torque={"c": 1.0})]}}, "names c"),
        ({"w": {"steps": [step()], "next": "x"}}, "motion w is followed by x, which is none of its motions"),
        (
            {"w": {"steps": [step()], "next": "x"}, "x": {"steps": [step()], "next": "w"}},
            "in a circle: w -> x -> w",
        ),
        ({"w": {"steps": [step(time="1 ms")]}}, "greater than or equal"),
        ({"w": {"steps": [step(interpolation="bezier")]}}, "smooth"),
    ],
)
def test_motions_that_make_no_sense_are_refused_in_words(motions, sentence):
    with pytest.raises(ValueError, match=sentence):
        KeyframePlayer.Parameters.model_validate(PLAYER | {"motions": motions})


def test_activated_again_it_holds():
    robot = begun()
    robot.ask("play", motion="wave")
    play(robot, 0.3)
    robot.controller.on_deactivate(robot.time_ns)
    robot.sent.position[:] = robot.states.position[:] = 0.1, 0.2
    robot.activate()
    np.testing.assert_array_equal(play(robot, 1.0)[:, 1:], [[0.1, 0.2]] * 50)


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_a_cancel_begins_with_the_speed_of_the_joints_and_not_of_the_motion(speed):
    robot = begun(limits={"acceleration": 1.0})
    robot.ask("play", motion="wave", speed=speed)
    path = play(robot, 0.2)[:, 1]
    robot.cancel()
    path = np.append(path, play(robot, 0.1)[:, 1])
    speeds = np.diff(path) / 0.02
    assert abs(speeds[9] - speeds[8]) < 0.15 * speeds[8]


def test_joints_without_torque_are_left_out_and_join_in_with_the_next_step():
    steps = [step(pose={"a": 0.5, "b": 0.5}), step(pose={"a": -0.5, "b": -0.5})]
    robot = begun(player(wave={"steps": steps}) | {"partial": True, "tolerance": "0.01 rad"})
    goal = robot.ask("play", motion="wave")
    play(robot, 0.2)
    robot.states.torque[1] = Torque.RELEASED
    robot.states.position[1] = 0.7  # led by hand
    for _ in range(10):
        robot.step()
        robot.states.position[0] = robot.commands.position[0]
        assert robot.commands.position[1] == 0.7
    robot.states.torque[1] = Torque.ON
    _t, _, b = play(robot, 0.8).T
    assert b[0] == 0.7
    assert b[-1] == -0.5
    assert np.abs(np.diff(b)).max() == pytest.approx(0.072, abs=0.001), "a cubic, no jump"
    assert (goal.outcome, goal.text) == (Outcome.REACHED, "played wave, without b for want of torque")
    assert goal.joints == ["a", "b"]


def test_a_released_joint_is_not_judged_and_a_motion_of_it_alone_is_aborted():
    alone = {"steps": [step(pose={"b": 0.2})]}
    robot = begun(player(wave=WAVE, alone=alone) | {"partial": True, "tolerance": "0.01 rad"})
    robot.states.torque[1] = Torque.RELEASED
    goal = robot.ask("play", motion="wave")
    for _ in range(80):
        robot.step()
        robot.states.position[0] = robot.commands.position[0]
    assert (goal.outcome, goal.joints) == (Outcome.REACHED, ["a"])
    goal = robot.ask("play", motion="alone")
    play(robot, 1.0, follow=False)
    assert (goal.outcome, goal.text) == (Outcome.ABORTED, "played alone, without b for want of torque")


def test_a_joint_that_gets_torque_at_rest_stays_where_it_was_led():
    robot = begun(PLAYER | {"partial": True})
    robot.states.torque[1] = Torque.RELEASED
    robot.states.position[1] = 0.7
    play(robot, 0.1, follow=False)
    robot.states.torque[1] = Torque.ON
    robot.states.position[1] = 0.65
    play(robot, 0.1, follow=False)
    assert robot.commands.position.tolist() == [0.0, 0.7]
