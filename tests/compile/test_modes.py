from collections.abc import Callable

import pytest

from dxlrun.compile import Compiled
from dxlrun.description.modes import Mode
from dxlrun.errors import Problem

Find = Callable[..., tuple[Problem, ...]]

WHEELS = """\
name: cart
buses:
  main: {{port: /dev/ttyUSB0, protocol: 2.0, baud_rate: 1_000_000, adapter: {{latency: 1 ms}}}}
loop: {{rate: 50}}
joints:
  left_wheel: {{bus: main, id: 1, model: {model}, reference: 0 deg, direction: 1, continuous: true}}
  right_wheel: {{bus: main, id: 2, model: {model}, reference: 0 deg, direction: -1, continuous: true}}
controllers:
  drive:
    type: {controller}
    active: {active}
    joints: [left_wheel, right_wheel]
"""


def wheels(model: str = "XL430-W250", controller: str = "velocity", active: str = "true") -> str:
    return WHEELS.format(model=model, controller=f"joint_group_{controller}_controller", active=active)


def test_joints_begin_in_the_mode_of_the_controllers_that_are_active_first(
    compile_text: Callable[..., Compiled],
) -> None:
    for text, mode in (
        (wheels(), Mode.VELOCITY),
        (wheels(controller="pwm"), Mode.PWM),
        (wheels(controller="pwm", active="false"), Mode.VELOCITY),
        (wheels(controller="position"), Mode.POSITION),
    ):
        (bus,) = compile_text(text).plan.buses
        assert {servo.start_mode for servo in bus.servos} == {mode}


@pytest.mark.parametrize(
    ("model", "controller", "lacks", "has"),
    [
        ("XL430-W250", "effort", "an effort alone, {} a torque or a current", "a velocity alone or a PWM"),
        ("M42-10-S260-R", "pwm", "a PWM, {} a PWM", "a velocity alone or an effort alone"),
    ],
)
def test_a_controller_whose_mode_the_model_does_not_have_is_refused(
    problems_in: Find, model: str, controller: str, lacks: str, has: str
) -> None:
    problems = [one for one in problems_in(wheels(model, controller)) if one.severity == "error"]
    assert [problem.mark.line for problem in problems] == [12, 12]
    what = lacks.format(f"but {model} of left_wheel has no mode that follows")
    assert problems[0].what == f"drive commands {what}"
    assert problems[0].fix == f"use a controller that commands a position, {has}"


def test_a_model_that_cannot_turn_on_and_on_is_no_wheel(problems_in: Find) -> None:
    problems = problems_in(wheels("RH-P12-RN(A)", active="false"))
    assert any(
        "RH-P12-RN(A) of left_wheel has no mode that turns at a speed, so left_wheel cannot be continuous"
        in problem.what
        for problem in problems
    )


def test_a_wheel_has_no_effort_limit_of_a_position_though_its_model_has_one(problems_in: Find) -> None:
    problems = [one for one in problems_in(wheels("XM430-W350", "poseffort")) if one.severity == "error"]
    assert problems[0].what.endswith("but left_wheel is continuous, for which it is not offered")
    assert problems[0].fix.startswith("take `continuous` out, or use a controller that commands a position,")


def test_positions_of_a_wheel_need_a_model_that_counts_turns(problems_in: Find) -> None:
    problems = problems_in(wheels("XL-320", "position"))
    assert any("counts turns" in problem.what for problem in problems)


@pytest.mark.parametrize(("model", "warned"), [("XL-320", True), ("XL430-W250", False)])
def test_a_wheel_that_controls_no_speed_is_warned_of(
    compile_text: Callable[..., Compiled], model: str, warned: bool
) -> None:
    told = [problem for problem in compile_text(wheels(model)).warnings if "no speed" in problem.what]
    assert bool(told) == warned
