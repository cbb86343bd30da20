"""A servo of Protocol 2.0: instructions, errors, protection, start-up."""

from __future__ import annotations

import math
from unittest.mock import ANY

import pytest
from tests.kit.line_faults import turn_by_hand

from dxlsim.wire.servo_protocol2 import StatusErrorNumber

PING, READ, WRITE, REG_WRITE, ACTION, RESET, REBOOT, CLEAR = 1, 2, 3, 4, 5, 6, 8, 0x10
SYNC_WRITE, BULK_WRITE = 0x83, 0x93
BROADCAST = 0xFE
ALERT = 0x80
TICK = math.tau / 4096
CLEAR_TURNS = bytes.fromhex("01 44584c22")


def test_ping_returns_model_and_firmware(line2):
    line2.servo().poke("firmware_version", 0x26)
    assert line2.request(1, PING) == (1, 0, (1020).to_bytes(2, "little") + b"\x26")


def test_a_broadcast_ping_is_answered_in_slots_by_id(make_line2):
    line = make_line2((7, 1, 30))
    line.instruct(BROADCAST, PING)
    assert [each.servo_id for each in line.statuses(400_000_000)] == [1, 7, 30]
    assert not any("collision" in note for note in line.notes())


def test_packets_of_the_manual_go_in_and_come_out(make_line2):
    line = make_line2((1,), "XM430-W210", position=166 * TICK)
    line.servo().poke("firmware_version", 0x26)
    talk = [
        ("fffffd00 01 0300 01 194e", "fffffd00 01 0700 55 00 060426 655d"),
        ("fffffd00 01 0700 02 84000400 1d15", "fffffd00 01 0800 55 00 a6000000 8cc0"),
        ("fffffd00 01 0900 03 740000020000 ca89", "fffffd00 01 0400 55 00 a10c"),
        ("fffffd00 01 0900 04 6800c8000000 ae8e", "fffffd00 01 0400 55 00 a10c"),
        ("fffffd00 01 0300 05 02ce", "fffffd00 01 0400 55 00 a10c"),
        ("fffffd00 01 0800 10 0144584c22 b1dc", "fffffd00 01 0400 55 00 a10c"),
        ("fffffd00 01 0400 06 01 a1e6", "fffffd00 01 0400 55 00 a10c"),
    ]
    for received, replied in talk:
        if received == "fffffd00 01 0800 10 0144584c22 b1dc":
            line.servo().poke("firmware_version", 42)  # the first one that knows Clear
        line.ports.ports[0].write_packet(bytes.fromhex(received))
        assert line.receive() == bytes.fromhex(replied)
    line.wait(1)
    line.bus.baud_rate = 57_600  # the factory's, which reset option 1 does not keep
    line.ports.ports[0].write_packet(bytes.fromhex("fffffd00 01 0300 08 2f4e"))
    assert line.receive() == bytes.fromhex("fffffd00 01 0400 55 00 a10c")


def test_a_place_without_an_item_is_not_read_one_beside_items_is(line2):
    assert line2.request(1, READ, b"\x0e\x00\x02\x00") == (1, StatusErrorNumber.ACCESS, b"")  # 14 and 15
    assert line2.request(1, READ, b"\x0d\x00\x02\x00") == (1, 0, b"\x02\x00")  # Protocol Type (13) and 14


def test_what_was_allowed_before_is_refused_when_a_limit_or_the_mode_changes(line2):
    line2.put(operating_mode=4, goal_position=100_000)
    line2.put(goal_position=0, operating_mode=3)
    assert line2.set("goal_position", 50_000) == StatusErrorNumber.DATA_RANGE
    line2.put(goal_position=4000, max_position_limit=2000)
    assert line2.set("goal_position", 3000) == StatusErrorNumber.DATA_LIMIT
    assert line2.set("goal_position", 1000) == 0


def test_sync_write_and_bulk_write_give_each_its_own(line2):
    line2.instruct(BROADCAST, SYNC_WRITE, bytes.fromhex("74000400 01 96000000 02 aa000000"))
    assert [line2.get("goal_position", each) for each in (1, 2)] == [150, 170]
    line2.instruct(BROADCAST, BULK_WRITE, bytes.fromhex("01 20000200 9b00 02 1f000100 46"))
    assert line2.get("max_voltage_limit", 1) == 155
    assert line2.get("temperature_limit", 2) == 70
    assert line2.statuses() == []


@pytest.mark.parametrize(
    ("option", "servo_id", "baud_rate"), [(0xFF, 1, 57_600), (0x01, 7, 57_600), (0x02, 7, 1_000_000)]
)
def test_factory_reset_keeps_what_is_asked_for(make_line2, option, servo_id, baud_rate):
    line = make_line2((7,), return_delay_ns=0)
    line.set("drive_mode", 1, 7)
    assert line.request(7, RESET, bytes((option,))) == (7, 0, b"")
    servo = line.bus.servos[0]
    assert (servo.servo_id, servo.baud_rate) == (servo_id, baud_rate)
    assert (servo.registers["drive_mode"], servo.registers["return_delay_time"]) == (0, 250)
    assert line.request(servo_id, PING) is None  # it boots, or listens at another rate


def test_reboot_loses_ram_turns_and_the_time(line2):
    line2.put(operating_mode=4, torque_enable=1, goal_position=4096 * 3 + 100)
    line2.wait(10)
    assert line2.get("present_position") == pytest.approx(4096 * 3 + 100, abs=3)  # what friction leaves
    before = line2.get("realtime_tick")
    assert line2.request(1, REBOOT) == (1, 0, b"")
    assert line2.request(1, PING) is None  # it takes its time
    line2.wait(0.2)
    assert line2.get("realtime_tick") < 300 < before
    assert line2.get("torque_enable") == 0
    assert line2.get("operating_mode") == 4
    assert line2.get("present_position") == pytest.approx(100, abs=3)
    assert not line2.servo().torque_on


def test_realtime_tick_counts_milliseconds_modulo_32768(line2):
    first = line2.get("realtime_tick")
    asked_ns = line2.clock.now_ns()
    line2.wait(1.234)
    line2.get("led")
    second = line2.get("realtime_tick")
    assert second - first == pytest.approx(1234 + 20, abs=1)  # each answer is waited for 10 ms
    line2.clock.wait_until(asked_ns + 32_768_000_000 - 10_000_000)
    assert line2.get("realtime_tick") == pytest.approx(first, abs=1)


# Protection


def test_overload_latches_until_a_reboot(line2):
    line2.set("drive_mode", 8)  # torque on by goal
    line2.set("torque_enable", 1)
    line2.servo().trigger_overload()
    answer = line2.request(1, READ, b"\x46\x00\x01\x00")
    assert answer == (1, ALERT, bytes((0x20,)))
    assert line2.get("torque_enable") == 0
    assert line2.set("torque_enable", 1) == ALERT | StatusErrorNumber.RESULT_FAIL
    line2.set("goal_position", 1000)
    assert line2.get("torque_enable") == 0
    line2.request(1, REBOOT)
    line2.wait(0.2)
    assert line2.set("torque_enable", 1) == 0
    assert line2.get("hardware_error_status") == 0


def test_an_alert_is_no_failed_transaction(line2):
    line2.servo().trigger_overload()
    assert line2.request(1, WRITE, b"\x41\x00\x01") == (1, ALERT, b"")
    assert line2.get("led") == 1


def test_every_status_has_the_alert_bit_as_long_as_an_error_lasts(make_line2):
    line = make_line2((1, 2))
    line.servo().trigger_overload()
    for instruction, parameters in (
        (PING, b""),
        (READ, b"\x84\x00\x04\x00"),
        (WRITE, b"\x41\x00\x01"),
        (REG_WRITE, b"\x41\x00\x01"),
        (ACTION, b""),
    ):
        assert line.request(1, instruction, parameters) == (1, ALERT, ANY)
    assert line.request(1, 0x07).error == ALERT | StatusErrorNumber.INSTRUCTION
    line.instruct(BROADCAST, 0x82, bytes.fromhex("84000400 0102"))
    assert [each.error for each in line.statuses()] == [ALERT, 0]
    line.instruct(BROADCAST, 0x8A, bytes.fromhex("84000400 0102"))
    fast = line.receive()
    assert (fast[8], fast[8 + 8]) == (ALERT, 0)


def test_what_shutdown_does_not_list_is_only_reported(line2):
    line2.put(shutdown=0, torque_enable=1)
    line2.servo().set_temperature(81)
    assert line2.request(1, PING).error == ALERT
    assert line2.get("hardware_error_status") == 0x04
    assert line2.get("torque_enable") == 1
    line2.servo().set_temperature(40)
    assert line2.request(1, PING).error == 0


def test_voltage_is_watched_and_shown(line2):
    line2.servo().set_voltage(9.0)
    assert line2.get("present_input_voltage") == 90
    assert line2.get("hardware_error_status") == 0x01


def test_an_xl320_orders_its_hardware_errors_otherwise(make_line2):
    line = make_line2((1,), "XL-320")
    line.servo().trigger_overload()
    assert line.get("hardware_error_status") == 1
    assert line.get("torque_enable") == 0


def test_bus_watchdog_stops_and_closes_the_goals(line2):
    line2.put(
        operating_mode=1,
        torque_enable=1,
        goal_velocity=50,
        profile_velocity=30,
        profile_acceleration=20,
        bus_watchdog=100,
    )
    line2.wait(1.9)
    assert (line2.get("profile_velocity"), line2.get("profile_acceleration")) == (30, 20)
    assert line2.get("goal_velocity") == 50
    assert line2.servo().velocity > 0
    line2.wait(2.5)
    assert line2.servo().velocity == 0
    assert line2.get("bus_watchdog") == 0xFF
    assert (line2.get("profile_velocity"), line2.get("profile_acceleration")) == (0, 0)
    assert line2.set("goal_velocity", 150) == StatusErrorNumber.DATA_RANGE
    assert line2.set("goal_position", 150) == StatusErrorNumber.DATA_RANGE
    line2.put(bus_watchdog=0, goal_velocity=150)
    line2.wait(0.5)
    assert line2.servo().velocity > 0


def test_the_watchdog_s_stop_is_at_its_time(line2):
    line2.put(operating_mode=1, torque_enable=1, goal_velocity=100)
    line2.set("bus_watchdog", 5)  # it answers within 10 ms, which are waited for
    line2.wait(0.08)
    assert line2.servo().velocity > 0.3
    line2.wait(0.2)
    stopped = line2.servo().shaft_angle
    assert line2.servo().velocity == pytest.approx(0.0, abs=1e-3)
    line2.wait(3)
    assert line2.servo().shaft_angle == pytest.approx(stopped, abs=1e-3)


def test_watchdog_does_not_count_the_time_in_which_its_process_stood_still(line2):
    line2.put(operating_mode=1, torque_enable=1, goal_velocity=100)
    line2.set("bus_watchdog", 5)  # 100 ms
    line2.wait(0.05)
    line2.bus.excuse(50_000_000)
    line2.wait(0.09)
    assert line2.servo().velocity > 0.3
    line2.wait(0.1)
    assert line2.servo().velocity == pytest.approx(0.0, abs=1e-3)


def test_a_shorter_watchdog_counts_at_once_and_a_longer_one_too(line2):
    line2.set("torque_enable", 1)
    for units, seconds, expired in ((127, 0.5, False), (5, 0.2, True)):
        assert line2.set("bus_watchdog", units) == 0
        line2.wait(seconds)
        assert (line2.get("bus_watchdog") == 0xFF) == expired
    assert line2.set("bus_watchdog", 0) == 0
    for units, seconds, expired in ((5, 0.05, False), (127, 2.4, False), (127, 2.6, True)):
        assert line2.set("bus_watchdog", units) == 0
        line2.wait(seconds)
        assert (line2.get("bus_watchdog") == 0xFF) == expired
    assert line2.get("torque_enable") == 1


def test_a_servo_at_rest_shows_at_once_what_turns_it_and_what_is_written(line2):
    line2.wait(1.0)
    resting = line2.get("present_position")
    assert line2.servo().shaft.mechanics.still, "this test is about a servo at rest"
    assert line2.get("present_position") == resting
    turn_by_hand(line2.servo(), line2.servo().shaft_angle + 0.5)
    turned = line2.get("present_position")
    assert turned == pytest.approx(resting + 0.5 / 0.001534, abs=2)
    line2.wait(1.0)
    assert line2.get("present_position") == turned
    assert line2.set("homing_offset", 100) == 0
    assert line2.get("present_position") == turned + 100
    line2.put(torque_enable=1, goal_position=turned + 400)
    line2.wait(2.0)
    assert line2.get("present_position") == pytest.approx(turned + 400, abs=20)
