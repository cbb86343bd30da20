"""How a servo with operating modes moves, judged by what it shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from dxlsim.motion.motor import motor_of
from dxlsim.simulation_plan import Load
from dxlsim.wire.servo_protocol2 import StatusErrorNumber
from dxlwire.control_table import find_table

TICK = math.tau / 4096
RPM = math.tau / 60
REST = 3
"""Ticks that the friction of an XM430-W350 leaves: 1.9 % of the duty, and 8 % more of it, at 4.6 a rad"""
MOTOR = motor_of(find_table("XM430-W350"))


@pytest.fixture
def make_loaded2(make_line2: Any) -> Callable[[Load], Any]:
    def make(load: Load) -> Any:
        return make_line2((1,), "XM430-W350", load=load)

    return make


def near(tick: int) -> object:
    """Return what equals a position at which friction lets a servo rest."""
    return pytest.approx(tick, abs=REST)


def speed_at(duty: float) -> float:
    """Return the speed of an XM430-W350 without load, rad/s: friction takes the same at each duty."""
    lost = MOTOR.friction / (1 - MOTOR.load_friction) / MOTOR.stall_torque
    return MOTOR.no_load_speed * (duty - lost) / (1 - lost)


def move(line: Any, goal: int, seconds: float = 3.0) -> int:
    line.put(torque_enable=1, goal_position=goal)
    line.wait(seconds)
    return int(line.get("present_position"))


def test_without_torque_it_stays_whatever_the_goal(line2):
    assert line2.set("goal_position", 3000) == 0
    line2.wait(1)
    assert line2.get("present_position") == round(2.0 / TICK)
    assert line2.get("torque_enable") == 0


def test_position_control_goes_there_and_rests(line2):
    assert move(line2, 3000) == near(3000)
    assert line2.get("present_velocity") == 0
    assert line2.get("moving") == 0
    assert line2.servo().shaft_angle == pytest.approx(3000 * TICK, abs=REST * TICK)


def test_profile_velocity_is_the_speed(line2):
    line2.set("profile_velocity", 50)
    assert move(line2, 0, 0.3) < round(2.0 / TICK)
    assert line2.servo().velocity == pytest.approx(-50 * 0.229 * RPM, rel=0.02)
    assert line2.get("present_velocity") == pytest.approx(-50, abs=1)
    assert line2.get("moving") == 1


def test_profile_velocity_0_is_as_fast_as_it_can(line2):
    move(line2, 4095, 0.1)
    assert line2.servo().velocity == pytest.approx(line2.servo().registers.table.max_speed, rel=2e-3)


def test_profile_acceleration_is_the_slope(line2):
    line2.put(profile_velocity=200, profile_acceleration=10, torque_enable=1, goal_position=4095)
    line2.wait(0.3)
    first, start_ns = line2.servo().velocity, line2.clock.now_ns()
    line2.wait(0.1)
    slope = (line2.servo().velocity - first) / ((line2.clock.now_ns() - start_ns) * 1e-9)
    assert slope == pytest.approx(10 * 214.577 * math.tau / 3600, rel=0.03)


def test_a_time_based_profile_takes_its_time(line2):
    line2.set("drive_mode", 4)
    line2.set("profile_velocity", 2000)  # ms
    line2.put(profile_acceleration=500, torque_enable=1, goal_position=2304)
    line2.wait(1.9)
    assert line2.get("moving") == 1
    line2.wait(0.2)
    assert line2.get("moving") == 0
    assert line2.get("present_position") == near(2304)


def test_velocity_control_turns_on_and_on(line2):
    line2.put(operating_mode=1, torque_enable=1, goal_velocity=-100)
    line2.wait(10)
    assert line2.get("present_velocity") == -100
    assert line2.get("present_position") < -4096
    line2.set("goal_velocity", 0)
    line2.wait(1)
    assert line2.get("present_velocity") == 0


def test_extended_position_control_counts_turns(line2):
    line2.set("operating_mode", 4)
    assert move(line2, -3 * 4096, 20) == near(-3 * 4096)
    assert line2.set("goal_position", 1_048_575) == 0
    assert line2.set("goal_position", 1_048_576) == 4


def test_position_control_knows_one_turn(line2):
    line2.set("operating_mode", 4)
    move(line2, 5000, 5)
    line2.put(torque_enable=0, operating_mode=3)
    assert line2.get("present_position") == near(5000 - 4096)
    assert line2.get("goal_position") == line2.get("present_position")


def test_homing_offset_shifts_position_and_goal(line2):
    line2.set("homing_offset", 100)
    assert line2.get("present_position") == round(2.0 / TICK) + 100
    assert move(line2, 1100) == near(1100)
    assert line2.servo().shaft_angle == pytest.approx(1000 * TICK, abs=REST * TICK)


def test_reverse_mode_turns_the_direction(line2):
    line2.set("drive_mode", 1)
    line2.servo().power_cycle()
    before = line2.get("present_position")
    assert before == 4096 - round(2.0 / TICK)
    assert move(line2, before + 100) == near(before + 100)
    assert line2.servo().shaft_angle - (2.0 - math.tau) == pytest.approx(-100 * TICK, abs=(REST + 1) * TICK)


@pytest.mark.parametrize("reverse", [0, 1])
def test_pwm_control_turns_at_its_part_of_the_no_load_speed(line2, reverse):
    line2.put(drive_mode=reverse, operating_mode=16, torque_enable=1)
    line2.wait(0.5)
    assert line2.servo().velocity == 0.0  # a goal that the mode obeys begins with 0
    assert line2.set("goal_pwm", -400) == 0
    line2.wait(1)
    sign = 1 if reverse else -1
    assert line2.servo().velocity == pytest.approx(sign * speed_at(400 / 885), rel=0.01)
    assert line2.get("present_pwm") == pytest.approx(-400, abs=1)


@pytest.mark.parametrize("sign", [1, -1])
def test_current_control_gives_the_torque_of_its_current(make_loaded2, sign):
    line = make_loaded2(Load(gravity=1.0, gravity_angle=2.0, friction=0.02))
    line.put(operating_mode=0, torque_enable=1, goal_current=sign * 100)
    line.wait(3)
    ampere = sign * 100 * 0.00269
    torque, pulled = ampere * MOTOR.torque_per_ampere, math.sin(line.servo().shaft_angle - 2.0)
    assert abs(torque - pulled) <= MOTOR.friction + 0.02 + MOTOR.load_friction * abs(torque + pulled)
    assert line.get("present_current") == pytest.approx(sign * 100, abs=1)


def test_current_based_position_control_pushes_no_harder_than_its_current(make_loaded2):
    line = make_loaded2(Load(gravity=1.0, gravity_angle=2.0, friction=0.02))
    line.put(operating_mode=5, torque_enable=1, goal_current=100, goal_position=4000)
    line.wait(3)
    torque, pulled = 100 * 0.00269 * MOTOR.torque_per_ampere, math.sin(line.servo().shaft_angle - 2.0)
    assert abs(torque - pulled) <= MOTOR.friction + 0.02 + MOTOR.load_friction * (torque + pulled)
    assert line.set("goal_current", 800) == 0
    line.wait(3)
    assert line.get("present_position") > 3900


def test_goal_pwm_limits_position_control(line2):
    assert line2.set("goal_pwm", 177) == 0
    move(line2, 4095, 0.3)
    assert line2.servo().velocity == pytest.approx(speed_at(177 / 885), rel=0.01)


def test_a_goal_wakes_it_only_where_drive_mode_has_the_bit(line2):
    line2.put(drive_mode=8, goal_position=3000)
    assert line2.get("torque_enable") == 1
    line2.wait(2)
    assert line2.get("present_position") == near(3000)


def test_a_servo_around_0_finds_itself_around_0(make_line2):
    line = make_line2((1,), "PH54-200-S500", position=-0.5)
    tick = line.servo().registers.table.rad_per_tick
    assert line.get("present_position") == round(-0.5 / tick)
    assert move(line, 1000) == pytest.approx(1000, abs=0.3 / 360 * math.tau / tick)


def test_an_xl320_moves_by_its_own_items(make_line2):
    line = make_line2((1,), "XL-320", position=2.0)
    assert line.get("present_position") == round(2.0 / math.radians(300) * 1023)
    assert line.write_bytes(1, 32, (1024 + 200).to_bytes(2, "little")) == 0  # the direction does not count
    # 3.8 degrees: it is a weak controller with much friction
    assert move(line, 800) == pytest.approx(800, abs=13)
    line.put(torque_enable=0, control_mode=1)
    line.put(torque_enable=1, moving_speed=500)
    line.wait(1)
    assert line.servo().velocity > 0


@pytest.mark.parametrize(
    "model", ["H54-200-S500-R", "H42-20-S300-R", "M42-10-S260-R", "M54-60-S250-R", "L54-30-S400-R"]
)
def test_a_pro_before_a_moves_by_its_own_items(make_line2, model):
    line = make_line2((1,), model, position=0.0)
    table = line.servo().registers.table
    assert line.set("goal_velocity", line.get("velocity_limit") + 1) == StatusErrorNumber.DATA_LIMIT
    assert line.set("goal_torque", line.get("torque_limit") + 1) == StatusErrorNumber.DATA_LIMIT
    line.put(goal_velocity=3000, torque_enable=1, goal_position=50_000)
    line.wait(0.5)
    assert line.servo().velocity == pytest.approx(3000 * table.rad_s_per_tick, rel=0.05)
    assert line.get("present_velocity") == pytest.approx(3000, rel=0.05)
    line.wait(10)
    assert line.get("present_position") == pytest.approx(50_000, abs=20)
    line.put(torque_enable=0, operating_mode=1)
    line.put(torque_enable=1, goal_velocity=-2000)
    line.wait(1)
    assert line.servo().velocity == pytest.approx(-2000 * table.rad_s_per_tick, rel=0.05)
    line.put(torque_enable=0, operating_mode=0)
    line.put(torque_enable=1, goal_torque=50)
    assert line.get("present_current") == pytest.approx(50, abs=2)
    line.set("torque_enable", 0)
    assert line.set("operating_mode", 16) == StatusErrorNumber.DATA_RANGE


@pytest.mark.parametrize(
    "model",
    [
        "H54-100-S500-R",
        "H42-20-S300-R",
        "L54-30-S400-R",
        "M54-60-S250-R(A)",
        "PH42-020-S300",
        "PH54-200-S500",
    ],
)
@pytest.mark.parametrize("goal", [100_000, -100_000])
def test_a_pro_comes_as_near_to_its_goal_as_the_makers_examples_wait_for(make_line2, model, goal):
    line = make_line2((1,), model, position=0.0)
    assert move(line, goal) == pytest.approx(goal, abs=20)
    line.wait(0.5)
    assert line.get("present_position") == pytest.approx(goal, abs=20)
    assert line.get("moving") == 0


def test_a_pro_with_a_goal_torque_is_no_stronger_than_that(make_line2):
    line = make_line2((1,), "H54-200-S500-R", position=0.0)
    line.put(goal_torque=10, torque_enable=1, goal_position=200_000)
    line.wait(0.05)
    assert line.get("present_current") == 10
    line.set("goal_torque", 0)  # the Torque Limit holds
    line.wait(0.05)
    assert line.get("present_current") > 15


def test_an_l42_counts_as_an_ax_does(make_line2):
    line = make_line2((1,), "L42-10-S300-R")
    assert move(line, 3000) == pytest.approx(3000, abs=3)
    line.set("torque_enable", 0)
    assert line.set("operating_mode", 0) == StatusErrorNumber.DATA_RANGE
    line.put(operating_mode=1, torque_enable=1, goal_velocity=100)
    line.wait(1)
    assert line.get("present_velocity") == pytest.approx(100, abs=2)


@pytest.mark.parametrize(("model", "rest"), [("RH-P12-RN", 5), ("RH-P12-RN(A)", REST)])
def test_an_rh_p12_closes(make_line2, model, rest):
    line = make_line2((1,), model, position=0.0)
    assert move(line, 740) == pytest.approx(740, abs=rest)
    assert line.set("goal_position", 1151) == StatusErrorNumber.DATA_RANGE


def test_feed_forward_of_what_motor_and_rotor_take_leaves_no_lag(make_line2):
    lags = {}
    # the duty that motor and rotor take per rad/s and rad/s^2, in the gains' units of PWM, ticks and ms;
    # of the second as much as the item holds
    unit = 4096 / math.tau / 885 * MOTOR.stall_torque
    for first, second in ((0, 0), (round(4e3 * MOTOR.damping / unit), 16_383)):
        line = make_line2((1,), "XM430-W350", position=1.0)
        line.put(
            profile_velocity=100,
            profile_acceleration=10,
            feedforward_1st_gain=first,
            feedforward_2nd_gain=second,
            torque_enable=1,
            goal_position=3000,
        )
        line.wait(0.5)
        shown = line.servo().registers
        lags[first] = shown.ticks("position_trajectory") - shown.ticks("present_position")
    without, with_it = lags.values()
    assert without > 30
    assert abs(with_it) < 5


def test_a_model_without_gains_in_the_manual_keeps_its_speed_too(make_line2):
    line = make_line2((1,), "PM54-060-S250", position=0.0)
    line.put(operating_mode=1, torque_enable=1, goal_velocity=1000)
    line.wait(2)
    assert line.get("present_velocity") == pytest.approx(1000, abs=2)
