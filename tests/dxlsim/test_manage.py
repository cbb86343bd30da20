"""What a servo of Protocol 2.0 does beside reading and writing, and which firmware and model knows it."""

from __future__ import annotations

from typing import Any

import pytest
from tests.kit.line_faults import turn_by_hand

from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import ServoConfig
from dxlsim.wire.servo_protocol2 import StatusErrorNumber

PING, READ, WRITE, REG_WRITE, ACTION, RESET, REBOOT, CLEAR, BACKUP = 1, 2, 3, 4, 5, 6, 8, 0x10, 0x20
SYNC_READ, SYNC_WRITE, FAST_SYNC_READ = 0x82, 0x83, 0x8A
BROADCAST = 0xFE
ALERT = 0x80
CLEAR_TURNS = bytes.fromhex("01 44584c22")
CLEAR_ERROR = bytes.fromhex("02 4552434c")
BACK_UP = bytes.fromhex("01 4354524c")
RESTORE = bytes.fromhex("02 4354524c")
LED_ON = bytes.fromhex("4100 01")
UNKNOWN = (1, StatusErrorNumber.INSTRUCTION, b"")
DONE = (1, 0, b"")


def boot(line: Any) -> None:
    line.wait(0.2)


# Secondary ID: the example of the manual's page of an X servo


def test_all_obey_a_secondary_id_and_only_its_owner_answers(make_line2):
    line = make_line2((1, 2, 3, 4, 5), "XL430-W250")
    for servo_id in range(1, 6):
        assert line.set("secondary_shadow_id", 5, servo_id) == 0
    assert line.request(1, WRITE, LED_ON) == (1, 0, b"")
    assert line.request(5, WRITE, LED_ON) == (5, 0, b"")
    assert [line.get("led", each) for each in range(1, 6)] == [1] * 5
    for servo_id in range(1, 6):
        assert line.set("secondary_shadow_id", 100, servo_id) == 0
    assert line.request(100, WRITE, b"\x41\x00\x00") is None
    assert [line.get("led", each) for each in range(1, 6)] == [0] * 5


def test_nothing_is_answered_under_a_secondary_id(line2):
    line2.set("secondary_shadow_id", 100)
    assert line2.request(100, PING) is None
    assert line2.request(100, READ, b"\x84\x00\x04\x00") is None
    line2.instruct(BROADCAST, SYNC_READ, bytes.fromhex("84000400 64"))
    assert line2.statuses() == []


def test_the_eeprom_is_closed_to_a_secondary_id(line2):
    line2.set("secondary_shadow_id", 100)
    assert line2.request(100, WRITE, b"\x0a\x00\x01") is None
    assert line2.request(100, REG_WRITE, b"\x0a\x00\x01") is None
    assert line2.request(100, RESET, b"\x02") is None
    boot(line2)
    assert line2.get("drive_mode") == 0
    assert line2.get("registered_instruction") == 0
    assert line2.get("secondary_shadow_id") == 100
    assert line2.request(100, REG_WRITE, LED_ON) is None
    assert line2.request(100, ACTION) is None
    assert line2.get("led") == 1


def test_a_secondary_id_reaches_no_eeprom_behind_indirect_data(make_line2):
    line = make_line2((1,), "YM070-210-M001")  # X servos have no indirect addresses in the EEPROM
    items = line.servo().registers.table.items
    assert line.set("secondary_shadow_id", 100) == 0
    for number, name in enumerate(("led", "drive_mode"), 1):
        assert line.set(f"indirect_address_{number}", items[name].address) == 0
    assert (
        line.request(100, WRITE, items["indirect_data_1"].address.to_bytes(2, "little") + b"\x01\x01") is None
    )
    assert (line.get("led"), line.get("drive_mode")) == (0, 0)


def test_a_listed_secondary_id_is_written_to(line2):
    for servo_id in (1, 2):
        line2.set("secondary_shadow_id", 100, servo_id)
    line2.instruct(BROADCAST, SYNC_WRITE, bytes.fromhex("41000100 64 01"))
    assert [line2.get("led", each) for each in (1, 2)] == [1, 1]


@pytest.mark.parametrize("value", [253, 254, 255])
def test_a_secondary_id_above_252_is_off(line2, value):
    line2.set("secondary_shadow_id", value)
    assert line2.servo().secondary_id is None
    line2.set("secondary_shadow_id", 1)  # and so is one that is the ID
    assert line2.request(1, PING) is not None


# Changing how it is reached: the status still goes under the old one


def test_another_protocol_type_is_the_end_of_replies(line2):
    assert line2.set("protocol_type", 1) == 0
    assert line2.request(1, PING) is None
    line2.servo().poke("protocol_type", 2)
    assert line2.request(1, PING) is not None


# Clear


def far(line: Any, turns: int = 3) -> None:
    line.servo().poke("operating_mode", 4)
    turn_by_hand(line.servo(), turns * 4096 * line.servo().registers.table.rad_per_tick + 0.1)


def test_clear_brings_the_position_into_one_turn(line2):
    far(line2)
    assert line2.get("present_position") > 4096
    assert line2.request(1, CLEAR, CLEAR_TURNS) == DONE
    assert 0 <= line2.get("present_position") < 4096
    assert line2.get("goal_position") == line2.get("present_position")


def test_clear_is_refused_while_it_moves(line2):
    line2.put(torque_enable=1, goal_position=3500)
    assert line2.request(1, CLEAR, CLEAR_TURNS).error == StatusErrorNumber.RESULT_FAIL


def test_clear_came_with_firmware_42(line2):
    line2.servo().poke("firmware_version", 41)
    assert line2.request(1, CLEAR, CLEAR_TURNS) == UNKNOWN
    assert line2.request(1, CLEAR, CLEAR_ERROR) == UNKNOWN  # which only the Y series knows


@pytest.mark.parametrize(
    ("option", "firmware", "obeyed", "ids"),
    [(0x01, 45, True, [1, 2]), (0x02, 45, True, [1, 2]), (0xFF, 45, False, [1, 2]), (0xFF, 41, True, [1, 1])],
)
def test_a_reset_of_everything_is_for_all_before_firmware_42_only_and_none_is_answered(
    make_line2, option, firmware, obeyed, ids
):
    line = make_line2((1, 2))
    for servo in line.bus.servos:
        servo.poke("firmware_version", firmware)
        servo.poke("drive_mode", 1)
    line.instruct(BROADCAST, RESET, bytes((option,)))
    assert line.statuses() == []
    assert [each.registers["drive_mode"] for each in line.bus.servos] == [not obeyed] * 2
    assert [each.servo_id for each in line.bus.servos] == ids


def test_a_reboot_of_all_is_not_answered(line2):
    line2.set("led", 1)
    line2.instruct(BROADCAST, REBOOT)
    assert line2.statuses() == []
    boot(line2)
    assert line2.get("led") == 0


# Control Table Backup


def test_a_backup_holds_eeprom_gains_profile_and_indirect_addresses(make_line2):
    line = make_line2((1,), "XL330-M288")
    kept = {"drive_mode": 1, "position_p_gain": 77, "profile_velocity": 123, "indirect_address_1": 132}
    for name, value in {**kept, "led": 1, "startup_configuration": 2}.items():
        assert line.set(name, value) == 0, name
    assert line.get("backup_ready") == 0
    assert line.request(1, BACKUP, BACK_UP) == DONE
    assert line.get("backup_ready") == 1
    for name, value in {"drive_mode": 0, "position_p_gain": 5, "profile_velocity": 5}.items():
        line.set(name, value)
    assert line.request(1, BACKUP, RESTORE) == DONE
    assert line.request(1, PING) is None  # it reboots
    boot(line)
    assert {name: line.get(name) for name in kept} == kept
    assert line.get("led") == 0
    assert line.get("backup_ready") == 1


def test_restoring_brings_the_eeprom_alone_where_the_ram_is_not_asked_for(make_line2):
    line = make_line2((1,), "XL330-M288")
    line.put(profile_velocity=123, drive_mode=1)
    line.request(1, BACKUP, BACK_UP)
    line.set("drive_mode", 0)
    line.request(1, BACKUP, RESTORE)
    boot(line)
    assert (line.get("drive_mode"), line.get("profile_velocity")) == (1, 0)


def test_no_backup_with_torque_and_no_restoring_of_none(line2):
    assert line2.request(1, BACKUP, RESTORE).error == StatusErrorNumber.RESULT_FAIL
    line2.set("torque_enable", 1)
    assert line2.request(1, BACKUP, BACK_UP).error == StatusErrorNumber.RESULT_FAIL


@pytest.mark.parametrize(
    ("model", "firmware", "backs_up", "reads_fast"),
    [
        ("XM430-W350", 44, False, False),
        ("XM430-W350", 45, True, True),
        ("XL330-M288", 45, False, False),
        ("XL330-M288", 46, True, True),
        ("XL330-M288", 52, True, True),
        ("PH54-200-S500", 11, False, False),
        ("PH54-200-S500", 12, True, True),
        ("2XL430-W250", 44, False, False),
        ("2XL430-W250", 45, True, False),
        ("MX-64", 45, False, False),
        ("XL-320", 45, False, False),
    ],
)
def test_backup_and_fast_reads_came_with_a_firmware(make_line2, model, firmware, backs_up, reads_fast):
    line = make_line2((1,), model, firmware=firmware)
    assert line.request(1, BACKUP, BACK_UP) == (DONE if backs_up else UNKNOWN)
    line.instruct(BROADCAST, FAST_SYNC_READ, bytes.fromhex("0000 0200 01"))
    assert bool(line.receive()) == reads_fast


@pytest.mark.parametrize(
    ("model", "firmware"), [("XM430-W350", 44), ("2XC430-W250", 44), ("XC330-T288", 45), ("MX-106", 60)]
)
def test_startup_configuration_came_with_a_firmware(make_line2, model, firmware):
    line = make_line2((1,), model, firmware=firmware)
    assert "startup_configuration" not in line.servo().registers
    assert line.write_bytes(1, 60, b"\x01") == StatusErrorNumber.ACCESS
    line.servo().power_cycle()
    assert line.get("torque_enable") == 0


@pytest.mark.parametrize(
    "model", ["XL430-W250", "2XC430-W250", "XM430-W350", "XD540-T270", "XW540-T260", "XL330-M288-FW51"]
)
def test_at_power_up_the_backup_comes_back_and_the_torque_on(make_line2, model):
    line = make_line2((1,), model)
    line.put(startup_configuration=3, position_p_gain=77)
    assert line.request(1, BACKUP, BACK_UP) == DONE
    line.set("position_p_gain", 5)
    line.servo().power_cycle()
    assert (line.get("position_p_gain"), line.get("torque_enable"), line.get("backup_ready")) == (77, 1, 1)
    line.servo().poke("startup_configuration", 0)
    line.servo().power_cycle()
    assert line.get("position_p_gain") == line.servo().registers.table.items["position_p_gain"].initial
    assert line.get("torque_enable") == 0


@pytest.mark.parametrize(
    ("firmware", "model"), [(51, "XL330-M288-FW51"), (52, "XL330-M288"), (None, "XL330-M288")]
)
def test_the_firmware_decides_the_control_table(firmware, model):
    servo = make_servo(ServoConfig(1, "XL330-M288", 0.0, firmware=firmware), 57_600, 0, protocol=2.0)
    assert servo.registers.table.model == model
    assert servo.registers["firmware_version"] == (firmware or 52)


# Operating modes


def test_another_operating_mode_resets_what_the_manual_lists(line2):
    changes = {"position_p_gain": 5, "velocity_i_gain": 6, "profile_velocity": 7, "profile_acceleration": 8}
    for name, value in {**changes, "goal_pwm": 100, "goal_current": 100}.items():
        assert line2.set(name, value) == 0
    assert line2.set("operating_mode", 5) == 0
    table = line2.servo().registers.table
    assert {name: line2.get(name) for name in changes} == {
        name: table.items[name].initial for name in changes
    }
    assert line2.get("goal_pwm") == line2.get("pwm_limit")
    assert line2.get("goal_current") == line2.get("current_limit")


@pytest.mark.parametrize(("mode", "goal"), [(0, "goal_current"), (16, "goal_pwm")])
def test_the_goal_that_a_mode_obeys_begins_at_0(line2, mode, goal):
    line2.set("operating_mode", mode)
    assert line2.get(goal) == 0


def test_a_lower_limit_takes_the_goal_with_it(line2):
    assert line2.get("goal_pwm") == 885
    line2.set("pwm_limit", 400)
    assert line2.get("goal_pwm") == 400


def test_switching_the_torque_on_brings_a_position_into_one_turn(line2):
    turn_by_hand(line2.servo(), 2 * 6.283185307 + 1.0)
    assert line2.get("present_position") > 2 * 4096
    line2.set("torque_enable", 1)
    assert line2.get("present_position") < 4096
    line2.put(torque_enable=0, operating_mode=4)
    turn_by_hand(line2.servo(), 2 * 6.283185307 + 1.0)
    line2.set("torque_enable", 1)
    assert line2.get("present_position") > 2 * 4096 - 100  # many turns are what this mode is for


# The Y series


def test_a_y_servo_keeps_its_turns_until_it_clears_them_without_torque(make_line2):
    line = make_line2((1,), "YM070-210-M001")
    turn = round(6.283185307 / line.servo().registers.table.rad_per_tick)
    turn_by_hand(line.servo(), 3 * 6.283185307 + 0.5)
    line.servo().power_cycle()
    assert line.get("present_position") > 3 * turn
    line.servo().poke("torque_enable", 1)
    assert line.request(1, CLEAR, CLEAR_TURNS).error == StatusErrorNumber.RESULT_FAIL
    line.servo().poke("torque_enable", 0)
    assert line.request(1, CLEAR, CLEAR_TURNS) == DONE
    assert line.request(1, PING) is None  # it reboots
    boot(line)
    assert 0 <= line.get("present_position") < turn


def test_goals_of_a_y_servo_go_as_far_as_its_position_limits(make_line2):
    line = make_line2((1,), "YM070-210-M001")
    line.set("max_position_limit", 2_000_000)  # nearly four turns
    assert line.set("goal_position", 2_000_000) == 0
    assert line.set("goal_position", 2_000_001) == StatusErrorNumber.DATA_LIMIT


def test_a_y_servo_reports_errors_by_code_and_forgets_them_when_they_are_over(make_line2):
    line = make_line2((1,), "YM070-210-M001")
    line.set("torque_enable", 1)
    assert line.get("controller_state") == 5
    line.servo().set_temperature(90)
    assert line.request(1, PING).error == ALERT
    assert (line.get("error_code"), line.get("error_code_history_1")) == (4, 4)
    assert (line.get("torque_enable"), line.get("controller_state")) == (0, 8)
    assert line.set("torque_enable", 1) == ALERT | StatusErrorNumber.RESULT_FAIL
    assert line.request(1, CLEAR, CLEAR_ERROR).error & 0x7F == StatusErrorNumber.RESULT_FAIL
    line.servo().set_temperature(30)
    assert line.request(1, PING).error == ALERT  # it stays until it is cleared
    assert line.request(1, CLEAR, CLEAR_ERROR) == DONE
    assert (line.get("error_code"), line.get("error_code_history_1"), line.get("controller_state")) == (
        0,
        0,
        2,
    )
    assert line.set("torque_enable", 1) == 0
    line.servo().set_voltage(10.0)
    line.servo().set_voltage(50.0)
    assert [line.get(f"error_code_history_{each}") for each in (1, 2)] == [2, 1]


# Registered instructions


def test_a_newer_registered_write_takes_the_place_of_the_older(line2):
    assert line2.request(1, REG_WRITE, b"\x70\x00\x05\x00\x00\x00") == DONE
    assert line2.request(1, REG_WRITE, LED_ON) == DONE
    assert (
        line2.request(1, REG_WRITE, b"\x40\x00\x02").error == StatusErrorNumber.DATA_RANGE
    )  # and not this one
    assert line2.request(1, ACTION) == DONE
    assert (line2.get("led"), line2.get("profile_velocity")) == (1, 0)
    assert line2.request(1, ACTION) == UNKNOWN


def test_a_registered_write_is_checked_again_when_it_acts(line2):
    assert line2.request(1, REG_WRITE, b"\x0a\x00\x01") == DONE
    line2.set("torque_enable", 1)
    assert line2.request(1, ACTION).error == StatusErrorNumber.ACCESS
    assert line2.get("drive_mode") == 0


def test_a_reboot_forgets_a_registered_write(line2):
    line2.request(1, REG_WRITE, LED_ON)
    line2.request(1, REBOOT)
    boot(line2)
    assert line2.get("registered_instruction") == 0
    assert line2.request(1, ACTION) == UNKNOWN


# Indirect addresses


def test_a_sync_read_goes_through_indirect_data(line2):
    for servo_id in (1, 2):
        for index in range(4):
            assert line2.set(f"indirect_address_{index + 1}", 132 + index, servo_id) == 0
    line2.instruct(BROADCAST, SYNC_READ, bytes.fromhex("e000 0400 0102"))
    replied = line2.statuses()
    assert [int.from_bytes(each.parameters, "little") for each in replied] == [
        line2.get("present_position", each) for each in (1, 2)
    ]


def test_indirect_addresses_are_of_the_ram_only_and_lost_with_it(line2):
    assert line2.set("indirect_address_1", 63) == StatusErrorNumber.DATA_RANGE
    assert line2.set("indirect_address_1", 662) == StatusErrorNumber.DATA_RANGE
    assert line2.set("indirect_address_56", 65) == 0
    line2.request(1, REBOOT)
    boot(line2)
    assert line2.get("indirect_address_56") == 661
    assert line2.set("torque_enable", 1) == 0
    assert line2.set("indirect_address_1", 65) == 0  # they are no EEPROM


def test_indirect_addresses_of_p_are_eeprom(make_line2):
    line = make_line2((1,), "PH54-200-S500")
    assert line.set("indirect_address_1", 513) == 0
    line.request(1, REBOOT)
    boot(line)
    assert line.get("indirect_address_1") == 513
    line.set("torque_enable", 1)
    assert line.set("indirect_address_1", 514) == StatusErrorNumber.ACCESS


def test_indirect_data_is_read_and_written_through(line2):
    for index, address in enumerate((132, 133, 134, 135, 65)):
        assert line2.set(f"indirect_address_{index + 1}", address) == 0
    position, led = line2.read_bytes(1, 132, 4), b"\x00"
    assert line2.read_bytes(1, 224, 5) == position + led
    assert line2.write_bytes(1, 228, b"\x01") == 0
    assert line2.get("led") == 1
    assert line2.write_bytes(1, 224, b"\x00") == StatusErrorNumber.ACCESS  # present position is read-only


def test_a_goal_may_go_through_indirect_data(line2):
    line2.set("torque_enable", 1)
    for index in range(4):
        line2.set(f"indirect_address_{index + 1}", 116 + index)
    assert line2.write_bytes(1, 224, (3000).to_bytes(4, "little")) == 0
    line2.wait(2)
    assert line2.get("present_position") == pytest.approx(3000, abs=3)  # what friction leaves
    assert line2.write_bytes(1, 224, b"\x00\x00") == StatusErrorNumber.DATA_LENGTH
