"""A chain's first servo: the chain itself does not show whether it, the line or the adapter fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dxlrun_analysis.finding import Finding
from dxlrun_analysis.report import analyze_log
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
IDS = (1, 2, 3, 4)
SERVOS = [{"joint": f"j{servo}", "servo_id": servo, "row": servo} for servo in IDS]
PLAN = {"buses": [{"name": "main", "protocol": 2.0, "baud_rate": 1_000_000, "servos": SERVOS}]}
CHAIN = bytes.fromhex("fffffd00fe0b0082840004000102030400 00".replace(" ", ""))


def read(servo: int) -> bytes:
    return bytes((0xFF, 0xFF, 0xFD, 0, servo, 7, 0, 2, 132, 0, 4, 0, 0, 0))


def status(servo: int) -> bytes:
    return bytes((0xFF, 0xFF, 0xFD, 0, servo, 8, 0, 0x55, 0, 1, 2, 3, 4, 0, 0))


@pytest.fixture
def found(write: Make, wire: Make) -> Callable[..., dict[str, Finding]]:
    """Judge 400 cycles of a read of all servos and one of a single servo behind it."""

    def judged(
        silent: Callable[[int], bool] = lambda cycle: False,
        late_us: Callable[[int, int], int] = lambda cycle, servo: 0,
        lost: Callable[[int, int], bool] = lambda cycle, servo: False,
    ) -> dict[str, Finding]:
        packets = []
        for cycle in range(400):
            at, servo = cycle * 20_000, IDS[cycle % 4]
            packets.append(wire(PacketKind.INSTRUCTION, 254, at, CHAIN))
            for place, each in enumerate(() if silent(cycle) else IDS):
                when = at + 330 + 150 * place + late_us(cycle, 0)
                packets.append(wire(PacketKind.STATUS, each, when, status(each)))
            packets.append(wire(PacketKind.INSTRUCTION, servo, at + 9000, read(servo)))
            if not lost(cycle, servo):
                when = at + 9290 + late_us(cycle, servo)
                packets.append(wire(PacketKind.STATUS, servo, when, status(servo)))
        findings = analyze_log(write([], packets, plan=PLAN)).verdict.findings
        return {one.code: one for one in findings}

    return judged


def test_chains_that_are_silent_while_single_servos_answer_are_the_first_servos(found: Make) -> None:
    findings = found(silent=lambda cycle: cycle % 8 == 7)
    assert findings["lossy_servo"].subject == "j1"
    assert "and all replies of 50 chains that it starts" in findings["lossy_servo"].sentence


def test_where_single_servos_do_not_answer_either_it_is_the_line(found: Make) -> None:
    findings = found(silent=lambda cycle: cycle % 8 == 7, lost=lambda cycle, servo: cycle % 15 == 14)
    assert "lossy_servo" not in findings
    assert findings["lossy_line"].subject == "main"


def test_a_servo_that_is_late_alone_too_is_the_one_that_makes_its_chain_late(found: Make) -> None:
    findings = found(late_us=lambda cycle, servo: 3000 * (servo in {0, 1} and cycle % 20 in {0, 5}))
    assert findings["slow_servo"].subject == "j1"


def test_where_any_servo_is_late_now_and_then_it_is_none_of_them(found: Make) -> None:
    assert not {"slow_servo", "late_replies"} & found(late_us=lambda c, servo: 3000 * (c % 27 == 0)).keys()


def test_where_single_servos_are_in_time_it_is_not_the_adapter_that_is_late(found: Make) -> None:
    assert "late_replies" not in found(late_us=lambda cycle, servo: 6000 * (servo == 0 and cycle % 3 == 0))
    findings = found(late_us=lambda cycle, servo: 6000 * (cycle % 3 == 0))
    assert findings["late_replies"].subject == "main"
