"""Packets that the manual prints go in, and the packets that it prints come out, over the simulated line."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tests.kit.line_faults import turn_by_hand

TICK = math.tau / 4096


def exchange(line: Any, received: str) -> bytes:
    line.ports.ports[0].write_packet(bytes.fromhex(received))
    return line.receive(20_000_000)


@pytest.mark.parametrize(
    ("servo_id", "received", "replied"),
    [
        (1, "ff ff 01 02 01 fb", "ff ff 01 02 00 fc"),
        (1, "ff ff 01 04 02 2b 01 cc", "ff ff 01 03 00 20 db"),  # 32 degrees C
        (7, "ff ff fe 04 03 03 01 f6", ""),
        (1, "ff ff 01 05 04 1e f4 01 e2", "ff ff 01 02 00 fc"),
        (0, "ff ff 00 02 06 f7", "ff ff 00 02 00 fd"),
    ],
    ids=["ping", "read", "write to all", "reg write", "factory reset"],
)
def test_exchanges_of_protocol_1(make_line, servo_id, received, replied):
    line = make_line((servo_id,), "RX-64")
    line.servo(servo_id).set_temperature(32)
    assert exchange(line, received) == bytes.fromhex(replied)
    assert line.bus.servos[0].servo_id == 1


def test_reg_write_and_action_of_protocol_1(make_line):
    line = make_line((1,), "RX-64")
    exchange(line, "ff ff 01 05 04 1e f4 01 e2")
    assert line.servo().registers["registered"] == 1
    assert exchange(line, "ff ff fe 02 05 fa") == b""
    assert line.servo().registers["registered"] == 0
    assert line.servo().registers["goal_position"] == 500


def test_sync_write_of_protocol_1(make_line):
    line = make_line((0, 1), "RX-64")
    assert exchange(line, "ff ff fe 0e 83 1e 04 00 10 00 50 01 01 20 02 60 03 67") == b""
    goals = [(each.registers["goal_position"], each.registers["moving_speed"]) for each in line.bus.servos]
    assert goals == [(0x010, 0x150), (0x220, 0x360)]


def test_bulk_read_of_protocol_1(make_line):
    line = make_line((1, 2), "MX-28", position=0x80 * TICK)
    line.servo(1).poke("goal_position", 0x80)
    replied = exchange(line, "ff ff fe 09 92 00 02 01 1e 02 02 24 1d")
    assert replied == bytes.fromhex("ff ff 01 04 00 80 00 7a  ff ff 02 04 00 80 00 79")


def test_a_servo_that_is_listed_twice_answers_a_bulk_read_once(make_line):
    line = make_line((1, 2), "MX-28")
    line.send(0xFE, 0x92, 0, 2, 1, 30, 1, 2, 43, 2, 1, 36)  # e-Manual: "only the first [...] is processed"
    replied = line.receive(20_000_000)
    assert [replied[2], replied[8 + 2], len(replied)] == [1, 2, 8 + 7]


def turn(line: Any, positions: dict[int, int]) -> None:
    for servo_id, ticks in positions.items():
        turn_by_hand(line.servo(servo_id), ticks * TICK)


def test_sync_read_of_protocol_2(make_line2):
    line = make_line2((1, 2), "XM430-W210")
    turn(line, {1: 166, 2: 2079})
    assert exchange(line, "fffffd00 fe 0900 82 84000400 0102 cefa") == bytes.fromhex(
        "fffffd00 01 0800 55 00 a6000000 8cc0  fffffd00 02 0800 55 00 1f080000 babe"
    )


def test_sync_write_of_protocol_2(make_line2):
    line = make_line2((1, 2), "XM430-W210")
    assert exchange(line, "fffffd00 fe 1100 83 74000400 0196000000 02aa000000 8287") == b""
    assert [each.registers["goal_position"] for each in line.bus.servos] == [150, 170]


def test_bulk_read_of_protocol_2(make_line2):
    line = make_line2((1, 2), "XM430-W210")
    line.servo(1).set_voltage(11.9)
    line.servo(2).set_temperature(36)
    assert exchange(line, "fffffd00 fe 0d00 92 0190000200 0292000100 1a05") == bytes.fromhex(
        "fffffd00 01 0600 55 00 7700 c369  fffffd00 02 0500 55 00 24 8ba9"
    )


def test_bulk_write_of_protocol_2(make_line2):
    line = make_line2((1, 2), "XM430-W210")
    assert exchange(line, "fffffd00 fe 1000 93 0120000200a000 021f00010050 b768") == b""
    one, other = (each.registers for each in line.bus.servos)
    assert (one["max_voltage_limit"], other["temperature_limit"]) == (160, 80)


def test_fast_sync_read_of_protocol_2(make_line2):
    line = make_line2((3, 7, 4), "XC330-T288")
    turn(line, {3: 166, 7: 2079, 4: 1023})
    assert exchange(line, "fffffd00 fe 0a00 8a 84000400 030704 20f2") == bytes.fromhex(
        "fffffd00 fe 1900 55 00 03 a6000000 8408  00 07 1f080000 16ca  00 04 ff030000 d19e"
    )


def test_backup_and_restoring_of_protocol_2(make_line2):
    line = make_line2((1,), "XC330-T288")
    done = bytes.fromhex("fffffd00 01 0400 55 00 a10c")
    assert exchange(line, "fffffd00 01 0800 20 014354524c 16f5") == done
    assert exchange(line, "fffffd00 01 0800 20 024354524c 9ef5") == done  # printed as 92 f5, a misprint
