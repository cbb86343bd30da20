import pytest
from tests.kit import desk
from tests.kit.robots import compile_text, problems_in

from dxlwire.modes import Mode

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
    assert problem.what.endswith("XL430-W250 of elbow has no position mode with an effort limit")
    assert problem.fix == f"remove {key[:-1]}, or use another model"
