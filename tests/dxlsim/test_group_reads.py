"""Reads that several servos answer one after the other, in both protocols."""

from __future__ import annotations

from typing import Any

import pytest
from tests.kit.line_faults import truncate_next

SYNC_READ, FAST_SYNC_READ, BULK_READ, FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A
BROADCAST = 0xFE
POSITION = bytes.fromhex("84000400")


def positions(line: Any, *ids: int) -> dict[int, bytes]:
    return {each: line.servo(each).registers.data("present_position") for each in ids}


# Protocol 2.0


@pytest.mark.parametrize("ids", [(1, 2, 3), (3, 1, 2), (2,)])
def test_sync_read_answers_in_the_order_of_its_list(make_line2, ids):
    line = make_line2((1, 2, 3))
    line.instruct(BROADCAST, SYNC_READ, POSITION + bytes(ids))
    data = positions(line, *ids)
    assert line.statuses() == [(each, 0, data[each]) for each in ids]


def test_a_servo_waits_for_the_one_before_it(make_line2):
    line = make_line2((1, 2), return_delay_ns=100_000)
    start = line.clock.now_ns()
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02")
    line.receive()
    instruction, status = 16 * 10_000, 15 * 10_000
    times = [entry.t_ns - start for entry in line.ledger.entries if entry.direction == "out"]
    assert times == [instruction + 100_000 + status, instruction + 2 * (100_000 + status)]


def test_after_an_absent_servo_no_servo_replies(make_line2):
    line = make_line2((1, 3))
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02\x03")
    assert [each.servo_id for each in line.statuses()] == [1]
    assert any("servo 2 does not reply" in note for note in line.notes())


def test_or_they_wait_for_its_time(make_line2):
    line = make_line2((1, 3))
    line.bus.absent = "slot"
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02\x03")
    assert [each.servo_id for each in line.statuses()] == [1, 3]


def test_a_cut_data_line_and_a_low_return_level_are_as_absent(make_line2):
    line = make_line2((1, 2, 3))
    line.bus.absent = "slot"
    line.servo(1).silence()
    line.servo(2).poke("status_return_level", 0)
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02\x03")
    assert [each.servo_id for each in line.statuses()] == [3]


def test_an_error_has_no_data_and_does_not_break_the_chain(line2):
    line2.instruct(BROADCAST, SYNC_READ, bytes.fromhex("00100400 0102"))
    assert line2.statuses() == [(1, 7, b""), (2, 7, b"")]


@pytest.mark.parametrize(
    ("instruction", "parameters"),
    [(FAST_SYNC_READ, POSITION + b"\x02\x01"), (FAST_BULK_READ, bytes.fromhex("0284000400 0184000400"))],
)
def test_fast_reads_share_one_status(line2, instruction, parameters):
    line2.instruct(BROADCAST, instruction, parameters)
    data = positions(line2, 1, 2)
    received = line2.receive()
    assert received[:8] == bytes.fromhex("fffffd00 fe 1100 55")
    assert received[8:14] == b"\x00\x02" + data[2]
    assert received[16:22] == b"\x00\x01" + data[1]
    assert len(received) == 7 + 17


@pytest.mark.parametrize("slow", [(), (1,), (2,), (1, 2)])
def test_a_fast_read_has_one_return_delay_and_waits_for_each_slow_servo(make_line2, slow):
    line = make_line2((1, 2), return_delay_ns=100_000)
    for servo_id in slow:
        line.servo(servo_id).reply_later(300_000)
    start = line.clock.now_ns()
    line.instruct(BROADCAST, FAST_SYNC_READ, POSITION + b"\x01\x02")
    line.receive()
    assert max(entry.t_ns for entry in line.ledger.entries) - start == (
        16 + 24
    ) * 10_000 + 100_000 + 300_000 * len(slow)


def test_a_fast_read_stays_short_where_a_servo_is_absent(make_line2):
    line = make_line2((1, 3))
    line.instruct(BROADCAST, FAST_SYNC_READ, POSITION + b"\x01\x02\x03")
    received = line.receive()
    assert len(received) == 8 + 8
    assert int.from_bytes(received[5:7], "little") == 1 + 3 * 8


@pytest.mark.parametrize(("firmware", "answers"), [(44, False), (45, True), (46, True)])
def test_fast_reads_need_a_firmware(make_line2, firmware, answers):
    line = make_line2((1,))
    line.servo(1).poke("firmware_version", firmware)
    line.instruct(BROADCAST, FAST_SYNC_READ, POSITION + b"\x01")
    assert (line.receive() != b"") == answers


def test_a_fast_read_of_no_item_is_not_answered(line2):
    line2.instruct(BROADCAST, FAST_SYNC_READ, bytes.fromhex("00100400 0102"))
    assert line2.receive() == b""
    assert any("does not reply to the fast read 0x8a" in note for note in line2.notes())


def test_a_2xl_knows_no_fast_read(make_line2):
    line = make_line2((1,), "2XL430-W250")
    line.instruct(BROADCAST, FAST_SYNC_READ, POSITION + b"\x01")
    assert line.receive() == b""


@pytest.mark.parametrize(("absent", "received"), [("silent", 15 + 3), ("slot", 15 + 3 + 15)])
def test_a_cut_answer_is_to_those_after_it_as_none(make_line2, absent, received):
    line = make_line2((1, 2, 3))
    line.bus.absent = absent
    truncate_next(line.bus, 2, 3)
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02\x03")
    assert len(line.receive()) == received
    line.instruct(BROADCAST, SYNC_READ, POSITION + b"\x01\x02\x03")
    assert len(line.receive()) == 3 * 15


# Protocol 1.0


def bulk(*entries: tuple[int, int, int]) -> list[int]:
    return [0, *(number for servo_id, address, size in entries for number in (size, servo_id, address))]


def test_mx_answer_a_bulk_group_read(make_line):
    line = make_line((1, 2, 3), "MX-28")
    line.send(BROADCAST, BULK_READ, *bulk((3, 36, 2), (1, 30, 4), (2, 43, 1)))
    received = line.receive()
    assert (received[2], received[3]) == (3, 4)
    assert (received[8 + 2], received[8 + 3]) == (1, 6)
    assert (received[18 + 2], received[18 + 3]) == (2, 3)
    assert len(received) == 8 + 10 + 7


def test_an_absent_servo_breaks_the_bulk_read_of_protocol_1(make_line):
    line = make_line((1, 3), "MX-64")
    line.bus.absent = "slot"  # of Protocol 2.0 only
    line.send(BROADCAST, BULK_READ, *bulk((1, 36, 2), (2, 36, 2), (3, 36, 2)))
    assert len(line.receive()) == 8


def test_a_bulk_read_of_one_is_not_answered(make_line):
    line = make_line((1,), "MX-106")
    line.send(BROADCAST, BULK_READ, *bulk((1, 36, 2)))
    assert line.receive() == b""


def test_an_ax_among_mx_breaks_the_chain(make_line):
    line = make_line((1, 2), "AX-12A")
    line.send(BROADCAST, BULK_READ, *bulk((1, 36, 2), (2, 36, 2)))
    assert line.receive() == b""
