"""What servos of both protocols do alike: which answer, registered writes, another ID or rate."""

from __future__ import annotations

import pytest
from tests.kit.packets import packet1, packet2

from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import ServoConfig

PING, READ, WRITE, REG_WRITE, ACTION, RESET, CLEAR = 1, 2, 3, 4, 5, 6, 0x10
SYNC_WRITE, BULK_READ, BULK_WRITE = 0x83, 0x92, 0x93
BROADCAST = 0xFE
ERROR = {
    1: {"unknown": 0x40, "cells": 0x08, "read-only": 0x08, "range": 0x08, "damaged": 0x10},
    2: {"unknown": 2, "cells": 7, "read-only": 7, "range": 4, "length": 5, "damaged": 3},
}
"""By bytes of an address: e-Manual, Protocol 1.0 and 2.0, section "Error"."""


def test_an_id_that_is_not_there_gets_no_reply(both):
    assert both.request(9, PING) is None


@pytest.mark.parametrize(
    ("level", "ping", "read", "write"),
    [(0, True, False, False), (1, True, True, False), (2, True, True, True)],
)
def test_status_return_level(both, level, ping, read, write):
    both.request(1, WRITE, both.at("status_return_level", level))
    assert (both.request(1, PING) is not None) == ping
    assert (both.request(1, READ, both.at("present_position")) is not None) == read
    assert (both.request(1, WRITE, both.at("led", 1)) is not None) == write
    assert both.servo().registers["led"] == 1


WRONG = [
    (1, 0x07, "", "unknown"),
    (1, BULK_READ, "00 02 01 1e", "unknown"),  # not to all, and an AX
    (1, READ, "24", "unknown"),
    (1, WRITE, "1e", "unknown"),
    (1, ACTION, "", "unknown"),
    (1, SYNC_WRITE, "1e 01 01 05", "unknown"),  # not to all
    (1, READ, "31 02", "cells"),
    (1, READ, "00 00", "cells"),
    (1, READ, "ff ff", "cells"),
    (1, WRITE, "24 00 02", "read-only"),  # the position
    (1, WRITE, "00 0d 00", "read-only"),  # the model number
    (1, WRITE, "22 00 01 00 02", "read-only"),  # good torque limit, then the position
    (1, REG_WRITE, "24 01 01", "read-only"),
    (1, WRITE, "18 02", "range"),
    (1, WRITE, "05 ff", "range"),
    (1, WRITE, "1e 00 04", "range"),  # goal 1024
    (1, WRITE, "20 00 08", "range"),
    (1, WRITE, "31 00 00", "cells"),
    (1, WRITE, "0a 00", "cells"),  # no item has this cell
    (2, 0x07, "", "unknown"),
    (2, READ, "8400 04", "unknown"),
    (2, WRITE, "4000", "unknown"),
    (2, ACTION, "", "unknown"),
    (2, RESET, "03", "unknown"),
    (2, CLEAR, "01 44584c23", "unknown"),
    (2, SYNC_WRITE, "4100 0100 01 01", "unknown"),  # not to all
    (2, READ, "0003 0100", "cells"),
    (2, READ, "8400 0000", "cells"),
    (2, WRITE, "0f00 01", "cells"),
    (2, WRITE, "4100 010000", "cells"),  # LED, then cells of no item
    (2, WRITE, "8400 00000000", "read-only"),
    (2, WRITE, "4000 02", "range"),
    (2, WRITE, "7400 00100000", "range"),  # goal 4096
    (2, WRITE, "7400 0000", "length"),
    (2, WRITE, "7500 000000", "length"),
]


@pytest.mark.parametrize(("word", "instruction", "parameters", "error"), WRONG)
def test_what_is_wrong_is_refused_whole_with_the_manual_s_error(
    line_of, word, instruction, parameters, error
):
    line = line_of(word)
    registers = line.servo().registers
    before = registers.read_bytes(0, registers.size - 30)
    assert line.request(1, instruction, bytes.fromhex(parameters)) == (1, ERROR[word][error], b"")
    assert registers.read_bytes(0, registers.size - 30) == before
    assert any("refuses" in note for note in line.notes())
    if instruction == REG_WRITE:
        assert line.request(1, ACTION) == (1, ERROR[word]["unknown"], b"")


@pytest.mark.parametrize("answers", [False, True])
def test_a_damaged_instruction_is_not_obeyed(both, answers):
    both.servo().answers_damaged = answers
    led_on = "ff ff 01 04 03 19 01 00" if both.WORD == 1 else "fffffd00 01 0600 03 410001 0000"
    both.ports.ports[0].write_packet(bytes.fromhex(led_on))
    received = both.receive()
    at = 4 if both.WORD == 1 else 8
    assert received[at : at + 1] == bytes([ERROR[both.WORD]["damaged"]] * answers)
    assert both.servo().registers["led"] == 0
    assert any("CHECKSUM" in note or "CRC" in note for note in both.notes())


@pytest.mark.parametrize(
    ("word", "instruction", "parameters"),
    [
        (1, SYNC_WRITE, "19 01 01 01 02"),
        (2, SYNC_WRITE, "4100 0100 01 01 02"),
        (2, SYNC_WRITE, "4100 0000 01"),
        (2, BULK_WRITE, "01 4100 0100 01 02 4100 0100"),
        (2, BULK_WRITE, "01 4100"),
    ],
)
def test_a_list_of_writes_of_a_wrong_length_changes_nothing(line_of, word, instruction, parameters):
    line = line_of(word)
    assert line.request(BROADCAST, instruction, bytes.fromhex(parameters)) is None
    assert line.servo().registers["led"] == 0
    assert any("INSTRUCTION" in note for note in line.notes())


def test_a_pause_inside_an_instruction_ends_it(both):
    ping, most_ns = (packet1(1, 1), 100_000_000) if both.WORD == 1 else (packet2(1, 1), 1_500_000)
    at_ns = 0
    for pause_ns, answered in ((most_ns, True), (most_ns + 1, False)):
        both.bus.receive_bytes(ping[:3], at_ns)
        both.bus.receive_bytes(ping[3:], at_ns + 30_000 + pause_ns)
        at_ns += 10**9
        assert (both.bus.drain_bytes(at_ns) != b"") == answered
    assert both.notes() == ["incomplete instruction of 3 bytes discarded"]


def test_reg_write_waits_for_action(both):
    registered = "registered" if both.WORD == 1 else "registered_instruction"
    for servo_id in (1, 2):
        assert both.request(servo_id, REG_WRITE, both.at("led", 1)) == (servo_id, 0, b"")
        assert (both.get(registered, servo_id), both.get("led", servo_id)) == (1, 0)
    assert both.request(BROADCAST, ACTION) is None
    for servo_id in (1, 2):
        assert (both.get(registered, servo_id), both.get("led", servo_id)) == (0, 1)


def test_a_new_id_counts_from_the_next_instruction(both):
    assert both.request(1, WRITE, both.at("id", 9)) == (1, 0, b"")
    assert both.request(1, PING) is None
    assert both.request(9, PING) is not None


def test_a_new_baud_rate_counts_from_the_next_instruction(both):
    value, rate = (9, 200_000) if both.WORD == 1 else (4, 2_000_000)
    assert both.request(1, WRITE, both.at("baud_rate", value)) == (1, 0, b"")
    assert both.request(1, PING) is None
    both.bus.baud_rate = rate
    assert both.request(1, PING) is not None
    assert both.request(2, PING) is None


@pytest.mark.parametrize(
    ("model", "protocol", "rate", "value"),
    [
        ("AX-12A", 1.0, 1_000_000, 1),
        ("AX-12A", 1.0, 57_600, 34),
        ("AX-12A", 1.0, 117_647, 16),  # by the formula 2,000,000 / (value + 1)
        ("AX-12A", 1.0, 2_000_000, 0),
        ("XM430-W350", 2.0, 9_600, 0),
        ("XM430-W350", 2.0, 57_600, 1),
        ("XM430-W350", 2.0, 1_000_000, 3),
        ("XM430-W350", 2.0, 4_500_000, 7),
    ],
)
def test_baud_rate_register_follows_the_line(model, protocol, rate, value):
    servo = make_servo(ServoConfig(1, model, 0.0), rate, 0, protocol=protocol)
    assert servo.registers["baud_rate"] == value
    assert servo.baud_rate == pytest.approx(rate, rel=0.03)


@pytest.mark.parametrize(("model", "protocol", "rate"), [("AX-12A", 1.0, 5000), ("XM430-W350", 2.0, 500_000)])
def test_a_baud_rate_that_no_servo_has_is_refused(model, protocol, rate):
    with pytest.raises(ValueError, match=f"no baud rate near {rate}"):
        make_servo(ServoConfig(1, model, 0.0), rate, 0, protocol=protocol)
