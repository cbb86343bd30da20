"""Servos of which something is not as it was, unnoticed: they get no goal that could hurt."""

import math
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import make_plan, make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.torque_off import limp, stand
from dxlwire.modes import Mode


def make_wheel(model="XM430-W350", protocol=2.0, **change):
    """Two continuous joints, the first of which is tested."""
    ends = {"lower": -math.inf, "upper": math.inf, "reference": math.pi, "return_delay_ns": 0}
    plan = make_plan((1, 2), model=model, protocol=protocol, continuous=True, **ends, **change)
    servos = tuple(replace(servo, torque_on_return=True) for servo in plan.servos)
    return start_rig(replace(plan, servos=servos))


def change(rig, mode, cycles=30):
    rig.set_modes(mode, 0)
    rig.cycles(cycles)


def test_a_joint_that_forgot_its_turns_over_a_reboot_does_not_wind_them_up_again():
    rig = make_wheel(start_mode=Mode.POSITION)
    for _ in range(300):
        rig.goals.position[0] += 0.04
        rig.cycle()
    servo = rig.servo(1)
    servo.cut_power(rig.clock.now_ns() + 300_000_000)
    standing = servo.shaft_angle
    rig.cycles(150)
    assert rig.states.valid[0]
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1), (
        "it wound up the turns that it had forgotten"
    )
    assert rig.torque() == [False, True]
    (text,) = rig.events.texts(EventCode.SERVO_LIMP)
    assert "lost its turn count" in text
    assert "switch its torque on with `dxlrun torque on main_1_joint`" in text
    assert rig.events.of(EventCode.IMPLAUSIBLE) == [], "its position is another one for a known reason"
    rig.hardware.switch_torque(0, True)
    rig.cycles(20)
    assert rig.torque() == [True, True]
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1)


def test_a_wheel_that_is_led_by_its_velocity_gets_torque_again_after_a_reboot():
    rig = make_wheel()
    rig.cycles(20)
    rig.servo(1).cut_power(rig.clock.now_ns() + 300_000_000)
    rig.cycles(150)
    assert rig.torque() == [True, True]


def test_a_servo_that_lost_its_torque_unnoticed_gets_it_by_no_change_of_modes():
    rig = start_rig(make_plan((1, 2), model="MX-64", reference=math.pi, lower=-2, upper=2, return_delay_ns=0))
    rig.cycle()
    rig.servo(1).poke("torque_enable", 0)
    change(rig, Mode.VELOCITY)
    change(rig, Mode.POSITION)
    for _ in range(5):
        rig.goals.position[:] += 0.01  # to an MX a goal position is torque on
        rig.cycle()
    assert rig.torque() == [False, True]
    assert rig.events.sources(EventCode.SERVO_LIMP) == ["main_1_joint"]


@pytest.mark.parametrize("left", [10, -1])
def test_a_watchdog_that_a_killed_run_left_keeps_no_next_run_from_taking_over(left):
    plan = make_x((1, 2), name="main")
    servos = tuple(replace(servo, start_mode=Mode.EFFORT_POSITION) for servo in plan.servos)
    rig = make_rig(replace(plan, servos=servos, watchdog_ticks=20), take_over=True)
    for servo in rig.buses[0].servos:
        servo.poke("torque_enable", 1)
        servo.poke("bus_watchdog", left)
    rig.hardware.start()
    assert rig.torque() == [True, True]
    assert rig.registers("bus_watchdog") == [20, 20]


def test_a_watchdog_that_is_still_armed_is_off_where_the_robot_file_wants_none():
    plan = make_x((1, 2), name="main")
    rig = make_rig(plan)
    rig.servo(1).poke("bus_watchdog", 10)
    rig.hardware.start()
    assert rig.servo(1).registers["bus_watchdog"] == 0


@pytest.mark.parametrize("model", ["AX-12A", "MX-64"])
def test_a_servo_whose_mode_was_changed_by_half_when_the_power_went_starts_again(model):
    rig = make_rig(make_plan((1, 2), model=model, lower=-1.5, upper=1.5))
    servo, plan = rig.servo(1), rig.plans[0].servos[0]
    servo.poke("cw_angle_limit", plan.lower_tick)
    servo.poke("ccw_angle_limit", 0)
    rig.hardware.start()
    assert rig.torque() == [True, True]
    limits = servo.registers["cw_angle_limit"], servo.registers["ccw_angle_limit"]
    assert limits == (plan.lower_tick, plan.upper_tick)


def test_a_wheel_that_made_more_turns_than_its_servo_counts_does_not_wind_them_back():
    rig = make_wheel("MX-28", 1.0)
    servo = rig.servo(1)
    turn_by_hand(servo, 7.8 * math.tau)
    standing = servo.shaft_angle
    change(rig, Mode.POSITION, 60)
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1)
    ((source, text),) = rig.events.of(EventCode.MODE)[-1:]
    assert (source, "outside its limits" in text) == ("main_1_joint", True)


def test_a_loop_that_is_late_again_and_again_asks_for_a_servos_watchdog_once():
    plan = make_x((1, 2), name="main")
    rig = start_rig(replace(plan, watchdog_ticks=10))
    events = len(rig.events.of(EventCode.WATCHDOG))
    for _ in range(20):
        rig.hardware.read_states()
        rig.hardware.write_goals()
        rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
        rig.hardware.idle(rig.clock.now_ns())  # no time for anything in it
    assert len(rig.events.of(EventCode.WATCHDOG)) - events == 19
    seen = len(rig.into_bus())
    rig.cycles(10)
    cleared = [data for data in rig.into_bus()[seen:] if data[7] == 3 and data[8] == 98 and data[10] == 0]
    assert len(cleared) == 2
    assert rig.torque() == [True, True]


@pytest.mark.parametrize(("model", "protocol"), [("MX-28", 1.0), ("AX-12A", 1.0), ("XL430-W250", 2.0)])
def test_wheels_of_a_robot_that_is_left_with_torque_by_a_loop_that_died_stand(model, protocol):
    rig = make_wheel(model, protocol)
    rig.goals.velocity[:] = 1.0, 0.0
    rig.cycles(20)
    rig.servo(2).poke("torque_enable", 0)
    rig.hardware.read_states()  # and the loop dies
    said = stand(rig.lines)
    assert said == ("main_1_joint (ID 1 on bus main) was stopped: its goal is 0",)
    rig.clock.wait_until(rig.clock.now_ns() + 500_000_000)
    assert rig.torque() == [True, False], "a servo without torque was given some"
    standing = rig.servo(1).shaft_angle
    rig.clock.wait_until(rig.clock.now_ns() + 500_000_000)
    rig.torque()
    assert rig.servo(1).shaft_angle == pytest.approx(standing, abs=0.05)


def test_a_wheel_that_takes_no_goal_any_more_loses_its_torque_when_the_loop_died():
    rig = make_wheel()
    rig.goals.velocity[0] = 1.0
    rig.cycles(20)
    rig.servo(1).poke("bus_watchdog", -1)
    said = stand(rig.lines)
    assert "could not be stopped and is limp: did not acknowledge its goal" in said[0]
    assert rig.torque() == [False, True]


def test_a_wheel_whose_torque_off_was_lost_is_tried_again():
    rig = make_wheel()
    rig.goals.velocity[0] = 1.0
    rig.cycle()
    rig.servo(1).poke("bus_watchdog", -1)
    write, lost = rig.ports.ports[0].write_packet, []

    def lose_the_first(data):
        if data[4] == 1 and data[7:11] == b"\x03\x40\x00\x00" and not lost:
            lost.append(data)
            rig.buses[0].alter_next_instruction("lost", lambda _: b"")
        write(data)

    rig.ports.ports[0].write_packet = lose_the_first
    said = stand(rig.lines)
    assert lost
    assert "main_1_joint (ID 1 on bus main) could not be stopped and is limp: " in said[-1]
    assert rig.torque()[0] is False


def test_a_wheel_that_keeps_its_torque_whatever_is_written_is_named():
    rig = make_wheel()
    rig.goals.velocity[0] = 1.0
    rig.cycle()
    servo = rig.servo(1)
    servo.poke("bus_watchdog", -1)
    servo.registers.watch_items(("torque_enable",), lambda: servo.poke("torque_enable", 1))
    (said, _) = stand(rig.lines)[::-1]
    assert said.startswith("main_1_joint (ID 1 on bus main) may keep moving: ")
    assert said.endswith("torque off was not confirmed")


def test_joints_that_hold_a_position_are_left_alone_when_the_loop_died():
    rig = start_rig()
    rig.cycle()
    assert stand(rig.lines) == ()
    assert rig.torque() == [True] * 8


def test_a_joint_that_is_let_go_is_limp_though_noise_hit_every_attempt_to_switch_it_off():
    plan = make_x((1, 2), name="main")
    rig = start_rig(plan)
    rig.cycle()
    bus = rig.buses[0]
    write = rig.ports.ports[0].write_packet
    lose = partial(bus.alter_next_instruction, "lost", lambda _: b"")
    rig.when(lambda data: data[4:9] == b"\x01\x06\x00\x03\x40" and not data[10], lose)
    rig.hardware.switch_torque(0, False)
    rig.cycles(10)
    assert rig.torque() == [True, True]
    rig.ports.ports[0].write_packet = write
    rig.cycles(10)
    assert rig.torque() == [False, True]


def test_a_wheel_stands_before_silent_ones_are_awaited_for_long():
    ends = {"lower": -math.inf, "upper": math.inf}
    rig = start_rig(make_plan((1, 2, 3, 4), model="AX-12A", continuous=True, **ends))
    rig.goals.velocity[:] = 1.0
    rig.cycles(20)
    for servo_id in (1, 2, 3):
        rig.servo(servo_id).silence()
    begin_ns, stood_ns = rig.clock.now_ns(), []
    moving = rig.servo(4).registers
    moving.watch_items(("moving_speed",), lambda: stood_ns.append(rig.clock.now_ns()))
    said = stand(rig.lines)
    assert stood_ns[-1] - begin_ns < 500_000_000
    assert [text.split()[0] for text in said] == [f"main_{one}_joint" for one in (4, 1, 2, 3)]
    assert [" may keep moving: " in text for text in said] == [False, True, True, True]


@pytest.mark.parametrize("last_hand", [limp, stand])
def test_the_last_hand_waits_for_the_end_of_a_reply_that_is_on_its_way(last_hand):
    rig = start_rig()
    rig.clock.wait_until(rig.clock.now_ns() + 5_000_000)
    begun_ns = rig.clock.now_ns()
    rig.ports.ports[0].write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(begun_ns + 640_000)  # 80 us of instruction, 500 us of delay
    last_hand(rig.lines)
    notes = [entry.note for entry in rig.ledger.entries if entry.t_ns > begun_ns]
    assert [note for note in notes if note.startswith("collision")] == []
