"""Continuous joints and effort limits: what they become in the plan, and what is wrong with them."""

from __future__ import annotations

import math

import msgspec
import pytest
from tests.kit.robots import compile_text, problems_in, robot_text

from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.robot_plan import from_json, to_json
from dxlwire.modes import Mode

TEXT = robot_text("cart")


def test_a_wheel_has_turns_but_no_limits_that_stop_it() -> None:
    wheel, arm = compile_text(TEXT).plan.loop.joints
    assert (wheel.continuous, wheel.bounded, wheel.rest_mode) == (True, False, Mode.VELOCITY)
    assert (wheel.lower, wheel.upper) == pytest.approx((-512 * math.pi, 512 * math.pi))
    assert (arm.continuous, arm.bounded, arm.rest_mode, arm.effort) == (False, True, Mode.POSITION, 0.8)


def test_limits_of_a_continuous_joint_bind_it_in_every_mode() -> None:
    limits = "continuous: true, limits: {position: [-20 rad, 30 rad]}"
    (wheel, _) = compile_text(TEXT.replace("continuous: true", limits)).plan.loop.joints
    assert (wheel.lower, wheel.upper, wheel.bounded) == (-20, 30, True)


def test_servos_begin_in_the_modes_of_their_controllers_and_else_at_rest() -> None:
    def modes(text: str) -> list[Mode]:
        return [servo.start_mode for bus in compile_text(text).plan.buses for servo in bus.servos]

    assert modes(TEXT) == [Mode.VELOCITY, Mode.EFFORT]
    assert modes(TEXT.replace("[arm]", "[arm], active: false")) == [Mode.VELOCITY, Mode.POSITION]


def test_a_plan_with_modes_is_the_same_after_json() -> None:
    plan = compile_text(TEXT).plan
    assert from_json(to_json(plan)) == plan


ACCELERATED = TEXT.replace("limits: {effort: 800 mA}", "limits: {velocity: 4 rad/s, acceleration: A}")


def test_a_speed_that_the_file_does_not_give_is_the_servos_own() -> None:
    wheel, arm = compile_text(ACCELERATED.replace("A}", "20 rad/s^2}")).plan.loop.joints
    assert wheel.velocity == wheel.top_speed > 6.0
    assert (wheel.acceleration, arm.velocity, arm.acceleration) == (None, 4.0, 20.0)


def test_a_plan_of_the_time_before_acceleration_limits_has_neither_limit() -> None:
    old = msgspec.json.decode(
        b'{"name":"j","lower":-1,"upper":1,"velocity":null,"top_speed":8.0}', type=JointPlan
    )
    assert (old.velocity, old.acceleration) == (None, None)


def test_a_gripper_of_a_linear_joint_is_written_in_lengths():
    text = """\
name: slide
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  jaw: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1, TRAVEL}
controllers:
  grip: {type: gripper_controller, joint: jaw}
"""
    turning = text.replace("TRAVEL", "limits: {position: [0 deg, 40 deg]}")
    linear = text.replace("TRAVEL", "travel_per_turn: 94.2 mm, limits: {position: [0 mm, 40 mm]}")
    keys = "joint: jaw, speed: 50 mm/s, tolerance: 0.5 mm, stall_speed: 2 mm/s, "
    keys += "widths: [{angle: 0 mm, width: 60 mm}, {angle: 30 mm, width: 0 mm}]"

    def errors(file):
        return [one.what for one in problems_in(file) if one.severity == "error"]

    assert errors(turning) == []
    assert errors(linear) == [
        f"grip has {key} as an angle, but jaw is linear" for key in ("speed", "tolerance", "stall_speed")
    ]
    assert errors(linear.replace("joint: jaw", keys)) == []
    assert errors(turning.replace("joint: jaw", "joint: jaw, tolerance: 1 mm")) == [
        "grip has tolerance as a length, but jaw turns"
    ]
    assert "unit kg" in problems_in(turning.replace("joint: jaw", "joint: jaw, tolerance: 1 kg"))[0].what
