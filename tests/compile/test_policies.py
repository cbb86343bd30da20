# ruff: noqa: E501 (what is written and what is said stand side by side)

"""Poses, policies and fallbacks against the robot: each mistake at its place, and what is made of them."""

from __future__ import annotations

import math

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in, robot_text

from dxlrun.compile.policies import MARGIN_NS
from dxlrun.plan.policy_plan import HOLD, LIMP, Policy
from dxlwire.plan import planning as plan

POLICIES = robot_text("policies").removeprefix(PAIR)


def test_steps_that_take_too_long_say_what_would_do() -> None:
    (problem,) = problems_in((PAIR + POLICIES).replace("exit_timeout: 6 s", "exit_timeout: 3 s"))
    assert "pose home at 90 deg/s: up to" in problem.what
    seconds = problem.fix.removeprefix("raise exit_timeout to ").split(" s,")[0]
    mended = (PAIR + POLICIES).replace("exit_timeout: 6 s", f"exit_timeout: {seconds} s")
    assert problems_in(mended) == ()


def test_a_fallback_is_in_the_plan() -> None:
    text = PAIR.replace(
        "type: joint_group_posvel_controller", "type: joint_group_posvel_controller\n    fallback: spare"
    )
    arms = compile_text(text).plan.loop.controllers[1]
    assert (arms.name, arms.fallback) == ("arms", "spare")


def test_without_policies_a_run_ends_limp_and_a_lost_servo_does_not_end_it() -> None:
    policies = compile_text(PAIR).plan.loop.policies
    assert (policies.on_exit, policies.on_fault) == (LIMP, LIMP)
    assert policies.of_features == {"on_lost_servo": HOLD, "on_stale_command": HOLD}


def test_policies_become_steps_in_radians() -> None:
    policies = compile_text(PAIR + POLICIES).plan.loop.policies
    home, torque = policies.on_exit.steps
    assert home.targets == pytest.approx((0.0, math.radians(-20)))
    assert home.speed == pytest.approx(math.radians(90))
    assert (torque.fraction, torque.levels, torque.longest_ns) == (0.25, 3, 600_000_000)
    assert policies.on_exit.last == "limp"
    assert policies.on_fault == Policy((), "hold")
    assert policies.of_features["on_lost_servo"].steps[0].targets == (None, pytest.approx(math.radians(10)))
    assert policies.of_features["on_lost_servo"].last == "hold"
    assert not policies.of_features["on_lost_servo"].goes_on


def test_a_pose_takes_its_time_from_the_farthest_limit_with_a_slow_first_second() -> None:
    """right_arm_joint, 10 deg of -90..60: 100 deg away; a second at 1.5 rad/s, the rest at 4 rad/s, 0.3 s to
    settle."""
    step = compile_text(PAIR + POLICIES).plan.loop.policies.of_features["on_lost_servo"].steps[0]
    assert step.longest_ns * 1e-9 == pytest.approx(1 + (math.radians(100) - 1.5) / 4 + 0.3, abs=1e-6)


def test_the_check_tells_each_policy_and_what_is_left_without_the_loop() -> None:
    rows = {row.name: row for row in compile_text(PAIR + POLICIES).report["policies"]}
    assert rows["on_exit"].does == (
        "pose home at 90 deg/s, then torque down to 25% in 3 steps over 0.6 s, then limp"
    )
    assert (rows["on_fault"].does, rows["on_fault"].without_loop) == ("hold", "hold")
    assert rows["on_exit"].without_loop == "hold"  # a loop that is gone is a fault
    assert rows["on_lost_servo"].without_loop == "hold"
    assert "until the next command" in rows["on_stale_command"].does


def limit_ns(text: str) -> int:
    return compile_text(text).plan.loop.policies.limit_ns


def test_the_steps_leave_time_for_two_periods_and_for_torque_off() -> None:
    policies = "policies: {exit_timeout: 2 s}\n"
    at_50 = limit_ns(PAIR + policies)
    at_25 = limit_ns(PAIR.replace("rate: 50", "rate: 25") + policies)
    assert at_50 - at_25 == 2 * 20_000_000
    slow = PAIR.replace("latency: 1 ms", "latency: 2 ms")
    exchanges = 2 * 2  # torque off and its read-back, of two servos
    assert at_50 - limit_ns(slow + policies) == exchanges * 1_000_000
    assert at_50 < 2_000_000_000 - 2 * 20_000_000 - MARGIN_NS - exchanges * 1_000_000


def test_a_time_that_is_too_short_for_any_step_is_none() -> None:
    slow = PAIR.replace("rate: 50", "rate: 25")
    assert limit_ns(slow + "policies: {exit_timeout: 150 ms}\n") == 0


def test_steps_one_after_the_other_take_the_sum_of_their_times() -> None:
    """Each of them would end in time: 1.2 s and 2.5 s."""
    steps = "[{pose: home, speed: 90 deg/s}, {reduce_torque: 0.25, steps: 3, over: 2500 ms}]"
    text = PAIR + "poses: {home: {right_arm_joint: -20 deg}}\n"
    assert problems_in(text + f"policies: {{on_exit: {steps}, exit_timeout: 6 s}}\n") == ()
    (problem,) = problems_in(text + f"policies: {{on_exit: {steps}, exit_timeout: 3.5 s}}\n")
    assert problem.what.startswith("on_exit may take ")


def test_a_pose_is_no_faster_than_its_joints_may_be() -> None:
    slow = PAIR.replace("60 deg]}", "60 deg], velocity: 0.5 rad/s}")
    step = compile_text(slow + POLICIES).plan.loop.policies.of_features["on_lost_servo"].steps[0]
    assert step.longest_ns * 1e-9 == pytest.approx(math.radians(100) / 0.5 + 0.3, abs=1e-6)


def test_a_pose_takes_the_time_to_stop_before_and_to_gain_speed() -> None:
    text = PAIR.replace("60 deg]}", "60 deg], velocity: 2 rad/s, acceleration: 4 rad/s^2}")
    step = compile_text(text + POLICIES).plan.loop.policies.of_features["on_lost_servo"].steps[0]
    moving_s = 1 + (math.radians(100) - 1.5) / 2
    assert step.longest_ns * 1e-9 == pytest.approx(2 / 4 + 2 / 4 + moving_s + 0.3, abs=1e-6)


def test_torque_is_not_reduced_where_a_servo_has_no_limit_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every model of today's tables has one; a plug-in may add a model without."""
    monkeypatch.setattr(plan, "_torque_limit", lambda table: None)
    text = PAIR + POLICIES
    (problem,) = problems_in(text)
    line = next(line for line, words in enumerate(text.splitlines(), 1) if "reduce_torque" in words)
    column = text.splitlines()[line - 1].index("reduce_torque") + 1
    assert (problem.mark.line, problem.mark.column) == (line, column)
    assert problem.what == (
        "on_exit reduces torque, but the AX-12A of left_arm_joint has no torque limit in RAM (and 1 joint more)"
    )
