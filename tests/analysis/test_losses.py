"""Whose missing replies are, and at which angle or speed of the joint; of runs, see verdicts/losses.txt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.servos.joint_states import BINS
from dxlrun_analysis.servos.losses import narrowest
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
SYNC_READ = bytes.fromhex("fffffd00fe0a0082840004000307040000")  # servos 3, 7 and 4
FAST_READ = bytes.fromhex("fffffd00fe0a008a840004000307040000")
PING_ALL = bytes.fromhex("fffffd00fe0300013142")


def swings(losses: int, low: float, high: float, seed: int = 1) -> tuple[Any, Any]:
    """Time of a joint that swings by 60 deg, and its losses between two angles, by bins of 5 deg."""
    angle = 60 * np.sin(np.arange(5000) * 0.05)
    inside = np.flatnonzero((angle >= low) & (angle < high))
    lost = angle[np.random.default_rng(seed).choice(inside, losses, replace=False)]
    edges = np.arange(-500, 501, 5)
    return np.histogram(angle, edges)[0], np.histogram(lost, edges)[0]


def test_losses_at_one_angle_are_found_with_their_range() -> None:
    found = narrowest(*swings(12, 20, 30), open_above=False)
    assert found is not None
    assert found[:3] == (104, 105, 12)
    assert found[3] < 0.15


@pytest.mark.parametrize("open_above", [False, True])
def test_losses_at_any_angle_or_speed_do_not_depend_on_it(open_above: bool) -> None:
    named = [narrowest(*swings(5 + seed % 55, -61, 61, seed), open_above=open_above) for seed in range(400)]
    assert len(named) - named.count(None) <= 2  # one in a thousand


@pytest.mark.parametrize(("losses", "told"), [(4, False), (5, True)])
def test_few_losses_prove_nothing_wherever_they_are(losses: int, told: bool) -> None:
    assert (narrowest(*swings(losses, 20, 25), open_above=False) is not None) is told


def test_a_joint_that_rests_at_one_angle_proves_nothing() -> None:
    time = np.zeros(BINS, np.int64)
    time[80] = 5000
    assert narrowest(time, time // 100, open_above=False) is None


def status(servo_id: int) -> bytes:
    return bytes([0xFF, 0xFF, 0xFD, 0, servo_id, 8, 0, 0x55, 0, 1, 2, 3, 4, 0, 0])


def own(write: Make, wire: Make, packets: list[tuple[PacketKind, int, bytes]]) -> dict[int, tuple[int, int]]:
    """Asked and lost of each servo, as far as they are its own."""
    wires = [wire(kind, servo_id, 400 * at, data) for at, (kind, servo_id, data) in enumerate(packets)]
    wires.append(wire(PacketKind.INSTRUCTION, 254, 400 * len(wires), PING_ALL))
    report = analyze_log(write([], wires))
    return {
        servo.servo_id: (servo.losses.asked, servo.losses.lost)
        for servo in report.totals.servos
        if servo.losses
    }


ASK, STATUS, NOISE = PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.NOISE


@pytest.mark.parametrize("behind", [[], [(STATUS, 4, status(4))]], ids=["none", "it comes all the same"])
def test_servos_behind_a_silent_one_wait_in_vain(behind: list[Any], write: Make, wire: Make) -> None:
    packets = [(ASK, 254, SYNC_READ), (STATUS, 3, status(3)), *behind]  # 7 is silent, and 4 waits for it
    assert own(write, wire, packets) == {3: (1, 0), 7: (1, 1)}  # nothing is known of 4


def test_of_a_chain_of_which_nothing_arrived_nobody_is_accused(write: Make, wire: Make) -> None:
    assert all(lost == 0 for _, lost in own(write, wire, [(ASK, 254, SYNC_READ)]).values())


@pytest.mark.parametrize("rest", [b"", bytes(5)], ids=["silent", "broken"])
@pytest.mark.parametrize(("blocks", "first_bad"), [([3], 7), ([3, 7], 4)])
def test_of_a_cut_fast_status_the_intact_blocks_are_replies_and_the_first_bad_one_is_lost(
    write: Make, wire: Make, blocks: list[int], first_bad: int, rest: bytes
) -> None:
    intact = b"\xff\xff\xfd\x00\xfe\x1a\x00\x55" + b"".join(
        bytes((0, one, 1, 2, 3, 4, 5, 6)) for one in blocks
    )
    packets = [(ASK, 254, FAST_READ), (STATUS, 254, intact)] + [(NOISE, 254, rest)] * bool(rest)
    found = own(write, wire, packets)
    assert found == {**dict.fromkeys(blocks, (1, 0)), first_bad: (1, 1)}


@pytest.mark.parametrize(
    ("block", "is_late"),
    [(bytes((0, 7, *range(6))), True), (bytes((0, 4, *range(6))), False), (bytes((0, 7)), False)],
    ids=["its block", "another ID", "too short"],
)
def test_a_block_that_a_fast_status_lacks_is_late_where_it_comes_by_itself(
    block: bytes, is_late: bool, write: Make, wire: Make
) -> None:
    cut = b"\xff\xff\xfd\x00\xfe\x1a\x00\x55" + bytes((0, 3, 1, 2, 3, 4, 5, 6))
    packets = [(ASK, 254, FAST_READ), (STATUS, 254, cut), (ASK, 254, PING_ALL), (NOISE, 254, block)]
    assert own(write, wire, packets).get(7) == (None if is_late else (1, 1))


BROKEN = bytes.fromhex("fffffd00030800550001")
LOW = {3: "hip", 7: "knee", 4: "foot"}


@pytest.mark.parametrize("fast", [False, True], ids=["sync", "fast"])
@pytest.mark.parametrize(
    ("broken", "is_named"),
    [((12, 0, 0), True), ((9, 0, 0), False), ((12, 2, 0), False), ((12, 0, 20), False)],
    ids=["its own", "few", "another's too", "more bytes than its reply has"],
)
def test_of_a_chain_that_is_broken_from_its_first_reply_on_that_servo_is_named(
    fast: bool, broken: tuple[int, int, int], is_named: bool, write: Make, wire: Make
) -> None:
    of_first, of_second, more = broken
    head = b"\xff\xff\xfd\x00\xfe\x1a\x00\x55" if fast else b""
    replies = [bytes((0, servo, 1, 2, 3, 4, 5, 6)) if fast else status(servo) for servo in LOW]
    packets = []
    for number in range(60):
        at = 20_000 * number
        intact = 0 if number < of_first else 1 if number < of_first + of_second else 3
        packets.append(wire(ASK, 254, at, FAST_READ if fast else SYNC_READ))
        if fast and intact:
            packets.append(wire(STATUS, 254, at + 400, head + b"".join(replies[:intact])))
        elif not fast:
            packets += [
                wire(STATUS, servo, at + 400, data)
                for servo, data in list(zip(LOW, replies, strict=True))[:intact]
            ]
        packets += [wire(NOISE, 254, at + 500, BROKEN + bytes(more))] * (intact < 3)
    servos = [{"joint": name, "servo_id": servo} for servo, name in LOW.items()]
    plan = {"buses": [{"name": "main", "protocol": 2.0, "servos": servos}]}
    findings = analyze_log(write([], packets, plan=plan)).verdict.findings
    named = [one.subject for one in findings if one.code == "broken_replies"]
    assert named == ["hip"] * is_named
