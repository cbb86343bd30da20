"""Torques of motor, load and friction in the modes of servos, worked out by hand."""

from __future__ import annotations

import math

import pytest
from tests.kit.simulated_line import Line

from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import motor_of
from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import Load, ServoConfig
from dxlwire.control_table import all_tables, find_table

S = 1_000_000_000
MOTOR = motor_of(find_table("XM430-W350"))
AX_TICK = math.radians(300) / 1023
HORIZONTAL = 2.0 - math.pi / 2
"""Gravity angle of a link that is horizontal at 2 rad."""


def held(model: str, torque: float, load: float, more_friction: float = 0.0) -> bool:
    """Return whether friction holds a shaft between the motor's torque and the load's, Nm."""
    motor = motor_of(find_table(model, None if model != "MX-64" else 1.0))
    rubbing = motor.friction + more_friction + motor.load_friction * abs(torque + load)
    return abs(torque - load) <= rubbing + 0.003


def speed_at(duty: float) -> float:
    """Return the speed of an XM430-W350 without load, rad/s: friction takes the same at each duty."""
    lost = MOTOR.friction / (1 - MOTOR.load_friction) / MOTOR.stall_torque
    return MOTOR.no_load_speed * (duty - lost) / (1 - lost)


@pytest.mark.parametrize("reverse", [0, 1])
def test_pwm_control_turns_at_its_part_of_the_no_load_speed(reverse):
    line = Line("XM430-W350")
    line.put(drive_mode=reverse, operating_mode=16, torque_enable=1)
    line.wait(0.5)
    assert line.servo().velocity == 0.0  # a goal that the mode obeys begins with 0
    line.put(goal_pwm=-400)
    line.wait(1)
    assert line.servo().velocity == pytest.approx((1 if reverse else -1) * speed_at(400 / 885), rel=0.01)
    assert line.get("present_pwm") == pytest.approx(-400, abs=1)


def test_goal_pwm_limits_position_control():
    line = Line("XM430-W350")
    line.put(goal_pwm=177, torque_enable=1, goal_position=4095)
    line.wait(0.3)
    assert line.servo().velocity == pytest.approx(speed_at(177 / 885), rel=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_current_control_gives_the_torque_of_its_current(sign):
    line = Line("XM430-W350", 1, load=Load(gravity=1.0, gravity_angle=2.0, friction=0.02))
    line.put(operating_mode=0, torque_enable=1, goal_current=sign * 100)
    line.wait(3)
    torque = sign * 100 * 0.00269 * MOTOR.torque_per_ampere
    assert held("XM430-W350", torque, math.sin(line.servo().shaft_angle - 2.0), 0.02)
    assert line.get("present_current") == pytest.approx(sign * 100, abs=1)


def test_current_based_position_control_pushes_no_harder_than_its_current():
    line = Line("XM430-W350", 1, load=Load(gravity=1.0, gravity_angle=2.0, friction=0.02))
    line.put(operating_mode=5, torque_enable=1, goal_current=100, goal_position=4000)
    line.wait(3)
    torque = 100 * 0.00269 * MOTOR.torque_per_ampere
    assert held("XM430-W350", torque, math.sin(line.servo().shaft_angle - 2.0), 0.02)
    line.put(goal_current=800)
    line.wait(3)
    assert line.get("present_position") > 3900


def test_goal_torque_is_the_current_in_torque_control_mode():
    line = Line("MX-64", 1, load=Load(gravity=2.0, gravity_angle=2.0, friction=0.1))
    line.put(torque_enable=1, torque_ctrl_mode_enable=1, goal_torque=1024 + 200)  # clockwise, 0.9 A
    line.wait(3)
    assert held("MX-64", -0.9 * 1.6315, 2.0 * math.sin(line.servo().shaft_angle - 2.0), more_friction=0.1)
    current = line.get("current") - 2048 if line.get("current") > 0 else line.get("current")
    assert current == pytest.approx(-200, abs=2)


def test_torque_limit_limits_what_it_holds():
    line = Line("AX-12A", 1, load=Load(gravity=1.0, gravity_angle=HORIZONTAL))
    line.put(shutdown=0, torque_limit=341, goal_position=round(2.0 / AX_TICK))
    line.wait(3)
    assert line.get("present_load") == 341
    assert held("AX-12A", 0.5, math.cos(2.0 - line.servo().shaft_angle))


def test_an_x_servo_sags_by_its_p_gain():
    line = Line("XM430-W350", 1, load=Load(gravity=1.0, gravity_angle=HORIZONTAL))
    line.put(torque_enable=1, goal_position=round(2.0 / math.tau * 4096))
    line.wait(2)
    sag = line.get("goal_position") / 4096 * math.tau - line.servo().shaft_angle
    # 800 / 128 of 885 PWM units for a tick of 4096 a turn, 4.1 Nm at 885
    torque = sag * 800 / 128 / 885 * 4096 / math.tau * 4.1
    assert held("XM430-W350", torque, math.cos(sag))
    assert line.get("present_current") == pytest.approx(torque / 4.1 * 2.3 / 0.00269, abs=3)


def test_a_wider_slope_sags_more_under_the_same_load():
    sags = []
    for slope in (32, 128):
        line = Line("AX-12A", 1, load=Load(gravity=0.5, gravity_angle=HORIZONTAL))
        line.put(cw_compliance_slope=slope, ccw_compliance_slope=slope, goal_position=round(2.0 / AX_TICK))
        line.wait(3)
        sags.append(2.0 - line.servo().shaft_angle)
        output = line.get("present_load") / 1023
        assert held("AX-12A", output * 1.5, 0.5 * math.cos(sags[-1]))
        # 0.031 of punch and 0.969 of the slope, beyond a margin of 0.29 degrees
        assert output == pytest.approx(0.031 + 0.969 * (sags[-1] - 0.0051) / (slope * AX_TICK), abs=0.01)
    assert sags[1] > 2.5 * sags[0]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("what", ["slope", "margin"])
def test_each_slope_and_margin_counts_in_its_own_direction(side, what):
    sags = []
    for soft in (f"ccw_compliance_{what}", f"cw_compliance_{what}"):
        line = Line("AX-12A", 1, load=Load(gravity=0.5, gravity_angle=2.0 - side * math.pi / 2))
        line.put(**{soft: 128, "goal_position": round(2.0 / AX_TICK)})
        line.wait(3)
        sags.append(abs(2.0 - line.servo().shaft_angle))
    pushed, let_go = sags[::side]  # a load that pulls CW is pushed CCW
    assert pushed > 2.5 * let_go


def test_feed_forward_of_what_motor_and_rotor_take_leaves_no_lag():
    lags = []
    # the duty that motor and rotor take per rad/s and rad/s^2, in the gains' units of PWM, ticks and ms;
    # of the second as much as the item holds
    unit = 4096 / math.tau / 885 * MOTOR.stall_torque
    for first, second in ((0, 0), (round(4e3 * MOTOR.damping / unit), 16_383)):
        line = Line("XM430-W350", 1, position=1.0)
        line.put(feedforward_1st_gain=first, feedforward_2nd_gain=second, profile_velocity=100)
        line.put(profile_acceleration=10, torque_enable=1, goal_position=3000)
        line.wait(0.5)
        shown = line.servo().registers
        lags.append(shown.ticks("position_trajectory") - shown.ticks("present_position"))
    assert lags[0] > 30
    assert abs(lags[1]) < 5


def test_every_model_settles_where_it_should_without_much_overshoot():
    mechanics, tables = Mechanics(0), [table for table in all_tables() if table.model != "XL-320"]
    servos = [
        make_servo(ServoConfig(1, each.model, 1.0), 57_600, 0, None, each.protocol, mechanics=mechanics)
        for each in tables
    ]
    goals = []
    for servo, table in zip(servos, tables, strict=True):
        goals.append(round(min(1.5, 0.9 * table.max_tick * table.rad_per_tick) / table.rad_per_tick))
        servo.poke("torque_enable", 1)
        servo.poke("goal_position", goals[-1])
    highest = [0.0] * len(servos)
    for now in range(0, 3 * S, 10_000_000):
        mechanics.step_to(now)
        highest = [max(pair) for pair in zip(highest, mechanics.plant.angle.tolist(), strict=True)]
    torques = mechanics.servos["torque"].tolist()
    for servo, goal, top, torque in zip(servos, goals, highest, torques, strict=True):
        servo.advance_to(3 * S)
        table, margin = servo.registers.table, servo.registers.get("cw_compliance_margin")
        motor = motor_of(table)
        assert abs(torque) <= 1.001 * motor.friction / (1 - motor.load_friction)
        # so much friction leaves where gains are weakest, those of YM070
        rest = math.radians(2.3) + margin * table.rad_per_tick
        assert servo.shaft_angle == pytest.approx(goal * table.rad_per_tick, abs=rest)
        assert top < goal * table.rad_per_tick + 0.25 * 0.5, table.model  # most: the quick XL330-M077
        assert servo.registers.get("moving") == 0
