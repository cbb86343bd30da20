"""Continuous joints and effort limits: what they become in the plan, and what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from dxlrun.compile import Compiled
from dxlrun.compile.plan import from_json, to_json
from dxlrun.description.modes import Mode
from dxlrun.errors import Problem

TEXT = """\
name: cart
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}
loop: {rate: 50}
joints:
  wheel: {bus: main, id: 1, model: XL430-W250, reference: 0 deg, direction: 1, continuous: true}
  arm: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1, limits: {effort: 800 mA}}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [wheel]}
  pull: {type: joint_group_effort_controller, joints: [arm]}
"""
Compile = Callable[..., Compiled]
ProblemsIn = Callable[..., tuple[Problem, ...]]


def test_a_wheel_has_turns_but_no_limits_that_stop_it(compile_text: Compile) -> None:
    wheel, arm = compile_text(TEXT).plan.loop.joints
    assert (wheel.continuous, wheel.bounded, wheel.rest) == (True, False, Mode.VELOCITY)
    assert (wheel.lower, wheel.upper) == pytest.approx((-512 * math.pi, 512 * math.pi))
    assert (arm.continuous, arm.bounded, arm.rest, arm.effort) == (False, True, Mode.POSITION, 0.8)


def test_limits_of_a_continuous_joint_bind_it_in_every_mode(compile_text: Compile) -> None:
    limits = "continuous: true, limits: {position: [-20 rad, 30 rad]}"
    (wheel, _) = compile_text(TEXT.replace("continuous: true", limits)).plan.loop.joints
    assert (wheel.lower, wheel.upper, wheel.bounded) == (-20, 30, True)


def test_servos_begin_in_the_modes_of_their_controllers_and_else_at_rest(compile_text: Compile) -> None:
    def modes(text: str) -> list[Mode]:
        return [servo.start_mode for bus in compile_text(text).plan.buses for servo in bus.servos]

    assert modes(TEXT) == [Mode.VELOCITY, Mode.EFFORT]
    assert modes(TEXT.replace("[arm]", "[arm], active: false")) == [Mode.VELOCITY, Mode.POSITION]


def test_a_plan_with_modes_is_the_same_after_json(compile_text: Compile) -> None:
    plan = compile_text(TEXT).plan
    assert from_json(to_json(plan)) == plan


@pytest.mark.parametrize(
    ("limit", "model", "says"),
    [
        ("0.5 Nm", "XM430-W350", "is in Nm, but an XM430-W350 measures A (present current)"),
        ("40 %", "XM430-W350", "is in % of its highest load, but an XM430-W350 measures A"),
        ("1 A", "XL430-W250", "is in A, but an XL430-W250 measures % of its highest load (present load)"),
    ],
)
def test_an_effort_limit_in_another_unit_than_the_model_measures(
    problems_in: ProblemsIn, limit: str, model: str, says: str
) -> None:
    text = (
        TEXT.replace("XM430-W350", model)
        .replace("800 mA", limit)
        .replace("effort_controller", "pwm_controller")
    )
    (problem,) = problems_in(text)
    assert says in problem.what
    assert (problem.mark.line, problem.severity) == (7, "error")


@pytest.mark.parametrize("limit", ["0 A", "-1 A", "800", "1e309 A", "3 rad/s"])
def test_what_is_no_effort(problems_in: ProblemsIn, limit: str) -> None:
    (problem,) = problems_in(TEXT.replace("800 mA", limit))
    assert "0.3 Nm, 800 mA or 40 %" in str(problem)
