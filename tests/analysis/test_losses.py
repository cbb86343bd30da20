"""Whose missing replies are, over all buses, and at which angle or speed of the joint."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.analysis.stranger.kit import JOINTS, ROBOTS, Story

from dxlrun.log.log_reader import read_log
from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.servos.joint_states import BINS
from dxlrun_analysis.servos.losses import narrowest
from dxlrun_analysis.servos.traffic import Traffic
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


Inject = Callable[[Story], object]


@pytest.fixture
def found(tmp_path: Path) -> Callable[[str, Inject], list[tuple[str, str]]]:
    """Inject faults from 1 s on in a run of 5 s: codes and subjects of what is found."""

    def found(robot: str, inject: Inject) -> list[tuple[str, str]]:
        story = Story(ROBOTS[robot], "losses", tmp_path)
        story.duration_s = 5.0
        inject(story)
        traffic, log = Traffic(), read_log(story.run())
        traffic.add_slice(log)
        traffic.summarize_traffic()
        return sorted((one.code, one.subject) for one in traffic.findings)

    return found


def again(period_s: float, for_s: float) -> Callable[[float], bool]:
    return lambda t_s: t_s > 1 and (t_s - 1) % period_s < for_s


def cut(story: Story, joint: str, when: Callable[[float], bool]) -> None:
    story.at(0.01, lambda: story.interrupt(joint, lambda: not when(story.now_s(joint))), joint)


def lossy(story: Story, joint: str, share: float = 0.08) -> None:
    cut(story, joint, lambda t_s: t_s > 1 and story.random.random() < share)


def deaf(story: Story, bus: int, when: Callable[[float], bool]) -> None:
    story.on_arrival(bus, lambda servo, data, t_s: b"" if when(t_s) else data)


def late(story: Story, joint: str, by_s: float) -> None:
    story.alter(joint, lambda t_s: (bytes, by_s) if t_s > 1 and story.random.random() < 0.5 else None, "late")


@pytest.mark.parametrize("robot", ["mx_two", "x_three"])
def test_a_hub_that_stalls_accuses_no_servo_and_no_single_bus(robot: str, found: Make) -> None:
    stalls = again(0.6113, 0.05)
    findings = found(robot, lambda story: story.hand_over_late((0, 1), lambda t: 0.06 * stalls(t), "stall"))
    assert findings == [("late_replies", "machine")]


@pytest.mark.parametrize("robot", ["mx_two", "x_three"])
def test_buses_that_lose_replies_in_the_same_cycles_accuse_what_they_share(robot: str, found: Make) -> None:
    findings = found(robot, lambda story: [deaf(story, bus, again(0.4313, 0.012)) for bus in (0, 1)])
    assert findings == [("lossy_line", "machine")]


@pytest.mark.parametrize("robot", ["mx_bulk", "ax_single", "x_fast", "x_sync"])
def test_an_adapter_that_is_deaf_again_and_again_accuses_no_servo(robot: str, found: Make) -> None:
    assert found(robot, lambda story: deaf(story, 0, again(0.4313, 0.1))) == [("lossy_line", "main")]


@pytest.mark.parametrize("robot", ["mx_bulk", "ax_single", "x_fast", "x_sync"])
def test_a_slow_servo_and_a_lossy_one_of_a_bus_are_both_named(robot: str, found: Make) -> None:
    findings = found(robot, lambda story: (late(story, "left_elbow", 0.004), lossy(story, "right_knee")))
    assert {("slow_servo", "left_elbow"), ("lossy_servo", "right_knee")} <= set(findings)
    assert not {subject for _, subject in findings} - {"left_elbow", "right_knee", "main"}


@pytest.mark.parametrize("robot", ["mx_two", "ax_single"])
def test_two_lossy_servos_are_both_named_on_one_bus_or_on_two(robot: str, found: Make) -> None:
    findings = found(
        robot, lambda story: [lossy(story, joint, 0.3) for joint in ("left_elbow", "right_knee")]
    )
    assert findings == [("lossy_servo", "left_elbow"), ("lossy_servo", "right_knee")]


@pytest.mark.parametrize("joints", [("left_elbow", "left_knee"), ("head_yaw", "head_pitch")])
@pytest.mark.parametrize("robot", ["mx_bulk", "ax_single"])
def test_servos_that_lose_replies_at_the_same_occasions_are_named_together(
    robot: str, joints: tuple[str, str], found: Make
) -> None:
    findings = found(robot, lambda story: [cut(story, joint, again(0.4117, 0.05)) for joint in joints])
    assert findings == [("lossy_servo", "main")]


def test_where_all_servos_lose_replies_now_and_then_it_is_none_of_them(found: Make) -> None:
    findings = found("ax_single", lambda story: [lossy(story, joint, 0.03) for joint in JOINTS])
    assert findings == [("lossy_line", "main")]


def test_a_plug_that_is_loose_at_some_angles_is_told_with_them(tmp_path: Path) -> None:
    story = Story(ROBOTS["mx_bulk"], "losses", tmp_path)
    story.duration_s = 10.0
    story.fault("loose servo={id} low=195deg high=205deg share=0.2 at=1s", "left_knee")
    story.motion = story.swing(left_knee="0.7 * sin(3 * t)")
    traffic, log = Traffic(), read_log(story.run())
    traffic.add_slice(log)
    traffic.summarize_traffic()
    (finding,) = traffic.findings
    assert (finding.code, finding.subject) == ("lossy_servo", "left_knee")
    told = r"(\d+) episodes, (\d+) of them between 1\d and 2\d deg \(1?\d% of the time\)"
    assert re.search(told, finding.sentence), finding.sentence


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
