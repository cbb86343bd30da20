"""Whose missing replies are, and whether they depend on the angle of the joint."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dxlrun.channels.packets import PacketKind
from dxlrun_analysis.plan import LoggedBus, LoggedServo
from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.servos.joint_states import BIN_DEG, SPEEDS, STEP_RAD_S, JointStates
from dxlrun_analysis.servos.losses import Fast, Losses, ServoLosses, concentration, when_fast

Make = Callable[..., Any]
BINS = 720 // BIN_DEG
SYNC_READ = bytes.fromhex("fffffd00fe0a0082840004000307040000")  # servos 3, 7 and 4
FAST_READ = bytes.fromhex("fffffd00fe0a008a840004000307040000")
PING_ALL = bytes.fromhex("fffffd00fe0300013142")


def swings(chance: np.random.Generator, losses: int, low: float, high: float) -> tuple[Any, Any]:
    """Time of a joint that swings by 60 deg, and its episodes between two angles, by bins."""
    angle = 60 * np.sin(np.arange(5000) * 0.05)
    inside = np.flatnonzero((angle >= low) & (angle < high))
    lost = angle[chance.choice(inside, losses, replace=False)]
    edges = np.arange(-360, 361, BIN_DEG)
    return np.histogram(angle, edges)[0], np.histogram(lost, edges)[0]


def test_losses_at_one_angle_are_found_with_their_range() -> None:
    time, begun = swings(np.random.default_rng(1), 12, 20, 30)
    found = concentration(time, begun, begun)
    assert found is not None
    assert math.degrees(found.low) == pytest.approx(20)
    assert math.degrees(found.high) == pytest.approx(30)
    assert found.episodes == 12
    assert found.time_share < 0.15


def test_losses_at_any_angle_are_no_cable() -> None:
    named = 0
    for seed in range(400):
        chance = np.random.default_rng(seed)
        time, begun = swings(chance, int(chance.integers(1, 60)), -61, 61)
        named += concentration(time, begun, begun) is not None
    assert named == 0


def test_few_losses_prove_nothing_wherever_they_are() -> None:
    time, begun = swings(np.random.default_rng(1), 4, 20, 25)
    assert concentration(time, begun, begun) is None


def test_a_joint_that_rests_at_one_angle_proves_nothing() -> None:
    time, begun = np.zeros(BINS, np.int64), np.zeros(BINS, np.int64)
    time[80], begun[80] = 5000, 30
    assert concentration(time, begun, begun) is None


@pytest.mark.parametrize(
    ("losses", "bins", "found"), [(6, 4, True), (5, 4, False), (5, 2, True), (6, 6, False)]
)
def test_fewer_losses_have_to_be_in_a_smaller_part_of_the_time(losses: int, bins: int, found: bool) -> None:
    time, begun = np.zeros(BINS, np.int64), np.zeros(BINS, np.int64)
    time[60:80] = 100
    begun[70 : 70 + bins] = 1
    begun[70] += losses - bins
    assert (concentration(time, begun, begun) is not None) == found


def status(servo_id: int) -> bytes:
    return bytes([0xFF, 0xFF, 0xFD, 0, servo_id, 8, 0, 0x55, 0, 1, 2, 3, 4, 0, 0])


def own(write: Make, wire: Make, packets: list[tuple[PacketKind, int, bytes]]) -> dict[int, tuple[int, int]]:
    """Asked and lost of each servo, as far as they are its own."""
    wires = [wire(kind, servo_id, 400 * at, data) for at, (kind, servo_id, data) in enumerate(packets)]
    wires.append(wire(PacketKind.INSTRUCTION, 254, 400 * len(wires), PING_ALL))
    report = analyze_log(write([], wires))
    return {
        servo.servo_id: (servo.losses.asked, servo.losses.lost) for servo in report.servos if servo.losses
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


def lost(*episodes: tuple[float, int]) -> Losses:
    """Episodes of the servos of one bus with the joints 1 to 6: when, in s, and the ID."""
    states = JointStates(["main"], [f"j{servo}" for servo in range(1, 7)])
    states.joint_of[1:7] = range(6)
    losses = Losses(states)
    losses._episodes_at = [(0, round(at * 1e9), servo) for at, servo in episodes]
    return losses


def test_servos_that_are_lost_at_the_same_times_share_a_cable_and_are_named() -> None:
    episodes = [(at + part, servo) for at in range(7) for part, servo in ((0.0, 4), (0.02, 5), (0.1, 6))]
    losses = lost(*episodes, (9.0, 1))  # one more by itself
    (finding,) = losses.findings(0, LoggedBus("main"), {})
    assert (finding.code, finding.subject) == ("shared_cable", "main")
    assert finding.sentence.startswith("4, 5 and 6 on bus main were lost together 7 times while")


@pytest.mark.parametrize(
    "episodes",
    [
        [(at + servo, servo) for at in range(0, 70, 7) for servo in (4, 5)],  # each by itself
        [(at, servo) for at in range(4) for servo in (3, 4, 5)],  # too seldom
        [(at, servo) for at in range(10) for servo in (4, 5, 1)[: 2 + at // 7]],  # another one now and then
        [(at, servo) for at in range(9) for servo in range(1, 7)],  # all of the bus
        [(at, servo) for at in range(12) for servo in ((1, 2), (3, 4), (5, 6))[at % 3]],  # always others
        [(at, 1 + (at + more) % 6) for at in range(30) for more in range(2)],
    ],
)
def test_losses_that_come_together_by_chance_or_of_all_are_no_cable(
    episodes: list[tuple[float, int]],
) -> None:
    assert lost(*episodes)._group(0) == ((), 0)


SPEED = np.abs(np.cos(np.arange(5000) * 0.05)) * 2.0
"""rad/s of a joint that swings; it is faster than 1 rad/s for two thirds of the time."""


def by_speed(lost: Any, begun: Any = None) -> tuple[Any, Any, Any]:
    """Time of a swinging joint, lost replies and episodes, by bins of its speed."""
    edges = np.append(np.arange(SPEEDS) * STEP_RAD_S, np.inf)
    counts = [np.histogram(SPEED[rows], edges)[0] for rows in (slice(None), lost, lost[::3])]
    return counts[0], counts[1], counts[2] if begun is None else begun


def test_losses_at_high_speed_are_found_with_both_shares() -> None:
    fast = np.random.default_rng(2).choice(np.flatnonzero(SPEED > 1.5), 30, replace=False)
    found = when_fast(*by_speed(fast))
    assert found is not None
    assert found.rad_s == pytest.approx(1.6, abs=0.11)
    assert found.lost_share >= 0.9
    assert found.time_share == pytest.approx(np.mean(found.rad_s <= SPEED), abs=0.05)


@pytest.mark.parametrize(
    ("rows", "one_time"),
    [(np.arange(5000), False), (np.flatnonzero(SPEED > 0.4), False), (np.flatnonzero(SPEED > 1.5), True)],
    ids=["at any speed", "at nearly any", "one interruption"],
)
def test_other_losses_do_not_depend_on_the_speed(rows: Any, one_time: bool) -> None:
    begun = np.eye(SPEEDS, dtype=np.int64)[18] if one_time else None
    for seed in range(300):
        chance = np.random.default_rng(seed)
        lost = chance.choice(rows, int(chance.integers(1, 60)), replace=False)
        assert when_fast(*by_speed(lost, begun)) is None


def test_of_a_joint_that_loses_replies_when_it_is_fast_it_is_said_and_of_one_of_many_not() -> None:
    states = JointStates(["main"], ["knee", "other"])
    states.joint_of[1:3] = range(2)
    losses = {1: ServoLosses(500, 40, 9, fast=Fast(1.0, 0.97, 0.3)), 2: ServoLosses(500, 2, 2)}
    bus = LoggedBus("main", servos=[LoggedServo(joint="knee", servo_id=1)])
    (finding,) = Losses(states).findings(0, bus, losses)
    assert (finding.code, finding.subject) == ("loose_cable", "knee")
    assert "97% of 40 above 57 deg/s, where it was for 30% of the time" in finding.sentence
    assert not list(Losses(states).findings(0, bus, {**losses, 2: ServoLosses(500, 30, 9)}))


@pytest.mark.parametrize(("every", "episodes"), [(8, 17), (400, 1), (1, 1)], ids=["often", "once", "always"])
def test_losses_again_and_again_are_episodes_of_a_fifth_of_a_second(
    every: int, episodes: int, write: Make, wire: Make
) -> None:
    read, packets = bytes.fromhex("fffffd0003070002840004001d15"), []
    for at in range(800):  # 4 s
        packets.append(wire(ASK, 3, 5000 * at, read))
        if at == 0 or at % every:
            packets.append(wire(STATUS, 3, 5000 * at + 400, status(3)))
    (servo,) = analyze_log(write([], packets)).servos
    assert servo.losses is not None
    assert servo.losses.episodes == episodes


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
