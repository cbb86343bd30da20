"""Where servos count from: Homing Offset and turn, judged on the simulated shafts."""

import math

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import every_servo, make_rig, make_x

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.torque_off import stand
from dxlwire.bus_plan import RegisterValue

TICK = math.tau / 4096


def offset_of(value, *, write=True):
    return RegisterValue(20, 4, value, "homing_offset", True, write)


def expecting(value):
    """Return a plan of a robot file that expects an offset; as planned, so it is part of the ticks."""
    plan = make_x((11,))
    (servo,) = plan.servos
    servo = replace(servo.moved(value), homing_offset=value, expected=(offset_of(value, write=False),))
    return replace(plan, servos=(servo,))


def place_at(rig, angle, servo_id=11):
    """Turn a shaft, rad from raw 0, as it is after its power was off."""
    turn_by_hand(rig.servo(servo_id), angle)
    rig.servo(servo_id).power_cycle()


def is_at(rig, angle, servo_id=11):
    """Check a shaft that was sent to an angle, rad from raw 0, and the joint that it moves, to a tick."""
    off = math.remainder(rig.servo(servo_id).shaft_angle - angle, math.tau)
    assert off == pytest.approx(0, abs=3 * TICK), "friction leaves less"
    (servo,) = (one for plan in rig.plans for one in plan.servos if one.servo_id == servo_id)
    joint = servo.direction * (angle + off - math.pi) * servo.ratio
    assert rig.states.position[servo.row] == pytest.approx(joint, abs=TICK)


@pytest.mark.parametrize(
    ("offset", "mode"), [(0, 3), (300, 3), (-418, 3), (-420, 4), (1024, 4), (-1500, 4), (9000, 4)]
)
def test_homing_offset_is_taken_into_the_reference(offset, mode):
    """The mode is position control while the goals, raw 419 to 3677, fit one turn."""
    rig = make_rig(make_x((11,)))
    rig.servo(11).poke("homing_offset", offset)
    place_at(rig, 2.0)
    rig.hardware.start()
    rig.cycles(20)
    is_at(rig, 2.0)
    assert rig.servo(11).registers["operating_mode"] == mode
    rig.goals.position[0] = -0.8  # direction -1
    rig.cycles(100)
    is_at(rig, math.pi + 0.8)
    rig.goals.position[0] = -3.0  # beyond the limit, -2.5
    rig.cycles(100)
    is_at(rig, math.pi + 2.5)


def test_offset_that_position_control_ignores_is_counted_by_extended_position_control():
    """The goals would fit one turn: raw 1852 to 2244, and 1500 more."""
    rig = make_rig(make_x((11,), lower=-0.3, upper=0.3))
    rig.servo(11).poke("homing_offset", 1500)
    place_at(rig, math.pi + 0.2)
    rig.hardware.start()
    rig.cycles(2)
    is_at(rig, math.pi + 0.2)
    assert rig.servo(11).registers["operating_mode"] == 4


def test_homing_offset_is_in_the_log_with_what_to_do():
    rig = make_rig(make_x((11,)))
    rig.servo(11).poke("homing_offset", -3)
    rig.hardware.start()
    (text,) = rig.events.texts(EventCode.REGISTER_DIFFERS)
    assert "Homing Offset (20) = -3 instead of 0 (each start takes it into `reference`)" in text
    assert "write 0 by `dxlrun setup`" in text


@pytest.mark.parametrize(("most", "refused"), [(3977, False), (3976, True)])
def test_position_limits_of_a_servo_are_compared_with_its_offset(most, refused):
    rig = make_rig(make_x((11,)))
    for name, value in (("homing_offset", 300), ("min_position_limit", 719), ("max_position_limit", most)):
        rig.servo(11).poke(name, value)
    if refused:
        (problem,) = rig.refused()
        assert "has position limits 719..3976, narrower than the joint's 719..3977" in problem
    else:
        rig.hardware.start()


def test_start_with_another_offset_than_the_file_expects_is_refused():
    rig = make_rig(expecting(-300))
    rig.servo(11).poke("homing_offset", -200)
    (problem,) = rig.refused()
    assert problem.startswith(
        "arm_11_joint (ID 11 on bus arm) has Homing Offset (20) = -200, but `homing_offset` in the robot "
        "file is -300: another program changed it since; write -300"
    )
    assert not rig.writes()


def test_start_with_the_offset_that_the_file_expects_reports_nothing():
    rig = make_rig(expecting(-300))
    rig.servo(11).poke("homing_offset", -300)
    place_at(rig, 2.0)
    rig.hardware.start()
    rig.cycles(2)
    is_at(rig, 2.0)
    assert not rig.events.texts(EventCode.REGISTER_DIFFERS)


def test_declared_offset_is_written_before_positions_count():
    rig = make_rig(every_servo(make_x((11,)), settings=(offset_of(0),)))
    rig.servo(11).poke("homing_offset", -1500)
    place_at(rig, 2.0)
    rig.hardware.start()
    rig.cycles(2)
    is_at(rig, 2.0)
    assert rig.servo(11).registers.ticks("homing_offset") == 0


@pytest.mark.parametrize("before", [0, 300])
def test_servo_that_returns_with_another_offset_stays_lost(before):
    rig = make_rig(every_servo(make_x((11, 12)), torque_on_return=True))
    rig.servo(11).poke("homing_offset", before)
    rig.hardware.start()
    servo = rig.servo(11)
    servo.silence()
    rig.cycles(10)
    servo.poke("homing_offset", 500)
    servo.power_cycle()
    servo.silence(False)
    rig.cycles(150)
    assert rig.states.valid.tolist() == [False, True]
    assert not servo.torque_on
    told = [text for text in rig.events.texts(EventCode.SERVO_LOST) if "Homing Offset" in text]
    assert f"Homing Offset (20) = 500 instead of {before} as at the start: another program" in told[0]
    servo.poke("homing_offset", before)
    rig.until_valid()
    assert servo.torque_on


def test_guardian_recognizes_a_servo_that_the_start_made_count_turns():
    """The plan of the file has position control; the last step `hold` keeps the torque."""
    rig = make_rig(make_x((11,)))
    rig.servo(11).poke("homing_offset", 3000)
    rig.hardware.start()
    assert rig.servo(11).registers["operating_mode"] == 4
    stand(rig.lines)
    assert rig.torque() == [True]


def crossing(**change):
    """Return a plan of a joint whose zero is near raw 0, so that its limits are on both sides of it."""
    x = {"reference": math.radians(10), "lower": -1.6, "upper": 1.6}
    return make_x((11,), **x | change)


@pytest.mark.parametrize("turns", [0, 3, -2])
@pytest.mark.parametrize("joint", [1.0, -1.0])
def test_joint_on_either_side_of_raw_0_starts_where_it_is(joint, turns):
    rig = make_rig(crossing())
    angle = math.radians(10) - joint
    place_at(rig, angle)
    if turns:
        rig.servo(11).poke("operating_mode", 4)
        turn_by_hand(rig.servo(11), angle + turns * math.tau)
    rig.hardware.start()
    rig.cycles(5)
    assert rig.states.position[0] == pytest.approx(joint, abs=TICK)
    assert rig.servo(11).registers["operating_mode"] == 4
    rig.goals.position[0] = -joint
    rig.cycles(100)
    assert rig.states.position[0] == pytest.approx(-joint, abs=3 * TICK)


@pytest.mark.parametrize("mode", [3, 4])
def test_joint_beyond_limits_that_cross_raw_0_is_refused_with_its_position(mode):
    """Nothing is written, even if its servo has another mode yet."""
    rig = make_rig(crossing())
    rig.servo(11).poke("operating_mode", mode)
    place_at(rig, math.radians(10) + 2.5)
    (problem,) = rig.refused()
    assert "is at -143.3 deg, outside its limits -91.6..91.7 deg; move the joint inside by hand" in problem
    assert not rig.writes()


def test_joint_of_more_than_a_turn_is_refused_where_its_turn_is_not_known():
    rig = make_rig(crossing(lower=-3.5, upper=3.5))
    place_at(rig, math.radians(10) + 3.0)
    (problem,) = rig.refused()
    assert "is at -171.8 deg or 188.2 deg, each within its limits, and does not know its turn: " in problem
    assert "move it between -159.5 deg and 159.4 deg by hand" in problem
    place_at(rig, math.radians(10) + 2.7)
    rig.hardware.start()
    rig.cycles(2)
    assert rig.states.position[0] == pytest.approx(-2.7, abs=TICK)


def test_joint_that_does_not_know_its_turn_after_a_reboot_stays_limp_until_it_is_moved():
    rig = make_rig(every_servo(crossing(lower=-3.5, upper=3.5), torque_on_return=True))
    place_at(rig, math.radians(10))
    rig.hardware.start()
    rig.goals.position[0] = 3.3
    rig.cycles(150)
    servo = rig.servo(11)
    servo.cut_power(rig.clock.now_ns() + 300_000_000)
    rig.cycles(150)
    assert not servo.torque_on
    assert "does not know its turn" in rig.events.texts(EventCode.SERVO_LOST)[-1]
    turn_by_hand(servo, math.radians(10) + 0.5)
    rig.until_valid()
    rig.cycles(10)
    assert servo.torque_on
    assert rig.states.position[0] == pytest.approx(-0.5, abs=TICK)


def test_reboot_on_the_other_side_of_raw_0_changes_no_angle():
    """The servo then counts from another turn."""
    rig = make_rig(every_servo(crossing(), torque_on_return=True))
    place_at(rig, math.radians(10) + 1.0)
    rig.hardware.start()
    rig.goals.position[0] = 1.0
    rig.cycles(100)
    servo = rig.servo(11)
    assert servo.registers.ticks("present_position") < 0
    servo.cut_power(rig.clock.now_ns() + 300_000_000)
    rig.cycles(10)
    rig.until_valid()
    rig.cycles(10)
    assert servo.torque_on
    assert servo.registers.ticks("present_position") > 0
    assert rig.states.position[0] == pytest.approx(1.0, abs=3 * TICK)
    rig.goals.position[0] = -1.0
    rig.cycles(100)
    assert rig.states.position[0] == pytest.approx(-1.0, abs=3 * TICK)


def test_servo_that_is_taken_over_with_torque_does_not_move_when_it_begins_to_count_turns():
    rig = make_rig(crossing(), take_over=True)
    angle = math.radians(-40)
    place_at(rig, angle)
    servo = rig.servo(11)
    servo.poke("goal_position", round(math.radians(320) / TICK))
    servo.poke("torque_enable", 1)
    rig.hardware.start()
    rig.cycles(5)
    assert servo.torque_on
    assert math.remainder(servo.shaft_angle - angle, math.tau) == pytest.approx(0, abs=2 * TICK)
    assert rig.states.position[0] == pytest.approx(math.radians(50), abs=2 * TICK)
