"""gripper_controller: reached, stalled at an object, missed, cancelled; widths by a table."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun import Outcome
from dxlrun_controllers.gripper_controller import GripperController

WIDTHS = [{"angle": "-1.26 rad", "width": "78 mm"}, {"angle": "0.66 rad", "width": "20 mm"}]
GRIPPER = {"joint": "gripper", "effort": 0.4, "speed": "2 rad/s", "widths": WIDTHS}
PLAIN = {"joint": "gripper", "speed": "2 rad/s"}
LIMITS = {"lower": -1.26, "upper": 0.66}


def run(robot, seconds, *, blocked_at=None):
    """Let a servo go to its goal at the commanded speed; something that it cannot pass is at `blocked_at`."""
    states, sent = robot.states, robot.sent
    for _ in range(round(seconds / robot.period_s)):
        robot.step()
        step = robot.commands.velocity[0] * robot.period_s
        before = states.position[0]
        now = before + np.clip(sent.position[0] - before, -step, step)
        if blocked_at is not None and before <= blocked_at:
            now = min(now, blocked_at)
        states.position[0] = now
        states.velocity[0] = (now - before) / robot.period_s
        if robot.goals and robot.goals[-1].outcome is not None:
            break


def begun(parameters=GRIPPER, **options):
    return standing(GripperController, parameters, limits=LIMITS, **options).activate()


def gripping(parameters=GRIPPER):
    """Return one that closes to 0.6 rad, and its goal."""
    robot = begun(parameters)
    return robot, robot.ask("grip", position=0.6)


def test_it_holds_until_its_first_goal():
    robot = begun()
    robot.sent.position[:] = np.nan
    robot.step()
    assert robot.commands.position[0] == 0.0
    assert robot.commands.effort[0] == 0.4


def test_a_goal_is_reached_with_its_width():
    robot = begun()
    goal = robot.ask("grip", width="60 mm", effort=0.2)
    assert robot.commands.effort[0] == 0.2
    assert robot.commands.position[0] == pytest.approx(-1.26 + 1.92 * (78 - 60) / 58)
    run(robot, 3.0)
    assert goal.outcome is Outcome.REACHED
    assert goal.text.startswith("at -0.6")
    assert "60" in goal.text or "59" in goal.text
    assert goal.error <= 0.02
    assert goal.joint == "gripper"
    assert goal.steps == sorted(goal.steps)


@pytest.mark.parametrize("parameters", [GRIPPER, PLAIN])
def test_an_object_stalls_it_and_is_held(parameters):
    robot, goal = gripping(parameters)
    run(robot, 3.0, blocked_at=0.3)
    assert goal.outcome is Outcome.REACHED
    assert goal.text.startswith("stalled, holds something at 0.3 rad")
    assert ("30.88 mm" in goal.text) == ("widths" in parameters)
    assert goal.error == pytest.approx(0.3)
    # 0.15 s for the way, then 0.2 s of standing still
    assert 0.33 <= robot.time_ns * 1e-9 <= 0.42
    # with a limit of effort it goes on pressing, without one the angle is held
    assert robot.commands.position[0] == (0.6 if "effort" in parameters else 0.3)
    robot.step(periods=10)
    assert robot.messages[-1][1].stalled
    robot.ask("grip", position=0.0)
    robot.step(periods=10)
    assert not robot.messages[-1][1].stalled


def test_a_pause_on_the_way_is_no_stall():
    robot, goal = gripping()
    for n in range(60):
        robot.states.position[0] = n // 9 * 0.05  # 0.16 s of rest at most
        robot.step()
    assert goal.outcome is None


def test_what_neither_arrives_nor_stalls_is_missed():
    robot, goal = gripping(GRIPPER | {"timeout": "1 s"})
    for n in range(60):  # turned to and fro
        robot.states.position[0] = 0.03 * (n // 5 % 2)
        robot.step()
    assert goal.outcome is Outcome.MISSED
    assert goal.text == "goal not reached after 1 s at 0.03 rad, 39.03 mm"
    assert goal.error == pytest.approx(0.57)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), lost=st.floats(0, 0.4))
def test_an_object_is_felt_under_noise_and_lost_replies(seed, lost):
    robot = begun()
    goal, noise = robot.ask("grip", position=0.6), np.random.default_rng(seed)
    for _ in range(60):
        robot.states.position[0] = min(robot.time_ns * 2e-9, 0.3) + 0.0015 * noise.integers(-1, 2)
        robot.states.velocity[0] = noise.normal(scale=0.2)  # four times the speed of a stall
        robot.states.valid[0] = noise.random() >= lost
        robot.step()
        if goal.outcome is not None:
            break
    assert goal.text.startswith("stalled, holds something at ")
    assert 0.33 <= robot.time_ns * 1e-9 <= 0.65


def test_after_a_long_silence_the_time_of_a_stall_begins_anew():
    robot, goal = gripping()
    robot.step()
    robot.states.valid[0] = False
    robot.steps(15)
    robot.states.valid[0] = True
    robot.steps(10)
    assert goal.outcome is None
    robot.step()
    assert goal.text.startswith("stalled")


def test_a_silent_servo_is_no_stall_but_missed():
    robot, goal = gripping(GRIPPER | {"timeout": "1 s"})
    robot.states.valid[:] = False
    robot.steps(49)
    assert goal.outcome is None
    robot.steps(2)
    assert (goal.outcome, goal.text[:24]) == (Outcome.MISSED, "no reply from its servo ")


def test_a_cancel_holds_and_ends_at_rest():
    robot, goal = gripping()
    run(robot, 0.1)
    moving = robot.states.position[0]
    robot.cancel()
    assert robot.commands.position[0] == moving
    assert goal.outcome is None
    run(robot, 1.0)
    assert goal.outcome is Outcome.CANCELLED
    robot, goal = gripping()
    robot.cancel()
    robot.states.velocity[0] = 1.0  # something turns it
    robot.steps(55)
    assert goal.outcome is Outcome.CANCELLED


def test_a_cancel_without_a_reply_ends_only_when_one_says_that_it_is_at_rest():
    robot, goal = gripping()
    robot.states.valid[0] = False  # the last velocity that came was 0
    robot.cancel()
    robot.steps(5)
    assert goal.outcome is None
    robot.states.valid[0] = True
    robot.step()
    assert goal.outcome is Outcome.CANCELLED


def test_a_new_goal_takes_over():
    robot, goal = gripping()
    run(robot, 0.1)
    second = robot.ask("grip", position=-0.5)
    run(robot, 3.0)
    assert (goal.outcome, second.outcome) == (Outcome.PREEMPTED, Outcome.REACHED)


def test_positions_move_it_without_a_result_and_end_a_goal():
    robot, goal = gripping()
    run(robot, 0.1)
    robot.give("positions", positions=[-0.5])
    assert goal.outcome is Outcome.PREEMPTED
    run(robot, 1.0)
    robot.steps(50)
    assert robot.commands.position[0] == -0.5
    with pytest.raises(ValueError, match=r"2 positions for 1 joints \(gripper\)"):
        robot.prepare("positions", positions=[0.1, 0.2])


def test_an_angle_beyond_the_limits_is_refused_and_nothing_moves():
    robot = begun()
    goal = robot.ask("grip", position=0.7)
    assert goal.outcome is Outcome.ABORTED
    assert goal.text == "0.7 rad is outside its limits -1.26..0.66 rad"
    robot.step()
    assert robot.commands.position[0] == 0.0


def test_a_live_speed_counts_at_once():
    robot = begun()
    robot.change(speed="0.5 rad/s")
    assert robot.commands.velocity[0] == 0.5


@settings(max_examples=100, deadline=None)
@given(width=st.floats(0.02, 0.078), shrinking=st.booleans())
def test_a_width_is_the_inverse_of_its_angle(width, shrinking):
    sign = -1 if shrinking else 1
    points = ((-1.0, 0.02), (0.1, 0.03), (0.4, 0.078))
    table = [{"angle": f"{sign * angle} rad", "width": f"{wide} m"} for angle, wide in points]
    robot = standing(GripperController, GRIPPER | {"widths": table})
    angle, effort = robot.prepare("grip", width=width)
    assert robot.controller._width(angle) == pytest.approx(width, abs=1e-12)
    assert effort == 0.4


def test_what_a_goal_left_behind_ends_with_the_next_and_at_the_activation():
    robot = begun()
    robot.ask("grip", position=0.6)
    run(robot, 0.1)
    robot.cancel()
    goal = robot.ask("grip", position=0.6)
    run(robot, 1.0, blocked_at=0.3)
    assert goal.text.startswith("stalled")  # the cancel was that of the goal before
    robot.give("positions", positions=[0.0])
    robot.step(periods=5)
    assert not robot.messages[-1][1].stalled
    goal = robot.ask("grip", position=0.6)
    run(robot, 1.0, blocked_at=0.3)
    assert goal.text.startswith("stalled")
    robot.activate()
    robot.step(periods=5)
    assert not robot.messages[-1][1].stalled


def test_a_cancel_beyond_a_limit_stays_at_the_limit():
    robot = begun()
    robot.ask("grip", position=0.6)
    robot.states.position[0] = 0.7
    robot.cancel()
    assert robot.commands.position[0] == LIMITS["upper"]


def test_a_linear_gripper_reports_lengths():
    keys = {"joint": "jaw", "speed": "50 mm/s", "tolerance": "0.5 mm", "stall_speed": "2 mm/s"}
    widths = [{"angle": "0 mm", "width": "60 mm"}, {"angle": "30 mm", "width": "0 mm"}]
    robot = standing(
        GripperController, keys | {"widths": widths}, limits={"lower": 0.0, "upper": 0.03}
    ).activate()
    goal = robot.ask("grip", width="20 mm")
    assert robot.commands.position[0] == pytest.approx(0.02)
    run(robot, 3.0)
    assert (goal.outcome, goal.text[:3]) == (Outcome.REACHED, "at ")
    assert " m, " in goal.text
    goal = robot.ask("grip", position="31 mm")
    assert (goal.outcome, goal.text) == (Outcome.ABORTED, "0.031 m is outside its limits 0..0.03 m")
    goal = robot.ask("grip", position="30 mm")
    run(robot, 3.0, blocked_at=0.025)
    assert goal.text.startswith("stalled, holds something at 0.025 m, 10 mm")


def test_a_gripper_that_passes_its_goal_has_not_reached_it():
    robot, goal = gripping(PLAIN | {"timeout": "500 ms"})
    robot.states.position[0], robot.states.velocity[0] = 0.59, 4.4
    for _ in range(27):
        robot.step()
    assert (goal.outcome, goal.joint) == (Outcome.MISSED, "gripper")
    assert goal.text.startswith("joint gripper still moves at 252.10 deg/s; at 0.59 rad")
