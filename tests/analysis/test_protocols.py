"""Analysis: reads of several servos, and Protocol 2.0, judged by packets made by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.kit.made_logs import PLAN

from dxlrun_analysis.report import analyze_log
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
SYNC_READ = bytes.fromhex("fffffd00fe090082840004000102cefa")
"""e-Manual, Protocol 2.0, sync read: present position of servos 1 and 2."""
FAST_SYNC_READ = bytes.fromhex("fffffd00fe0a008a84000400030704fab5")
"""Servos 3, 7 and 4; the log is not asked whether the CRC is right."""
BULK_READ_1 = bytes.fromhex("fffffe09920002032402072411")


PING_ALL = bytes.fromhex("fffffd00fe0300013142")
"""Asks no servo in particular; what was asked before it is not open any more."""


def asks(wire: Make, at: int, data: bytes, servo_id: int = 254) -> Any:
    return wire(PacketKind.INSTRUCTION, servo_id, at, data)


def answers(wire: Make, at: int, servo_id: int, data: bytes) -> Any:
    return wire(PacketKind.STATUS, servo_id, at, data)


def status(servo_id: int, error: int = 0) -> bytes:
    return bytes([0xFF, 0xFF, 0xFD, 0, servo_id, 8, 0, 0x55, error, 1, 2, 3, 4, 0, 0])


def test_a_sync_read_asks_each_servo_of_its_list(write: Make, wire: Make) -> None:
    packets = [
        asks(wire, 0, SYNC_READ),
        answers(wire, 400, 1, status(1)),
        answers(wire, 700, 2, status(2)),
        asks(wire, 20_000, SYNC_READ),
        answers(wire, 20_500, 1, status(1)),
        asks(wire, 40_000, PING_ALL),
    ]
    report = analyze_log(write([], packets))
    first, second = report.totals.servos
    assert (first.servo_id, first.asked, first.lost, first.replies, first.instructions) == (1, 2, 0, 2, 0)
    assert (second.servo_id, second.asked, second.lost, second.replies) == (2, 2, 1, 1)
    assert (first.reply_max_us, second.reply_max_us) == (500, 700)
    assert any("servo 2 (main) 1 of 2 times (50.00%)" in one for one in report.verdict.sentences)


def test_one_fast_status_answers_for_all(write: Make, wire: Make) -> None:
    blocks = bytes([0, 3, 166, 0, 0, 0, 0x2E, 0x90, 0x80, 7, 1, 0, 0, 0, 0x11, 0x22])
    whole = bytes([0xFF, 0xFF, 0xFD, 0, 0xFE, 1 + len(blocks), 0, 0x55]) + blocks
    packets = [asks(wire, 0, FAST_SYNC_READ), answers(wire, 300, 254, whole), asks(wire, 600, PING_ALL)]
    third, fourth, seventh = analyze_log(write([], packets)).totals.servos
    assert (third.asked, third.lost, third.replies, third.errors) == (1, 0, 1, 0)
    assert (seventh.replies, seventh.errors, seventh.error_names) == (1, 1, ("alert",))
    assert (fourth.asked, fourth.lost) == (1, 1)


def test_a_bulk_read_of_protocol_1_asks_each_servo_of_its_list(write: Make, wire: Make) -> None:
    answer = bytes.fromhex("ffff030400000000f8")
    packets = [asks(wire, 0, BULK_READ_1), answers(wire, 600, 3, answer), asks(wire, 900, BULK_READ_1)]
    first, second = analyze_log(write([], packets)).totals.servos
    assert (first.servo_id, first.asked, first.lost, first.replies) == (3, 1, 0, 1)
    assert (second.servo_id, second.asked, second.lost, second.replies) == (7, 1, 1, 0)


def test_a_stuffed_list_is_read_as_it_was_meant(write: Make, wire: Make) -> None:
    # a sync read of 253 bytes at address 65535: no table has it, but FF FF FD lies in the list
    stuffed = bytes.fromhex("fffffd00fe0a0082fffffdfd0005cefa")
    (servo,) = analyze_log(write([], [asks(wire, 0, stuffed), asks(wire, 900, PING_ALL)])).totals.servos
    assert (servo.servo_id, servo.asked, servo.lost) == (5, 1, 1)


def test_errors_of_protocol_2_are_numbers_and_the_alert_a_bit(write: Make, wire: Make) -> None:
    packets = [
        answers(wire, 0, 1, status(1, 7)),
        answers(wire, 10, 1, status(1, 0x84)),
        answers(wire, 20, 2, status(2)),
    ]
    first, second = analyze_log(write([], packets)).totals.servos
    assert (first.errors, first.error_names) == (2, ("range", "access", "alert"))
    assert (second.errors, second.error_names) == (0, ())


def test_a_broadcast_ping_requests_no_certain_reply(write: Make, wire: Make) -> None:
    (servo,) = analyze_log(
        write([], [asks(wire, 0, PING_ALL), answers(wire, 500, 1, status(1))])
    ).totals.servos
    assert (servo.asked, servo.lost, servo.replies) == (0, 0, 1)


def test_a_read_of_one_servo_by_protocol_2_is_paired(write: Make, wire: Make) -> None:
    read = bytes.fromhex("fffffd0001070002840004001d15")
    packets = [asks(wire, 0, read, 1), answers(wire, 640, 1, status(1)), asks(wire, 900, read, 1)]
    packets.append(asks(wire, 1900, PING_ALL))
    report = analyze_log(write([], packets))
    (servo,) = report.totals.servos
    assert (servo.instructions, servo.asked, servo.lost, servo.reply_max_us) == (2, 2, 1, 640)
    assert report.totals.buses[0].broadcasts == 1


@pytest.mark.parametrize(("rounds", "lost"), [(1, 0), (2, 1)])
def test_what_is_open_where_the_log_ends_is_not_lost(write: Make, wire: Make, rounds: int, lost: int) -> None:
    packets = []
    for at in range(0, rounds * 20_000, 20_000):
        packets += [asks(wire, at, SYNC_READ), answers(wire, at + 400, 1, status(1))]
    report = analyze_log(write([], packets))
    first, second = report.totals.servos
    assert (first.asked, first.lost) == (rounds, 0)
    assert (second.asked, second.lost) == (rounds - 1, lost)
    assert ("Replies are missing" in " ".join(report.verdict.sentences)) == bool(lost)


PINGED_1 = bytes.fromhex("ffff05080000020000000201e0")
"""A ping of ID 28 behind what is left of a reply of 13 bytes."""
PINGED_2 = status(5)[:-4] + bytes.fromhex("07030001194e")


@pytest.mark.parametrize(
    ("protocol", "spoilt", "ping"),
    [
        (1.0, PINGED_1, "ping of ID 28"),
        (2.0, PINGED_2, "ping of ID 7"),
        (1.0, PINGED_1[:-3] + b"\1\2\3", ""),
        (2.0, status(5)[:-1], ""),
    ],
    ids=["1", "2", "another's bytes", "a reply's end"],
)
def test_what_another_host_left_of_a_reply_is_the_other_hosts(
    write: Make, wire: Make, protocol: float, spoilt: bytes, ping: str
) -> None:
    read = bytes.fromhex("ffff0504022406ca" if protocol < 2 else "fffffd0005070002840004001d15")
    packets = []
    for at in range(0, 160_000, 20_000):
        packets += [asks(wire, at, read, 5), wire(PacketKind.NOISE, 0, at + 500, spoilt)]
    planned = {"buses": [{**PLAN["buses"][0], "protocol": protocol}]}
    found = analyze_log(write([], packets, plan=planned)).verdict.findings
    sentences = [one.sentence for one in found if one.code == "another_host"]
    assert [f"8 instructions not from this run ({ping})" in one for one in sentences] == [True] * bool(ping)


@pytest.mark.parametrize(("heard", "echoes"), [(8, True), (2, False), (16, False)])
def test_own_instructions_that_come_back_are_an_echo_and_no_other_host(
    write: Make, wire: Make, heard: int, echoes: bool
) -> None:
    ask, write_all = bytes.fromhex("ffff0504022406ca"), bytes.fromhex("fffffe0783240205fa01aa")
    packets = []
    for number in range(8):
        at = number * 20_000
        back = [PacketKind.OTHER_HOST, PacketKind.ECHO][: (heard > 2 * number) + (heard > 2 * number + 1)]
        packets += [asks(wire, at, write_all), asks(wire, at + 100, ask, 5)]
        packets += [
            wire(kind, 254, at + 200, data) for kind, data in zip(back, (write_all, ask), strict=False)
        ]
    planned = {"buses": [{**PLAN["buses"][0], "protocol": 1.0}]}
    codes = {one.code for one in analyze_log(write([], packets, plan=planned)).verdict.findings}
    assert ("another_host" in codes) is echoes
