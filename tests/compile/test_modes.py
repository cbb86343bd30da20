import pytest
from tests.kit import desk
from tests.kit.robots import compile_text, problems_in

from dxlrun.description.modes import Mode

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


def test_joints_begin_in_the_mode_of_the_controllers_that_are_active_first() -> None:
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
    model: str, controller: str, lacks: str, has: str
) -> None:
    problems = [one for one in problems_in(wheels(model, controller)) if one.severity == "error"]
    assert [problem.mark.line for problem in problems] == [12, 12]
    what = lacks.format(f"but {model} of left_wheel has no mode that follows")
    assert problems[0].what == f"drive commands {what}"
    assert problems[0].fix == f"use a controller that commands a position, {has}"


def test_a_model_that_cannot_turn_on_and_on_is_no_wheel() -> None:
    problems = problems_in(wheels("RH-P12-RN(A)", active="false"))
    assert any(
        "RH-P12-RN(A) of left_wheel has no mode that turns at a speed, so left_wheel cannot be continuous"
        in problem.what
        for problem in problems
    )


def test_a_wheel_has_no_effort_limit_of_a_position_though_its_model_has_one() -> None:
    problems = [one for one in problems_in(wheels("XM430-W350", "poseffort")) if one.severity == "error"]
    assert problems[0].what.endswith("but left_wheel is continuous, for which it is not offered")
    assert problems[0].fix.startswith("take `continuous` out, or use a controller that commands a position,")


LIMITED = """\
name: arm
buses:
  main: {{port: /dev/ttyUSB0, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 1 ms}}}}
loop: {{rate: 50}}
joints:
  elbow: {{bus: main, id: 1, model: {model}, reference: 150 deg, direction: 1}}
controllers:
{controller}
"""
PLAYER = """\
  player:
    type: keyframe_player
    joints: [elbow]
    motions:
      curl:
        steps:
          - {time: 1 s, pose: {elbow: 5 deg}}
          - {time: 1 s, pose: {elbow: 20 deg}, torque: {elbow: 0.3}}
"""
GRIPPER = "  gripper: {type: gripper_controller, joint: elbow, effort: 0.4}\n"


@pytest.mark.parametrize(("controller", "key"), [(PLAYER, "torque:"), (GRIPPER, "effort:")])
def test_torque_of_poses_is_limited_in_protocol_1_and_refused_at_its_key_where_nothing_limits_it(
    controller: str, key: str
) -> None:
    ax = LIMITED.format(protocol=1.0, model="AX-12A", controller=controller)
    (bus,) = compile_text(ax).plan.buses
    assert bus.servos[0].start_mode is Mode.EFFORT_POSITION
    text = LIMITED.format(protocol=2.0, model="XL430-W250", controller=controller)
    (problem,) = (one for one in problems_in(text) if one.severity == "error")
    _, at = desk.pointed(text, key, f"§{key}")
    assert f"{problem.mark.line}:{problem.mark.column}" == at
    assert problem.what.endswith("XL430-W250 of elbow has no position control with a limit of the effort")
    assert problem.fix == f"take {key[:-1]} out, or use a model that has it"


def test_positions_of_a_wheel_need_a_model_that_counts_turns() -> None:
    problems = problems_in(wheels("XL-320", "position"))
    assert any("counts turns" in problem.what for problem in problems)


@pytest.mark.parametrize(("model", "warned"), [("XL-320", True), ("XL430-W250", False)])
def test_a_wheel_that_controls_no_speed_is_warned_of(model: str, warned: bool) -> None:
    told = [problem for problem in compile_text(wheels(model)).warnings if "no speed" in problem.what]
    assert bool(told) == warned
