"""Modes on the wire: a model is brought into each mode that it has, follows its goals, and never jumps."""

from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import truncate_next, turn_by_hand
from tests.kit.rigs import make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import StartUpError
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import find_table
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import mode_in, position_reach
from dxlwire.wire import protocol2

P, V, E, W, C = Mode.POSITION, Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION
FAMILIES = {
    ("AX-12A", 1.0): {P, V, W, C},
    ("RX-10", 1.0): {P, V, W, C},
    ("RX-64", 1.0): {P, V, W, C},
    ("EX-106+", 1.0): {P, V, W, C},
    ("MX-28", 1.0): {P, V, C},
    ("MX-12W", 1.0): {P, V, C},
    ("MX-64", 1.0): {P, V, E, C},
    ("MX-106", 1.0): {P, V, E, C},
    ("MX-28", 2.0): {P, V, W},
    ("MX-64", 2.0): {P, V, E, W, C},
    ("XL-320", 2.0): {P, V, W},
    ("XL330-M288", 2.0): {P, V, E, W, C},
    ("XL430-W250", 2.0): {P, V, W},
    ("XM430-W350", 2.0): {P, V, E, W, C},
    ("XH540-W270", 2.0): {P, V, E, W, C},
    ("PH54-200-S500", 2.0): {P, V, E, W},
    ("RH-P12-RN(A)", 2.0): {P, E, C},
    ("XM335-T323", 2.0): {P, V, E, W, C},
    ("XC335-T332", 2.0): {P, V, E, W, C},
    ("H54-200-S500-R", 2.0): {P, V, E},
    ("M42-10-S260-R", 2.0): {P, V, E},
    ("L54-50-S290-R", 2.0): {P, V, E},
    ("L42-10-S300-R", 2.0): {P, V},
    ("RH-P12-RN", 2.0): {P, E, C},
}
"""What the e-Manual's pages of the models say."""


def make_pair(**change):
    """Return a plan of two XM430-W350."""
    x = {"model": "XM430-W350", "protocol": 2.0, "reference": np.pi, "return_delay_ns": 0}
    return make_plan((1, 2), **x | change)


def make_one(model, protocol, **change):
    """One servo of a model, in the middle of its travel, started."""
    table = find_table(model, protocol)
    limits = [table.items.get(f"{end}_position_limit") for end in ("min", "max")]
    low, high = (
        given if item is None else item.initial
        for given, item in zip((table.min_tick, table.max_tick), limits, strict=True)
    )
    middle = (low + high) / 2 * table.rad_per_tick
    reach = 0.45 * (high - low) * table.rad_per_tick
    given = {"reference": middle, "lower": -reach, "upper": reach, "return_delay_ns": 0} | change
    plan = make_plan((1, 2), model=model, protocol=protocol, **given)
    return start_rig(plan, position=middle or 0.001)


def change(rig, mode, rows=(0,), cycles=60):
    """Ask for a mode; return after how many cycles it was there; goals are where the joint is then."""
    rig.set_modes(*(mode if row in rows else 0 for row in range(len(rig.states.mode))))
    for count in range(1, cycles):
        rig.cycle()
        if all(rig.states.mode[row] == mode for row in rows):
            rig.cycle()
            return count
    raise AssertionError(rig.events.texts(EventCode.MODE))


def command(rig, mode, value, row=0):
    """Give one joint a goal of a mode, and no other."""
    rig.goals.values[:, row] = np.nan
    led = {Mode.VELOCITY: rig.goals.velocity, Mode.EFFORT: rig.goals.effort, Mode.PWM: rig.goals.pwm}
    led.get(mode, rig.goals.position)[row] = value


def moved(rig, cycles=15):
    """Return how far the first joint's servo turns in some cycles, rad of the joint."""
    servo, plan = rig.servo(1), rig.plans[0].servos[0]
    before = servo.shaft_angle
    rig.cycles(cycles)
    return plan.direction * (servo.shaft_angle - before)


CASES = [
    pytest.param(model, protocol, mode, id=f"{model}-{protocol:g}-{mode.name.lower()}")
    for (model, protocol), modes in FAMILIES.items()
    for mode in sorted(modes - {P})
]


@pytest.mark.parametrize(("model", "protocol"), FAMILIES)
def test_a_model_has_the_modes_of_its_manual(model, protocol):
    plan = make_plan((1,), model=model, protocol=protocol, reference=1.0, lower=-0.5, upper=0.5)
    assert {mode.mode for mode in plan.servos[0].modes} == FAMILIES[model, protocol]


@pytest.mark.parametrize(("model", "protocol", "mode"), CASES)
def test_a_model_goes_into_a_mode_follows_its_goals_there_and_comes_back(model, protocol, mode):
    rig = make_one(model, protocol)
    standing = rig.servo(1).shaft_angle
    change(rig, mode)
    assert rig.servo(1).shaft_angle == pytest.approx(standing, abs=0.02), "it jumped"
    slow = (
        3.0 if model == "XL-320" else 0.4
    )  # of its output, which is no controlled speed, friction takes 9 %
    scale = {Mode.VELOCITY: slow, Mode.PWM: 0.2, Mode.EFFORT_POSITION: 0.1}.get(mode, 0.0)
    plan = rig.plans[0].servos[0].mode_plan(mode)
    if mode is Mode.EFFORT:
        scale = plan.effort.per_tick * plan.effort.most * 0.15
    command(rig, mode, scale)
    assert moved(rig) > 0.0005
    command(rig, mode, -scale)
    moved(rig, 10 if mode is E else 3)
    assert moved(rig) < -0.0005
    change(rig, Mode.POSITION)
    assert rig.torque() == [True, True]
    assert rig.events.of(EventCode.SERVO_LIMP) == []


@pytest.fixture
def arm():
    return make_one("XM430-W350", 2.0)


def instructions(rig, servo_id, since=0):
    """Return what was said to one servo of Protocol 2.0 by itself: instruction and first parameter bytes."""
    return [(data[7], data[8] | data[9] << 8) for data in rig.into_bus()[since:] if data[4] == servo_id]


def named_in_goals(rig, servo_id, since=0):
    """Return the sync writes that name a servo."""
    found = []
    for data in rig.into_bus()[since:]:
        if data[7] == 0x83:
            width = (data[10] | data[11] << 8) + 1
            found += [data for at in range(12, len(data) - 2, width) if data[at] == servo_id]
    return found


def test_torque_is_off_while_the_mode_is_written_and_no_goal_is_sent_meanwhile(arm):
    arm.restless = 0.002
    arm.cycle()
    since = len(arm.into_bus())
    arm.set_modes(Mode.VELOCITY, 0)
    assert arm.states.mode.tolist() == [Mode.UNKNOWN, Mode.POSITION]
    arm.cycle()
    arm.cycle()
    assert arm.states.mode.tolist() == [Mode.VELOCITY, Mode.POSITION]
    said = instructions(arm, 1, since)
    writes = [address for instruction, address in said if instruction == 3]
    assert writes == [64, 11, 104, 64]
    assert named_in_goals(arm, 1, since) == [], (
        "a goal position while the mode changed, or no goal velocity yet"
    )
    assert len(named_in_goals(arm, 2, since)) == 2
    assert arm.torque() == [True, True]
    ((source, text),) = arm.events.of(EventCode.MODE)
    assert (source, "is in velocity mode" in text) == ("main_1_joint", True)


def test_gains_that_a_tool_set_outlive_a_change_and_others_begin_with_those_of_the_mode(arm):
    servo = arm.servo(1)
    servo.poke("position_p_gain", 700)
    servo.poke("profile_acceleration", 12)
    servo.poke("goal_pwm", 300)
    change(arm, Mode.EFFORT_POSITION)
    kept = [servo.registers[name] for name in ("position_p_gain", "profile_acceleration", "goal_pwm")]
    assert kept == [700, 12, 300]
    assert servo.registers["velocity_p_gain"] == 100


def test_what_the_file_declares_holds_in_another_mode_whose_own_values_differ():
    """A change resets gains "properly to the selected Operating Mode" (e-Manual, X series, Operating Mode
    (11)), which does not say to what: here to 400, and more than the manual names."""
    items = find_table("XM430-W350", 2.0).items
    plan = make_pair()
    declared = tuple(
        RegisterValue(items[name].address, items[name].size, value, name)
        for name, value in (("position_p_gain", items["position_p_gain"].initial), ("led", 1))
    )
    rig = make_rig(replace(plan, servos=(replace(plan.servos[0], settings=declared), plan.servos[1])))
    for servo in rig.buses[0].servos:

        def reset(servo=servo, before=servo._change_mode):
            before()
            servo.poke("position_p_gain", 400)
            servo.poke("led", 0)

        servo._change_mode = reset
    rig.hardware.start()
    rig.servo(2).poke("led", 1)
    change(rig, Mode.EFFORT_POSITION, rows=(0, 1))
    found = [[one.registers[name] for name in ("position_p_gain", "led")] for one in rig.buses[0].servos]
    assert found == [[800, 1], [400, 0]]


def test_goals_keep_within_the_servos_own_limit_beyond_which_it_would_refuse_them():
    plan = make_pair()
    rig = make_rig(plan)
    rig.servo(1).poke("velocity_limit", 50)
    rig.servo(1).poke("current_limit", 100)
    rig.hardware.start()
    change(rig, Mode.VELOCITY)
    command(rig, Mode.VELOCITY, -9.0)
    moved(rig, 2)
    assert rig.servo(1).registers.ticks("goal_velocity") == 50
    change(rig, Mode.EFFORT)
    command(rig, Mode.EFFORT, 3.0)
    moved(rig, 2)
    assert rig.servo(1).registers.ticks("goal_current") == -100


def test_a_servo_that_refuses_keeps_its_mode_and_its_torque():
    rig = make_one("AX-12A", 1.0)
    rig.servo(1).poke("lock", 1)
    rig.set_modes(Mode.VELOCITY, 0)
    rig.cycles(30)
    assert rig.states.mode.tolist() == [Mode.POSITION, Mode.POSITION]
    assert rig.torque() == [True, True]
    (text,) = rig.events.texts(EventCode.MODE)
    assert "has Lock (47) = 1, so CCW Angle Limit (8) = 0 in its EEPROM was not written" in text
    assert "switch its power off and on" in text
    assert "it is in position mode" in text


def test_the_mode_of_a_servo_that_does_not_acknowledge_torque_off_is_left_alone():
    """An MX with Protocol 1.0 takes other angle limits with torque on, and would begin to turn."""
    rig = make_one("MX-28", 1.0)
    servo = rig.servo(1)
    limit = servo.registers["ccw_angle_limit"]
    lose = partial(rig.buses[0].alter_next_instruction, "lost", lambda _: b"")
    rig.when(lambda data: data[2] == 1 and data[4:7] == b"\x03\x18\x00", lose)
    rig.set_modes(Mode.VELOCITY, 0)
    rig.cycles(60)
    assert servo.registers["ccw_angle_limit"] == limit
    assert rig.torque() == [True, True]
    (text,) = rig.events.texts(EventCode.MODE)
    assert "did not acknowledge torque off before its mode was changed; it is in position mode" in text


def test_of_two_modes_that_are_selected_alike_the_one_of_the_start_counts():
    """An AX in wheel mode follows a velocity or a PWM by the same register."""
    wheel = {"cw_angle_limit": 0, "ccw_angle_limit": 0}
    for mode in (Mode.VELOCITY, Mode.PWM):
        plan = make_plan((1,), continuous=True, lower=-np.inf, upper=np.inf, start_mode=mode)
        assert mode_in(plan.servos[0], wheel) is mode


def test_a_model_without_the_mode_is_named_and_stays():
    rig = make_one("XL430-W250", 2.0)
    rig.set_modes(Mode.EFFORT, 0)
    rig.cycle()
    rig.cycle()
    assert rig.states.mode.tolist() == [Mode.POSITION, Mode.POSITION]
    (text,) = rig.events.texts(EventCode.MODE)
    assert "XL430-W250 of main_1_joint has no mode effort" in text


def test_a_later_request_replaces_the_one_that_is_on_its_way(arm):
    for mode in (Mode.VELOCITY, Mode.PWM):
        arm.set_modes(mode, 0)
    change(arm, Mode.EFFORT)
    assert arm.servo(1).registers["operating_mode"] == 0
    written = [data[10] for data in arm.into_bus() if data[4:10] == bytes((1, 6, 0, 3, 11, 0))]
    assert written == [0], "the EEPROM was written for modes that were not wanted any more"


def test_a_servo_that_falls_silent_on_the_way_gets_no_goals(arm):
    arm.servo(1).silence()
    arm.set_modes(Mode.VELOCITY, 0)
    since = len(arm.into_bus())
    arm.cycles(12)
    assert arm.states.mode[0] == Mode.UNKNOWN
    assert named_in_goals(arm, 1, since) == []


def test_a_goal_that_stays_costs_nothing_on_the_wire_but_now_and_then(arm):
    arm.cycle()
    arm.cycle()
    since = len(arm.into_bus())
    arm.cycles(100)
    assert len(named_in_goals(arm, 1, since)) == 2
    since = len(arm.into_bus())
    arm.goals.position[0] += 0.1
    arm.cycle()
    arm.cycle()
    arm.cycle()
    assert (len(named_in_goals(arm, 1, since)), len(named_in_goals(arm, 2, since))) == (2, 0)


@pytest.mark.parametrize(("model", "protocol"), [("XM430-W350", 2.0), ("MX-28", 1.0), ("PH54-200-S500", 2.0)])
def test_a_continuous_joint_turns_as_a_wheel_and_goes_to_positions_over_turns(model, protocol):
    plan = make_plan(
        (1, 2),
        model=model,
        protocol=protocol,
        reference=0.0,
        lower=-np.inf,
        upper=np.inf,
        continuous=True,
        return_delay_ns=0,
    )
    rig = start_rig(plan, position=0.5)
    assert rig.states.mode.tolist() == [Mode.VELOCITY, Mode.VELOCITY]
    command(rig, Mode.VELOCITY, 2.0)
    assert moved(rig, 60) > 2.0 * 60 * 0.02 * 0.8
    assert rig.states.velocity[0] == pytest.approx(2.0, rel=0.05)
    change(rig, Mode.POSITION)
    began = rig.states.position[0]
    command(rig, Mode.POSITION, began - 15.0)
    moved(rig, 600)
    assert rig.states.position[0] == pytest.approx(began - 15.0, abs=0.02)


def test_a_wheel_of_a_model_that_controls_no_speed_reports_its_speed_in_the_same_unit():
    plan = make_plan((1, 2), continuous=True, lower=-np.inf, upper=np.inf, return_delay_ns=0)
    rig = start_rig(plan)
    command(rig, Mode.VELOCITY, 3.0)
    travelled = moved(rig, 50)
    assert travelled / (50 * 0.02) == pytest.approx(3.0, rel=0.1)
    assert rig.states.velocity[0] == pytest.approx(3.0, rel=0.05)


def test_a_servo_that_starts_in_another_mode_is_brought_into_its_first_one():
    plan = make_pair()
    rig = make_rig(plan)
    rig.servo(2).poke("operating_mode", 16)
    rig.hardware.start()
    assert rig.servo(2).registers["operating_mode"] == 3
    ((source, text),) = rig.events.of(EventCode.MODE)
    assert (source, "Operating Mode (11) was 16" in text) == ("main_2_joint", True)
    assert [data[8] for data in rig.into_bus() if data[4] == 1 and data[7] == 3] == [112, 64], (
        "EEPROM untouched"
    )


def test_a_torque_limit_weakens_a_servo_that_follows_a_pwm_and_does_not_drive_it():
    rig = make_one("XM430-W350", 2.0)
    change(rig, Mode.PWM)
    command(rig, Mode.PWM, 0.0)
    moved(rig, 3)
    rig.hardware._full_torque = [[885, 885]]
    rig.hardware.limit_torque(0.1)
    assert abs(moved(rig)) < 0.001
    command(rig, Mode.PWM, 1.0)
    moved(rig, 2)
    assert abs(rig.servo(1).registers.ticks("goal_pwm")) == 88


@pytest.mark.parametrize("beyond", [100, 800])
def test_a_joint_that_coasted_over_its_limits_is_led_back_slowly_and_does_not_fall(beyond):
    arm = make_one("XM430-W350", 2.0, lower=-1.0, upper=1.0)
    servo, plan = arm.servo(1), arm.plans[0].servos[0]
    change(arm, Mode.EFFORT)
    turn_by_hand(servo, (plan.upper_tick + beyond) * plan.rad_per_tick)
    change(arm, Mode.POSITION)
    assert arm.torque() == [True, True]
    assert servo.registers["goal_position"] == plan.upper_tick
    assert 0 < servo.registers["profile_velocity"] * plan.rad_s_per_tick <= 0.51


def test_a_servo_outside_its_limits_that_is_taken_over_in_another_mode_gets_no_torque():
    plan = make_pair(lower=-1, upper=1)
    rig = make_rig(plan, take_over=True, position=np.pi)
    servo = rig.servo(2)
    servo.poke("operating_mode", 16)
    servo.poke("goal_pwm", 0)
    servo.poke("torque_enable", 1)
    turn_by_hand(servo, (plan.servos[1].lower_tick - 30) * plan.servos[1].rad_per_tick)
    with pytest.raises(StartUpError, match=r"ID 2 on bus main.* is at -59.9 deg, outside its"):
        rig.hardware.start()
    assert rig.torque() == [False, False]
    assert [address for instruction, address in instructions(rig, 2) if instruction == 3] == [64, 11]


def test_a_servo_that_lost_its_torque_over_a_change_gets_no_goal_which_would_switch_it_on():
    rig = make_one("AX-12A", 1.0)
    rig.servo(1).poke("lock", 1)
    since = len(rig.into_bus())
    rig.set_modes(Mode.VELOCITY, 0)
    rig.hardware.read_states()
    rig.hardware.write_goals()
    rig.hardware.idle(rig.clock.now_ns() + 15_000_000)
    assert rig.states.mode[0] == Mode.POSITION
    rig.hardware.read_states()
    rig.hardware.write_goals()
    writes = [data for data in rig.into_bus()[since:] if data[4] == 0x83]
    assert [1 in data[7:-1:5] for data in writes] == [False, False], "a goal before torque enable was read"


def write_of_mode(data):
    return data[4] == 1 and data[7:10] == b"\x03\x0b\x00"


def test_a_request_that_comes_in_the_middle_of_a_change_is_followed(arm):
    left = [Mode.PWM]
    arm.when(write_of_mode, lambda: left and arm.set_modes(left.pop(), 0))
    arm.set_modes(Mode.VELOCITY, 0)
    arm.cycles(20)
    assert arm.states.mode[0] == Mode.PWM
    assert arm.servo(1).registers["operating_mode"] == 16


def test_a_request_that_comes_while_a_servo_is_taken_back_is_carried_out_once(arm):
    left = [Mode.VELOCITY]
    with arm.away(1, 20, 80):
        looks = protocol2.read_range(1, 0, 7)
        arm.when(lambda data: data == looks, lambda: left and arm.set_modes(left.pop(), 0))
    assert arm.states.mode[0] == Mode.VELOCITY
    assert len([text for text in arm.events.texts(EventCode.MODE) if "is in velocity mode" in text]) == 1


def test_a_mode_that_was_refused_is_not_entered_after_a_reboot():
    rig = make_one("AX-12A", 1.0)
    servo = rig.servo(1)
    limit = servo.registers["ccw_angle_limit"]
    servo.poke("lock", 1)
    rig.set_modes(Mode.VELOCITY, 0)
    rig.cycles(30)
    servo.cut_power(rig.clock.now_ns() + 300_000_000)  # after it, nothing is locked
    rig.cycles(100)
    assert rig.states.valid[0]
    assert servo.registers["ccw_angle_limit"] == limit
    assert rig.states.mode[0] == Mode.POSITION


def test_a_servo_whose_torque_could_not_be_read_after_a_change_gets_no_goal_until_it_was(arm):
    ask, asked, goals = protocol2.read_range(1, 64, 1), [], []

    def lose():
        asked.append(arm.clock.now_ns())
        if 3 <= len(asked) <= 5:  # the first one is before the change, the second one reads torque on back
            truncate_next(arm.buses[0], 1, 0)

    arm.when(lambda data: data == ask, lose)
    arm.when(lambda data: data[7] == 0x83 and 1 in data[12:-2:5], lambda: goals.append(len(asked)))
    change(arm, Mode.VELOCITY)
    arm.restless = 0.0
    for turn in range(10):
        arm.goals.velocity[0] = 0.01 * turn
        arm.cycle()
    assert goals
    assert goals[0] == 6


def test_the_limit_of_the_current_comes_before_the_position_that_it_limits(arm):
    since = len(arm.into_bus())
    change(arm, Mode.EFFORT_POSITION)
    written = [address for instruction, address in instructions(arm, 1, since) if instruction == 3]
    assert written.index(102) < written.index(112)


def test_a_limit_of_the_current_that_no_servo_can_have_is_no_goal(arm):
    arm.servo(1).registers["current_limit"] = 0xFD01
    change(arm, Mode.EFFORT_POSITION)
    assert arm.servo(1).registers["goal_current"] == 1193, "what a XM430-W350 can have at most"


@pytest.fixture
def limited():
    """An AX-12A whose positions have a limit of the effort: Torque Limit (34)."""
    rig = make_one("AX-12A", 1.0)
    change(rig, Mode.EFFORT_POSITION, rows=(0, 1))
    return rig


def test_a_servo_of_protocol_1_goes_to_a_position_with_no_more_torque_than_its_limit(limited):
    """Its shaft is blocked, so that what it exerts is what it may."""
    limited.servo(1).jam_shaft(True)
    command(limited, Mode.EFFORT_POSITION, 0.5)
    for effort, ticks in ((0.2, 205), (0.5, 512), (0.1, 102)):
        limited.goals.effort[0] = effort
        moved(limited, 10)
        assert abs(limited.states.effort[0]) == pytest.approx(effort, abs=0.002)
        assert limited.registers("torque_limit") == [ticks, 1023]


def test_torque_limit_is_never_set_to_0_which_means_a_shutdown(limited):
    """A servo that shut itself down has 0 there, which the next start refuses."""
    limited.goals.effort[:] = 0.0
    for rig in (limited, make_one("AX-12A", 1.0)):
        rig.hardware._full_torque = [[1023, 1023]]
        rig.hardware.limit_torque(0.0)
        moved(rig, 3)
        assert rig.registers("torque_limit") == [1, 1]


@pytest.mark.parametrize("mode", [Mode.POSITION, Mode.VELOCITY])
def test_another_mode_gives_all_torque_back_once_the_goal_moves_nothing(limited, mode):
    limited.servo(1).poke("max_torque", 800)
    limited.goals.effort[:] = 0.3
    moved(limited, 3)
    since = len(limited.into_bus())
    change(limited, mode)
    assert limited.registers("torque_limit") == [800, 307]
    written = [data[5] for data in limited.into_bus()[since:] if data[2] == 1 and data[4] == 3]
    goal = 30 if mode is Mode.POSITION else 32
    assert written.index(goal) < written.index(34)
    assert limited.torque() == [True, True]


def test_a_policy_that_reduces_torque_is_not_undone_by_a_servo_that_returns():
    rig = make_one("AX-12A", 1.0)
    rig.hardware._full_torque = [[1023, 1023]]
    rig.hardware.limit_torque(0.5)
    with rig.away(1, 15):
        pass
    assert rig.events.of(EventCode.SERVO_BACK)
    assert rig.registers("torque_limit") == [512, 512]


def test_a_servo_that_returns_in_another_mode_has_all_its_torque(limited):
    limited.goals.effort[:] = 0.3
    moved(limited, 3)
    with limited.away(1, 15, 20):
        limited.set_modes(Mode.POSITION, 0)
    assert limited.states.mode[0] == Mode.POSITION
    assert limited.registers("torque_limit") == [1023, 307]


@pytest.mark.parametrize("shuts", ["overload", "voltage"])
def test_a_servo_that_shut_itself_down_gets_no_torque_back_by_a_limit(limited, shuts):
    """Torque Limit (34) becomes 0, Torque Enable (24) stays 1, and a write of the limit would revive it."""
    servo = limited.servo(1)
    servo.poke("shutdown", 0x25)
    for number in range(30):
        limited.goals.effort[:] = 0.3 + 0.01 * number
        if number == 10:
            servo.trigger_overload() if shuts == "overload" else servo.set_voltage(5.0)
        limited.cycle()
        assert number < 10 or servo.registers["torque_limit"] == 0
    assert limited.events.of(EventCode.SERVO_LIMP)
    for mode in (Mode.POSITION, Mode.EFFORT_POSITION):
        limited.set_modes(mode, 0)
        limited.cycles(20)
        assert servo.registers["torque_limit"] == 0


def test_extended_positions_reach_as_far_as_the_manual_says():
    """e-Manual XM430-W350, Goal Position (116): -1,048,575 to 1,048,575, 256 turns."""
    assert position_reach(find_table("XM430-W350", 2.0), True) == (-1_048_575, 1_048_575)


def test_a_start_gives_no_torque_limit_to_a_servo_that_would_be_driven_by_it():
    """Goal PWM (100) is the limit in the other modes, and full voltage in this one."""
    rig = make_rig(make_pair(continuous=True, start_mode=Mode.PWM, lower=-np.inf, upper=np.inf))
    rig.hardware.start()
    assert rig.registers("goal_pwm") == [0, 0]
    standing = rig.servo(1).shaft_angle
    rig.wait(100_000_000)
    assert rig.torque() == [True, True]
    assert rig.servo(1).shaft_angle == pytest.approx(standing, abs=0.001)


def test_no_torque_limit_is_written_while_a_mode_changes(arm):
    arm.hardware._full_torque = [[885, 885]]
    arm.set_modes(Mode.PWM, 0)
    arm.hardware.limit_torque(0.5)
    arm.torque()
    assert arm.registers("goal_pwm") == [885, 442]


@pytest.mark.parametrize(("model", "protocol"), [("XM430-W350", 2.0), ("AX-12A", 1.0)])
def test_a_servo_that_reboots_in_its_own_mode_change_gets_no_torque_by_that(model, protocol):
    """Before each packet of the change; the policy for returned servos is limp."""
    rebooted = []
    for number in range(1, 60):
        rig = make_one(model, protocol)
        bus, servo = rig.buses[0], rig.servo(1)
        rig.set_modes(Mode.VELOCITY, 0)
        sent = len(rig.into_bus())

        def reset(rig=rig, servo=servo, number=number):
            if rig.states.mode[0] == Mode.UNKNOWN:
                rebooted.append(number)
                servo.cut_power(rig.clock.now_ns() + 1)

        bus.after(number, reset)
        rig.cycles(40)
        if number not in rebooted:
            break
        assert not servo.torque_on, f"{number}: {[packet.hex(' ') for packet in rig.into_bus()[sent:][:40]]}"
    assert len(rebooted) > 10


def test_an_led_that_stays_dark_shows_no_reboot():
    rig = make_one("AX-12A", 1.0)
    rig.stick(1, "led", 0)
    change(rig, Mode.VELOCITY)
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []
    assert rig.torque() == [True, True]


def test_a_mode_is_entered_though_no_cycle_leaves_time_for_it():
    rig = start_rig(make_pair())
    rig.cycles(10)
    rig.set_modes(V, Mode.UNKNOWN)
    for _ in range(400):
        rig.hardware.idle(rig.clock.now_ns())
        rig.hardware.read_states()
        rig.hardware.write_goals()
        rig.wait(1_000_000)
    assert rig.states.mode.tolist() == [V, P]
    assert "of idle time, but a cycle leaves only" in rig.events.texts(EventCode.OVERRUN)[0]
