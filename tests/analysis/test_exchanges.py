"""Exchanges on the buses: which reply answers which request, whose loss a missing one is, who is accused."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.made_logs import PLAN, Wire

from bench import fuzz_pairing
from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.counts import Counts
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.servos.broken_replies import BrokenReplies
from dxlrun_analysis.servos.exchanges import Exchanges, Loss, Pairing
from dxlrun_analysis.servos.joint_states import BINS
from dxlrun_analysis.servos.logged_requests import heads
from dxlrun_analysis.servos.losses import ServoLosses, narrowest
from dxlrun_analysis.servos.other_host import OtherHosts
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol2

ASK, STATUS, NOISE, LATE = PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.NOISE, PacketKind.LATE
Write = Callable[..., Path]
BUS = LoggedBus("main", protocol=2.0, baud_rate=1_000_000)
SYNC_READ = bytes.fromhex("fffffd00fe0a0082840004000307040000")  # servos 3, 7 and 4
FAST_READ = bytes.fromhex("fffffd00fe0a008a840004000307040000")
PING_7, PING_9, PING_ALL = map(protocol2.ping, (7, 9, 254))
HEAD = b"\xff\xff\xfd\x00\xfe\x1a\x00\x55"  # of a fast status packet
CUT = HEAD + bytes((0, 3, 1, 2, 3, 4, 5, 6))
"""A fast status packet without the blocks of 7 and 4."""
BLOCK = bytes((0, 7, *range(6)))
MS = 1_000_000
Wires = Sequence[tuple[PacketKind, int, bytes, int]]


def status(servo_id: int, error: int = 0) -> bytes:
    return bytes([0xFF, 0xFF, 0xFD, 0, servo_id, 8, 0, 0x55, error, 1, 2, 3, 4, 0, 0])


def columns(wires: Wires) -> PacketColumns:
    """Packets of one bus: kind, ID, bytes, ms."""
    return PacketColumns.from_packets(
        LoggedPacket(0, kind, one, at * MS, at * MS, data) for kind, one, data, at in wires
    )


def paired(wires: Wires) -> Exchanges:
    return Pairing((BUS,)).alone(columns(wires))


def losses(found: Exchanges) -> dict[int, Loss]:
    """Of each servo in the first exchange."""
    mine = found.due.exchange == found.due.exchange[0]
    return {
        servo: Loss(loss) for servo, loss in zip(found.due.servo[mine], found.due.loss[mine], strict=True)
    }


def test_of_a_chain_the_first_silent_servo_has_the_loss():
    found = paired([(ASK, 254, SYNC_READ, 0), (STATUS, 3, status(3), 1)])
    assert losses(found) == {3: Loss.NONE, 7: Loss.OWN, 4: Loss.BEHIND}
    assert found.due.place.tolist() == [0, 1, 2]
    assert found.due.reply.tolist() == [0, -1, -1]
    assert found.last_ns.tolist() == [0, 1 * MS]


def test_of_a_chain_of_which_nothing_came_it_is_the_line():
    assert set(losses(paired([(ASK, 254, SYNC_READ, 0)])).values()) == {Loss.LINE}
    assert losses(paired([(ASK, 7, PING_7, 0)])) == {7: Loss.OWN}


def test_the_first_reply_of_a_servo_answers_and_one_that_was_not_asked_does_not():
    found = paired(
        [(ASK, 7, PING_7, 0), (STATUS, 9, status(9), 1), (STATUS, 7, status(7), 2), (STATUS, 7, status(7), 3)]
    )
    assert found.due.reply.tolist() == [1]
    assert found.replies.answers.tolist() == [False, True, False]
    assert found.replies.place.tolist() == [-1, 0, 0]


@pytest.mark.parametrize(("kind", "loss"), [(LATE, Loss.LATE), (STATUS, Loss.OWN)])
def test_a_reply_that_came_late_is_neither_missing_nor_broken(kind, loss):
    wires = [(ASK, 7, PING_7, 0), (NOISE, 254, bytes(3), 1), (ASK, 254, PING_ALL, 2), (kind, 7, status(7), 3)]
    found = paired(wires)
    assert losses(found) == {7: loss}
    assert bool(found.due.broken[0]) == (loss is Loss.OWN)
    assert found.late.exchange.tolist() == [1] * (loss is Loss.LATE)


@pytest.mark.parametrize(("after_ms", "loss"), [(50, Loss.LATE), (150, Loss.OWN)])
def test_the_block_of_a_fast_status_that_comes_by_itself_is_late_and_breaks_no_other(after_ms, loss):
    wires = [
        (ASK, 254, FAST_READ, 0),
        (STATUS, 254, CUT, 1),
        (ASK, 9, PING_9, 2),
        (NOISE, 254, BLOCK, after_ms),
    ]
    found = paired(wires)
    assert losses(found) == {3: Loss.NONE, 7: loss, 4: Loss.BEHIND}
    assert found.due.broken.tolist() == [False, False, False, loss is Loss.OWN]  # of the ping


def test_any_packets_are_paired():
    _, missing = fuzz_pairing.campaign(100, seed=7)
    assert missing > 100


def test_values_are_counted_by_group():
    rng, counts, known = np.random.default_rng(3), Counts(), Counter()
    for groups, spread in ((1, 3), (7000, 1 << 20), (2, 1 << 62), (3, 5000)):
        group, value = rng.integers(-1, groups, 4000), rng.integers(-spread, spread, 4000)
        counts.count_values(group, value)
        known.update(zip(group.tolist(), np.clip(value, -(1 << 39), (1 << 39) - 1).tolist(), strict=True))
    assert counts.groups == sorted({group for group, _ in known if group >= 0})
    for group in range(100):
        found = dict(zip(*(column.tolist() for column in counts.counts_of(group)), strict=True))
        assert found == {value: times for (one, value), times in known.items() if one == group}
        assert list(found) == sorted(found)


def test_packets_outside_of_their_bytes_are_refused():
    packets = columns([(ASK, 7, PING_7, 0)])
    with pytest.raises(ValueError, match="end after their bytes"):
        Pairing((BUS,)).alone(replace(packets, start=packets.start + 1))


def test_packets_that_are_looked_at_alone_wait_for_no_others():
    pairing, wires = Pairing((BUS,)), [(ASK, 254, SYNC_READ, 0)]
    pairing.alone(columns([(ASK, 254, SYNC_READ, 1000)]))
    assert pairing.alone(columns(wires)).sent_ns.tolist() == paired(wires).sent_ns.tolist()


@pytest.mark.parametrize(("read", "shared"), [(SYNC_READ, False), (FAST_READ, True)])
def test_only_of_a_shared_packet_the_end_may_be_cut(read, shared):
    both = bytes((0, 7, 1, 2, 3, 4, 5, 6))
    came = [(STATUS, 254, CUT + both)] if shared else [(STATUS, 3, status(3)), (STATUS, 7, status(7))]
    broken = BrokenReplies(1)
    for _ in range(5):
        broken.add_exchanges(
            paired([(ASK, 254, read, 0), *((*one, 1) for one in came), (NOISE, 254, bytes(5), 2)])
        )
    (finding,) = broken.findings(0, BUS, dict.fromkeys((3, 7, 4), ServoLosses(5, 5, 5)))
    assert "servo 4" in finding.sentence
    assert ("of the shared status packet" in finding.sentence) == shared


WRITE_7 = bytes((0xFF, 0xFF, 0xFD, 0, 7, 6, 0, 3, 64, 0, 1, 0, 0))
SYNC_WRITE = bytes.fromhex("fffffd00fe0b00834000010007010401 0000")


@pytest.mark.parametrize(
    ("wires", "unasked"),
    [
        ([(ASK, 7, PING_7, 0), (STATUS, 7, status(7), 1), (STATUS, 4, status(4), 2)], [4]),
        ([(ASK, 254, SYNC_WRITE, 0), (STATUS, 4, status(4), 2)], [4]),
        ([(ASK, 7, PING_7, 0), (STATUS, 7, status(7), 1), (STATUS, 7, status(7), 2)], []),
        ([(ASK, 7, WRITE_7, 0), (STATUS, 7, status(7), 1)], []),
        ([(ASK, 254, PING_ALL, 0), (STATUS, 7, status(7), 1), (STATUS, 4, status(4), 2)], []),
        ([(ASK, 7, PING_7, 0), (ASK, 254, SYNC_WRITE, 9), (STATUS, 7, status(7), 10)], []),
        ([(ASK, 7, PING_7, 0), (ASK, 254, SYNC_WRITE, 9), (LATE, 4, status(4), 10)], []),
        ([(STATUS, 7, status(7), 0), (ASK, 7, PING_7, 1)], []),
    ],
    ids=["behind", "nothing asked", "twice", "acknowledged", "all asked", "owed", "late", "before all"],
)
def test_a_reply_that_nothing_asked_for(wires, unasked):
    assert paired(wires).unasked.tolist() == unasked


@pytest.mark.parametrize(
    ("count", "ids", "told"),
    [
        (9, (4,), ""),
        (10, (4,), "10 unrequested replies (of ID 4)."),
        (12, (4, 9), "12 unrequested replies (of IDs 4, 9)."),
    ],
)
def test_a_host_that_uses_the_same_adapter_is_told_by_the_replies_to_it(count, ids, told):
    wires = []
    for number in range(count):
        servo_id = ids[number % len(ids)]
        wires += [(ASK, 7, PING_7, 10 * number), (STATUS, 7, status(7), 10 * number + 1)]
        wires += [(STATUS, servo_id, status(servo_id), 10 * number + 2)]
    others = OtherHosts(1)
    others.add_exchanges(paired(wires))
    found = others.findings(0, BUS)
    assert others.explains(0) is bool(told)
    assert [(one.code, one.subject) for one in found] == [("another_host", "main")] * bool(told)
    assert "".join(one.sentence for one in found) == (
        f"Another host uses bus main, or its adapter: {told}" if told else ""
    )


def swings(losses: int, low: float, high: float, seed: int = 1) -> tuple[Any, Any]:
    """Time of a joint that swings by 60 deg, and its losses between two angles, by bins of 5 deg."""
    angle = 60 * np.sin(np.arange(5000) * 0.05)
    inside = np.flatnonzero((angle >= low) & (angle < high))
    lost = angle[np.random.default_rng(seed).choice(inside, losses, replace=False)]
    edges = np.arange(-500, 501, 5)
    return np.histogram(angle, edges)[0], np.histogram(lost, edges)[0]


def test_losses_at_one_angle_are_found_with_their_range():
    found = narrowest(*swings(12, 20, 30), open_above=False)
    assert found is not None
    assert found[:3] == (104, 105, 12)
    assert found[3] < 0.15


@pytest.mark.parametrize("open_above", [False, True])
def test_losses_at_any_angle_or_speed_do_not_depend_on_it(open_above):
    named = [narrowest(*swings(5 + seed % 55, -61, 61, seed), open_above=open_above) for seed in range(400)]
    assert len(named) - named.count(None) <= 2  # one in a thousand


@pytest.mark.parametrize(("losses", "told"), [(4, False), (5, True)])
def test_few_losses_prove_nothing_wherever_they_are(losses, told):
    assert (narrowest(*swings(losses, 20, 25), open_above=False) is not None) is told


def test_a_joint_that_rests_at_one_angle_proves_nothing():
    time = np.zeros(BINS, np.int64)
    time[80] = 5000
    assert narrowest(time, time // 100, open_above=False) is None


def own(write: Write, packets: Iterable[tuple[PacketKind, int, bytes]]) -> dict[int, tuple[int, int]]:
    """Return asked and lost of each servo, as far as they are its own."""
    sent = [*packets, (ASK, 254, PING_ALL)]
    wires = [Wire(kind, servo_id, 400 * at, data) for at, (kind, servo_id, data) in enumerate(sent)]
    servos = analyze_log(write([], wires)).totals.servos
    return {one.servo_id: (one.losses.asked, one.losses.lost) for one in servos if one.losses}


@pytest.mark.parametrize("behind", [[], [(STATUS, 4, status(4))]], ids=["none", "it comes all the same"])
def test_servos_behind_a_silent_one_wait_in_vain(behind, write):
    packets = [(ASK, 254, SYNC_READ), (STATUS, 3, status(3)), *behind]  # 7 is silent, and 4 waits for it
    assert own(write, packets) == {3: (1, 0), 7: (1, 1)}  # nothing is known of 4


@pytest.mark.parametrize("rest", [b"", bytes(5)], ids=["silent", "broken"])
@pytest.mark.parametrize(("blocks", "first_bad"), [([3], 7), ([3, 7], 4)])
def test_of_a_cut_fast_status_the_intact_blocks_are_replies_and_the_first_bad_one_is_lost(
    write, blocks, first_bad, rest
):
    intact = HEAD + b"".join(bytes((0, one, 1, 2, 3, 4, 5, 6)) for one in blocks)
    packets = [(ASK, 254, FAST_READ), (STATUS, 254, intact)] + [(NOISE, 254, rest)] * bool(rest)
    found = own(write, packets)
    assert found == {**dict.fromkeys(blocks, (1, 0)), first_bad: (1, 1)}


BROKEN = bytes.fromhex("fffffd00030800550001")
LOW = {3: "hip", 7: "knee", 4: "foot"}


@pytest.mark.parametrize("fast", [False, True], ids=["sync", "fast"])
@pytest.mark.parametrize(
    ("broken", "is_named"),
    [((12, 0, 0), True), ((9, 0, 0), False), ((12, 2, 0), False), ((12, 0, 20), False)],
    ids=["its own", "few", "another's too", "more bytes than its reply has"],
)
def test_of_a_chain_that_is_broken_from_its_first_reply_on_that_servo_is_named(fast, broken, is_named, write):
    of_first, of_second, more = broken
    head = HEAD if fast else b""
    replies = [bytes((0, servo, 1, 2, 3, 4, 5, 6)) if fast else status(servo) for servo in LOW]
    packets = []
    for number in range(60):
        at = 20_000 * number
        intact = 0 if number < of_first else 1 if number < of_first + of_second else 3
        packets.append(Wire(ASK, 254, at, FAST_READ if fast else SYNC_READ))
        if fast and intact:
            packets.append(Wire(STATUS, 254, at + 400, head + b"".join(replies[:intact])))
        elif not fast:
            packets += [
                Wire(STATUS, servo, at + 400, data)
                for servo, data in list(zip(LOW, replies, strict=True))[:intact]
            ]
        packets += [Wire(NOISE, 254, at + 500, BROKEN + bytes(more))] * (intact < 3)
    servos = [{"joint": name, "servo_id": servo} for servo, name in LOW.items()]
    plan = {"buses": [{"name": "main", "protocol": 2.0, "servos": servos}]}
    findings = analyze_log(write([], packets, plan=plan)).verdict.findings
    named = [one.subject for one in findings if one.code == "broken_replies"]
    assert named == ["hip"] * is_named


# Errors, another host, and an echo


def test_errors_of_protocol_2_are_numbers_and_the_alert_a_bit(write):
    packets = [
        Wire(STATUS, 1, 0, status(1, 7)),
        Wire(STATUS, 1, 10, status(1, 0x84)),
        Wire(STATUS, 2, 20, status(2)),
    ]
    first, second = analyze_log(write([], packets)).totals.servos
    assert (first.errors, first.error_names) == (2, ("range", "access", "alert"))
    assert (second.errors, second.error_names) == (0, ())


@pytest.mark.parametrize(("rounds", "lost"), [(1, 0), (2, 1)])
def test_what_is_open_where_the_log_ends_is_not_lost(write, rounds, lost):
    packets = []
    for at in range(0, rounds * 20_000, 20_000):
        packets += [Wire(ASK, 254, at, SYNC_READ), Wire(STATUS, 3, at + 400, status(3))]
    report = analyze_log(write([], packets))
    first, _, second = report.totals.servos
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
def test_what_another_host_left_of_a_reply_is_the_other_hosts(write, protocol, spoilt, ping):
    read = bytes.fromhex("ffff0504022406ca" if protocol < 2 else "fffffd0005070002840004001d15")
    packets = []
    for at in range(0, 160_000, 20_000):
        packets += [Wire(ASK, 5, at, read), Wire(NOISE, 0, at + 500, spoilt)]
    planned = {"buses": [{**PLAN["buses"][0], "protocol": protocol}]}
    found = analyze_log(write([], packets, plan=planned)).verdict.findings
    sentences = [one.sentence for one in found if one.code == "another_host"]
    assert [f"8 instructions not from this run ({ping})" in one for one in sentences] == [True] * bool(ping)


@pytest.mark.parametrize(("heard", "echoes"), [(8, True), (2, False), (16, False)])
def test_own_instructions_that_come_back_are_an_echo_and_no_other_host(write, heard, echoes):
    ask, write_all = bytes.fromhex("ffff0504022406ca"), bytes.fromhex("fffffe0783240205fa01aa")
    packets = []
    for number in range(8):
        at = number * 20_000
        back = [PacketKind.OTHER_HOST, PacketKind.ECHO][: (heard > 2 * number) + (heard > 2 * number + 1)]
        packets += [Wire(ASK, 254, at, write_all), Wire(ASK, 5, at + 100, ask)]
        packets += [
            Wire(kind, 254, at + 200, data) for kind, data in zip(back, (write_all, ask), strict=False)
        ]
    planned = {"buses": [{**PLAN["buses"][0], "protocol": 1.0}]}
    codes = {one.code for one in analyze_log(write([], packets, plan=planned)).verdict.findings}
    assert ("another_host" in codes) is echoes


# A chain's first servo: the chain itself does not show whether it, the line or the adapter fails

IDS = (1, 2, 3, 4)
SERVOS = [{"joint": f"j{servo}", "servo_id": servo, "row": servo} for servo in IDS]
CHAINED = {"buses": [{"name": "main", "protocol": 2.0, "baud_rate": 1_000_000, "servos": SERVOS}]}
CHAIN = protocol2.sync_read(132, 4, IDS)


Judge = Callable[..., dict[str, Finding]]


@pytest.fixture
def found(write):
    """Judge 400 cycles of a read of all servos and one of a single servo behind it."""

    def judged(
        silent: Callable[[int], bool] = lambda cycle: False,
        late_us: Callable[[int, int], int] = lambda cycle, servo: 0,
        lost: Callable[[int, int], bool] = lambda cycle, servo: False,
    ) -> dict[str, Finding]:
        packets = []
        for cycle in range(400):
            at, servo = cycle * 20_000, IDS[cycle % 4]
            packets.append(Wire(ASK, 254, at, CHAIN))
            for place, each in enumerate(() if silent(cycle) else IDS):
                when = at + 330 + 150 * place + late_us(cycle, 0)
                packets.append(Wire(STATUS, each, when, status(each)))
            packets.append(Wire(ASK, servo, at + 9000, protocol2.read_range(servo, 132, 4)))
            if not lost(cycle, servo):
                when = at + 9290 + late_us(cycle, servo)
                packets.append(Wire(STATUS, servo, when, status(servo)))
        findings = analyze_log(write([], packets, plan=CHAINED)).verdict.findings
        return {one.code: one for one in findings}

    return judged


def test_chains_that_are_silent_while_single_servos_answer_are_the_first_servos(found):
    findings = found(silent=lambda cycle: cycle % 8 == 7)
    assert findings["lossy_servo"].subject == "j1"
    assert "and all replies of 50 chains that it starts" in findings["lossy_servo"].sentence


def test_where_single_servos_do_not_answer_either_it_is_the_line(found):
    findings = found(silent=lambda cycle: cycle % 8 == 7, lost=lambda cycle, servo: cycle % 15 == 14)
    assert "lossy_servo" not in findings
    assert findings["lossy_line"].subject == "main"


def test_a_servo_that_is_late_alone_too_is_the_one_that_makes_its_chain_late(found):
    findings = found(late_us=lambda cycle, servo: 3000 * (servo in {0, 1} and cycle % 20 in {0, 5}))
    assert findings["slow_servo"].subject == "j1"


def test_where_any_servo_is_late_now_and_then_it_is_none_of_them(found):
    assert not {"slow_servo", "late_replies"} & found(late_us=lambda c, servo: 3000 * (c % 27 == 0)).keys()


def test_where_single_servos_are_in_time_it_is_not_the_adapter_that_is_late(found):
    assert "late_replies" not in found(late_us=lambda cycle, servo: 6000 * (servo == 0 and cycle % 3 == 0))
    findings = found(late_us=lambda cycle, servo: 6000 * (cycle % 3 == 0))
    assert findings["late_replies"].subject == "main"


@pytest.mark.parametrize("before", [b"", b"\xff\xff\x05\x02\x01\xf7"])
def test_head_of_a_short_packet_at_the_end_of_the_log_ends_with_zeros(before):
    ping = b"\xff\xff\x04\x02\x01\xf8"
    texts = [part for part in (before, ping) if part]
    found = heads(columns([(ASK, 4, text, at) for at, text in enumerate(texts)]))
    assert found.tolist() == [int.from_bytes(text[:8].ljust(8, b"\0"), "little") for text in texts]
