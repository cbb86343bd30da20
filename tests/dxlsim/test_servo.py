from __future__ import annotations

import math

import pytest
from tests.kit.line_faults import turn_by_hand

from dxlsim.registers.memory import Memory
from dxlsim.wire.servo_protocol1 import ErrorBit
from dxlwire.control_table import find_table

PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, SYNC_WRITE, BULK_READ = 1, 2, 3, 4, 5, 6, 0x83, 0x92
BROADCAST = 0xFE
TICK = math.radians(300) / 1023


def low_high(value: int) -> tuple[int, int]:
    return value & 0xFF, value >> 8


def test_model_number_and_initial_values_of_the_manual(line):
    answer = line.ask(1, READ, 0, 19)
    # e-Manual, AX-12A, Control Table of EEPROM Area; addresses 2 and 10 are not given there
    expected = bytes.fromhex("0c00 00 01 01 fa 0000 ff03 00 46 3c 8c ff03 02 24 24")
    assert answer.parameters[3:10] + answer.parameters[11:] == expected[3:10] + expected[11:]
    assert answer.parameters[:2] == expected[:2]


def test_broadcasts_are_obeyed_and_never_answered(line):
    line.send(BROADCAST, WRITE, 25, 1)
    line.send(BROADCAST, SYNC_WRITE, 26, 2, 1, 7, 8, 2, 9, 10)
    line.ports.ports[0].write_packet(bytes.fromhex("ff ff fe 04 03 19 01 00"))  # wrong checksum
    line.send(BROADCAST, BULK_READ, 0, 2, 1, 30, 2, 2, 36)
    line.send(BROADCAST, READ, 36, 2)
    assert line.receive() == b""
    assert [line.servo(each).registers["led"] for each in (1, 2)] == [1, 1]
    assert line.read(1, 26, 2) == 7 | 8 << 8
    assert line.read(2, 26, 2) == 9 | 10 << 8


def test_a_lone_servo_answers_a_broadcast_ping(make_line):
    assert make_line(ids=(7,)).ask(BROADCAST, PING) == (7, 0, b"")


def test_two_servos_collide_on_a_broadcast_ping(line):
    line.send(BROADCAST, PING)
    assert line.receive() == bytes.fromhex("ff ff 00 02 00 f8")  # ID 1 & 2, checksums fc & fb: no packet
    assert any("collision" in note for note in line.notes())


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_broadcast_is_answered_at_no_status_return_level(line, level):
    line.send(BROADCAST, WRITE, 16, level)
    for instruction, parameters in ((READ, (36, 2)), (WRITE, (25, 1)), (REG_WRITE, (25, 0)), (ACTION, ())):
        line.send(BROADCAST, instruction, *parameters)
    assert line.receive() == b""
    assert line.servo().registers["led"] == 0


def test_lock_holds_until_the_power_is_cut(line):
    assert line.write(1, 47, 1) == 0
    assert line.write(1, 5, 100) == ErrorBit.RANGE
    assert line.write(1, 47, 0) == ErrorBit.RANGE
    assert line.write(1, 25, 1) == 0  # RAM is free
    line.servo().power_cycle()
    assert line.write(1, 5, 100) == 0


def test_power_cycle_keeps_eeprom_and_loses_ram(line):
    line.write(1, 14, *low_high(512))
    line.write(1, 5, 10)
    line.write(1, 24, 1, 1)
    line.servo().power_cycle()
    assert line.read(1, 24, 2) == 0
    assert line.read(1, 5, 1) == 10
    assert line.read(1, 34, 2) == 512  # e-Manual: Torque Limit starts as Max Torque
    assert line.read(1, 30, 2) == line.read(1, 36, 2)


def test_factory_reset_gives_id_1_back(make_line):
    line = make_line(ids=(7,))
    line.write(7, 5, 0)
    assert line.ask(7, FACTORY_RESET) == (7, 0, b"")
    assert line.ask(7, PING) is None
    assert line.read(1, 5, 1) == 250


def test_return_delay_is_that_of_its_register(line):
    line.write(1, 5, 100)
    line.receive()
    start = line.clock.now_ns()
    line.send(1, PING)
    line.ports.wait_for_bytes(start + 10_000_000)
    assert line.clock.now_ns() - start == 60_000 + 200_000 + 60_000


# Motion


def test_a_limp_servo_has_no_torque_and_stays(line):
    assert line.read(1, 24, 1) == 0
    line.clock.wait_until(2_000_000_000)
    assert line.servo().shaft_angle == 2.0
    assert not line.servo().torque_on


def test_a_goal_wakes_a_limp_servo_and_it_goes_there(line):
    line.write(1, 30, *low_high(700))
    assert line.read(1, 24, 1) == 1
    assert line.read(1, 46, 1) == 1
    line.clock.wait_until(2_000_000_000)
    assert line.read(1, 36, 2) == pytest.approx(700, abs=2)
    assert line.servo().shaft_angle == pytest.approx(700 * TICK, abs=2 * TICK)
    assert line.read(1, 46, 1) == 0
    assert line.read(1, 38, 4) == 0  # speed and load


def test_waking_by_a_goal_can_be_switched_off(line):
    line.servo().wakes_on_goal = False
    line.write(1, 30, *low_high(700))
    line.clock.wait_until(2_000_000_000)
    assert line.read(1, 24, 1) == 0
    assert line.servo().shaft_angle == 2.0
    line.write(1, 24, 1)  # and then it moves to the goal that is there
    line.clock.wait_until(4_000_000_000)
    assert line.read(1, 36, 2) == pytest.approx(700, abs=2)


@pytest.mark.parametrize("model", ["AX-12A", "RX-28", "MX-28"])
def test_a_sync_write_with_the_direction_bit_of_the_speed_moves_a_joint(make_line, model):
    # pypot does so with `orientation: indirect`: goal position and moving speed in one row, bit 10 set
    line = make_line((1, 2), model, position=2.0)
    start = line.servo(1).shaft_angle
    line.send(0xFE, 0x83, 30, 4, 1, *low_high(700), *low_high(1024 + 100), 2, *low_high(700), *low_high(100))
    assert line.receive() == b""
    for servo_id in (1, 2):
        assert line.read(servo_id, 30, 2) == 700
    line.clock.wait_until(line.clock.now_ns() + 200_000_000)
    unit = line.servo(1).registers.table.rad_s_per_tick
    assert abs(line.servo(1).velocity) == pytest.approx(100 * unit, rel=0.1)  # still coming to its speed
    assert line.servo(1).velocity == pytest.approx(line.servo(2).velocity)
    assert line.servo(1).shaft_angle != start
    assert not [note for note in line.notes() if "refuse" in note]


def test_clockwise_speed_has_bit_10(line):
    line.write(1, 30, *low_high(0), *low_high(50))
    line.clock.wait_until(line.clock.now_ns() + 600_000_000)
    assert line.read(1, 38, 2) == 50 | 1 << 10


def test_torque_off_in_the_middle_stops_it_there(line):
    line.write(1, 30, *low_high(1023), *low_high(100))
    line.clock.wait_until(500_000_000)
    line.write(1, 24, 0)
    stopped = line.servo().shaft_angle
    assert 2.0 < stopped < 1023 * TICK
    line.clock.wait_until(3_000_000_000)
    assert line.servo().shaft_angle == pytest.approx(stopped, abs=0.1)  # it comes to rest by itself
    assert line.servo().velocity == 0.0


def test_wheel_mode_turns_by_output_and_zero_stops(line):
    line.write(1, 6, 0, 0, 0, 0)
    line.write(1, 24, 1)
    line.write(1, 32, *low_high(1024 + 512))
    line.clock.wait_until(1_000_000_000)
    full = 59 * 2 * math.pi / 60
    # friction takes 1.6 % of the duty, and 12 % more by its own load, at every speed
    assert line.servo().velocity == pytest.approx(-full * (512 / 1023 - 0.018) / (1 - 0.018), rel=1e-3)
    assert line.read(1, 38, 2) == 1024 + 503
    assert line.read(1, 46, 1) == 1
    line.write(1, 32, 0, 0)
    line.clock.wait_until(2_000_000_000)
    assert line.servo().velocity == 0.0


def test_position_of_a_wheel_stays_in_its_range(line):
    line.write(1, 6, 0, 0, 0, 0)
    line.write(1, 24, 1)
    line.write(1, 32, *low_high(1023))
    seen = set()
    for _ in range(200):
        seen.add(line.read(1, 36, 2))
    assert max(seen) == 1023
    assert min(seen) == 0
    assert len(seen) > 50


# Protection


def test_every_error_of_a_servo_that_is_listed_twice_counts(line):
    line.put(cw_angle_limit=300, shutdown=ErrorBit.ANGLE_LIMIT)
    line.send(BROADCAST, SYNC_WRITE, 30, 2, 1, *low_high(0), 1, *low_high(500))
    assert line.receive() == b""
    assert (line.get("goal_position"), line.get("torque_limit")) == (500, 0)


def test_overload_takes_the_torque_until_the_limit_is_written(line):
    line.write(1, 30, *low_high(700))
    line.receive()
    line.servo().trigger_overload()
    assert line.ask(1, READ, 24, 1) == (1, ErrorBit.OVERLOAD, b"\x01")  # torque enable stays
    assert line.read(1, 34, 2) == 0
    assert not line.servo().torque_on
    stopped = line.servo().shaft_angle
    line.clock.wait_until(3_000_000_000)
    assert line.servo().shaft_angle == pytest.approx(stopped, abs=0.1)
    assert line.write(1, 34, *low_high(1023)) == 0
    line.clock.wait_until(6_000_000_000)
    assert line.read(1, 36, 2) == pytest.approx(700, abs=2)


def test_heat_is_an_error_and_shuts_down(line):
    line.servo().set_temperature(71)
    assert line.ask(1, READ, 43, 1) == (1, ErrorBit.OVERHEATING, bytes((71,)))
    assert line.read(1, 34, 2) == 0
    line.servo().set_temperature(40)
    assert line.ask(1, PING) == (1, 0, b"")


def test_low_voltage_is_an_error_that_does_not_shut_down(line):
    line.servo().set_voltage(5.9)
    assert line.ask(1, READ, 42, 1) == (1, ErrorBit.VOLTAGE, bytes((59,)))
    assert line.read(1, 34, 2) == 1023  # Shutdown (18) is 36: overload and overheating


def test_shutdown_lists_what_takes_the_torque(line):
    line.write(1, 18, ErrorBit.ANGLE_LIMIT)
    line.write(1, 6, *low_high(300), *low_high(700))
    assert line.write(1, 30, *low_high(0)) == ErrorBit.ANGLE_LIMIT
    assert line.read(1, 34, 2) == 0


def test_a_cut_data_line_silences_but_does_not_stop(line):
    line.write(1, 30, *low_high(1023))
    line.servo().silence()
    assert line.ask(1, PING) is None
    line.send(BROADCAST, WRITE, 24, 0)
    line.clock.wait_until(3_000_000_000)
    assert line.servo().shaft_angle == pytest.approx(1023 * TICK, abs=2 * TICK)
    line.servo().silence(False)
    assert line.read(1, 24, 1) == 1


def test_values_and_bytes_of_the_registers_never_differ():
    table = find_table("AX-12A")
    registers = Memory(table, 24)
    for run in registers.runs(26, bytes((5, 6, 7, 8, 0x23, 0x01))):
        registers.write_run(run)
    registers["moving_speed"] = 77
    for item in table.items.values():
        data = registers.read_bytes(item.address, item.size)
        assert data is not None
        assert int.from_bytes(data, "little") == registers[item.name]
    assert registers["goal_position"] == 0x123


# What the MX have beside an AX


def test_goals_of_multi_turn_mode_count_turns(make_line):
    line = make_line((1,), "MX-28")
    assert line.write(1, 6, *low_high(4095), *low_high(4095)) == 0
    goals = (28_672, 28_673, -28_672 & 0xFFFF, -28_673 & 0xFFFF)
    errors = [line.write(1, 30, *low_high(goal)) for goal in goals]
    assert errors == [0, ErrorBit.RANGE, 0, ErrorBit.RANGE]
    assert line.read(1, 30, 2) == goals[2]
    turn_by_hand(line.servo(), -3.0)
    assert line.read(1, 36, 2) == pytest.approx((1 << 16) - 3.0 / math.tau * 4096, abs=2)


def test_goal_torque_cannot_be_bigger_than_torque_limit(make_line):
    line = make_line((1,), "MX-64")
    assert line.write(1, 34, *low_high(500)) == 0
    errors = [line.write(1, 71, *low_high(torque)) for torque in (500, 501, 1024 + 500, 1024 + 501)]
    assert errors == [0, ErrorBit.RANGE, 0, ErrorBit.RANGE]


def test_an_mx_counts_milliseconds_from_its_power_up(make_line):
    line = make_line((1,), "MX-28")
    first = line.read(1, 50, 2)
    line.clock.wait_until(line.clock.now_ns() + 2_000_000_000)
    assert line.read(1, 50, 2) - first == pytest.approx(2010, abs=1)
    line.servo().power_cycle()
    assert line.read(1, 50, 2) < 10
    line.clock.wait_until(line.clock.now_ns() + 32_768_000_000)
    assert line.read(1, 50, 2) < 50
