"""A log beside a ledger: made-up ones that are known to differ in one place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from dxlrun.channels.packets import PacketKind
from dxlrun.errors import InputError
from dxlrun.log.reader import read_log
from dxlrun.output.json import json_text
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.ledger.comparison import LedgerReport, compare

US = 1000
ROUNDS = 40
FIRST_US = 1_000_000
STEP_US = 20_000


def ask(servo_id: int) -> bytes:
    body = bytes([servo_id, 4, 2, 36, 6])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def reply(servo_id: int, round_: int) -> bytes:
    body = bytes([servo_id, 8, 0, round_, 2, 0, 0, 0, 0])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def exchanges() -> list[tuple[int, int, bytes, bytes]]:
    """Return (time in us, servo, question, reply): two servos a round, 20 ms apart."""
    return [
        (FIRST_US + round_ * STEP_US + turn * 1000, servo_id, ask(servo_id), reply(servo_id, round_))
        for round_ in range(ROUNDS)
        for turn, servo_id in enumerate((5, 21))
    ]


@pytest.fixture
def wires(wire: type) -> list:
    """What the runtime recorded: it reads each reply 100 us after it has passed the wire."""
    return [
        one
        for at, servo_id, question, answer in exchanges()
        for one in (
            wire(PacketKind.INSTRUCTION, servo_id, at, question),
            wire(PacketKind.STATUS, servo_id, at + 800, answer),
        )
    ]


@pytest.fixture
def entries() -> list[LedgerEntry]:
    """What the bus saw: it takes each instruction 30 us after it was written."""
    return [
        one
        for at, _, question, answer in exchanges()
        for one in (
            LedgerEntry((at + 30) * US, "main", "in", question, ""),
            LedgerEntry((at + 700) * US, "main", "out", answer, ""),
        )
    ]


@pytest.fixture
def judge(write_to: Callable[..., Path], tmp_path: Path) -> Callable[..., LedgerReport]:
    def judge(wires: Sequence, entries: Sequence[LedgerEntry], **more: object) -> LedgerReport:
        directory = tmp_path / str(len(list(tmp_path.iterdir())))
        directory.mkdir()
        log = read_log(write_to(directory, wires=wires, **more))
        return compare(log, entries, Path("run.ledger.jsonl"))

    return judge


def test_what_was_sent_and_recorded_as_the_bus_saw_it_is_the_same(judge: Callable, wires: list, entries):
    report = judge(wires, entries)

    assert report.same
    assert report.differences == ()
    assert report.sentences == ("The log is what the bus saw, to the byte: 80 packets out, 80 replies in.",)
    (bus,) = report.buses
    assert (bus.sent_packets, bus.sent_bytes, bus.replies, bus.received_bytes) == (80, 640, 80, 960)


def test_how_a_terminal_splits_and_joins_bytes_makes_no_difference(judge: Callable, wires: list, entries):
    cut = [
        piece
        for entry in entries
        for piece in (
            entry._replace(data=entry.data[:3]),
            entry._replace(t_ns=entry.t_ns + 5 * US, data=entry.data[3:]),
        )
    ]
    assert judge(wires, cut).same


def test_a_reply_that_the_log_lacks_is_shown_with_its_bytes_and_time(judge: Callable, wires: list, entries):
    del wires[41]

    report = judge(wires, entries)

    assert not report.same
    (found,) = report.differences
    assert (found.bus, found.way, found.declared) == ("main", "received", "")
    assert found.only_log == b""
    # a reply of the same servo begins alike: the hole may be shown some bytes later, as long as the reply is
    assert len(found.only_ledger) == 12
    assert found.seconds == pytest.approx(10 * STEP_US * 1e-6, abs=0.002)
    assert report.sentences == (
        "The log is not what the simulated buses saw: it differs in 1 place on main.",
    )
    assert '"way": "received"' in json_text(report)


def test_a_byte_that_was_recorded_wrongly_is_shown_alone(judge: Callable, wires: list, entries):
    wires[20] = replace(wires[20], data=wires[20].data[:5] + b"\x55" + wires[20].data[6:])

    (found,) = judge(wires, entries).differences

    assert (found.way, found.only_log, found.only_ledger) == ("sent", b"\x55", b"\x24")
    assert '"only_log": "55"' in json_text(judge(wires, entries))


def test_a_packet_that_never_came_to_the_bus_is_a_difference(judge: Callable, wires: list, entries):
    del entries[30]

    (found,) = judge(wires, entries).differences

    assert (found.way, len(found.only_log), found.only_ledger) == ("sent", 8, b"")


def test_packets_out_of_order_are_a_difference(judge: Callable, wires: list, entries):
    entries[40], entries[42] = (
        entries[40]._replace(data=entries[42].data),
        entries[42]._replace(data=entries[40].data),
    )
    assert not judge(wires, entries).same


def test_each_of_many_differences_is_found(judge: Callable, wires: list, entries):
    for index in (3, 33, 63, 93, 123):
        flipped = bytes([entries[index].data[5] ^ 0x81])
        data = entries[index].data
        entries[index] = entries[index]._replace(data=data[:5] + flipped + data[6:])

    report = judge(wires, entries)

    assert [(len(one.only_log), len(one.only_ledger)) for one in report.differences] == [(1, 1)] * 5
    assert report.sentences[0].endswith("it differs in 5 places on main.")


def test_after_a_hole_of_ten_seconds_both_are_in_step_again(judge: Callable, wire: type):
    many = [(FIRST_US + n * STEP_US, ask(5), reply(5, n % 251)) for n in range(1500)]
    entries = [
        one
        for at, question, answer in many
        for one in (
            LedgerEntry((at + 30) * US, "main", "in", question, ""),
            LedgerEntry((at + 700) * US, "main", "out", answer, ""),
        )
    ]
    kept = many[:400] + many[900:]
    wires = [
        one
        for at, question, answer in kept
        for one in (
            wire(PacketKind.INSTRUCTION, 5, at, question),
            wire(PacketKind.STATUS, 5, at + 800, answer),
        )
    ]

    report = judge(wires, entries)

    assert {one.way: len(one.only_ledger) for one in report.differences} == {
        "sent": 500 * 8,
        "received": 500 * 12,
    }
    assert all(one.only_log == b"" for one in report.differences)


def test_what_the_recorder_declares_lost_is_no_lie(judge: Callable, wires: list, entries, cycle: type):
    del wires[100:104]
    at_cycle = cycle(100, late=0)

    report = judge(wires, entries, cycles=[at_cycle], gaps=2)

    assert report.same
    assert sorted(one.way for one in report.differences) == ["received", "sent"]
    assert all("overwritten or damaged" in one.declared for one in report.differences)
    assert report.sentences[1] == "The log itself explains 2 differences."


def test_a_declared_gap_excuses_nothing_that_only_the_log_has(
    judge: Callable, wires: list, entries, cycle: type
):
    del entries[100]
    assert not judge(wires, entries, cycles=[cycle(100)], gaps=2).same


def test_a_log_whose_recorder_was_killed_explains_what_it_lacks(judge: Callable, wires: list, entries):
    report = judge(wires[:-6], entries, close=False)

    assert report.same
    assert all("has no end" in one.declared for one in report.differences)


def test_a_whole_log_must_have_the_last_packet_too(judge: Callable, wires: list, entries):
    (found,) = judge(wires[:-2], entries[:-1]).differences

    assert (found.way, found.only_ledger, found.declared) == ("sent", ask(21), "")


def test_a_reply_after_the_last_look_of_the_host_was_never_read(judge: Callable, wires: list, entries):
    report = judge(wires[:-1], entries)

    assert report.same
    (found,) = report.differences
    assert found.declared == "came after the host had read for the last time"


def test_what_other_programs_did_before_and_after_is_counted_only(judge: Callable, wires: list, entries):
    before = LedgerEntry(FIRST_US * US - 50_000_000, "main", "in", b"\xff\xff\x01\x02\x01\xfb", "")
    after = before._replace(t_ns=(FIRST_US + ROUNDS * STEP_US) * US + 10**9)

    report = judge(wires, [before, *entries, after])

    assert report.same
    assert report.buses[0].outside_bytes == 12


def test_a_ledger_of_another_run_is_refused(judge: Callable, wires: list, entries):
    with pytest.raises(InputError, match="the two are of different runs"):
        judge(wires, [entry._replace(t_ns=entry.t_ns + 10**12) for entry in entries])


def test_a_ledger_without_the_bus_is_refused_and_one_bus_alone_may_have_another_name(
    judge: Callable, wires: list, entries
):
    renamed = [entry._replace(bus="sim") for entry in entries]
    assert judge(wires, renamed).same
    with pytest.raises(InputError, match="knows no bus main, only arm, sim"):
        judge(wires, [*renamed, entries[0]._replace(bus="arm")])


def test_a_log_without_packets_has_nothing_to_compare(judge: Callable, entries):
    with pytest.raises(InputError, match="holds no packet"):
        judge([], entries)


def test_injected_faults_of_the_run_are_listed_with_their_events(judge: Callable, wires: list, entries):
    noise = LedgerEntry(FIRST_US * US + 5, "main", "note", b"", "fault: noise bytes=4")
    lost = LedgerEntry(FIRST_US * US + 10**8, "main", "note", b"", "fault: lose servo=5")
    long_before = noise._replace(t_ns=0)

    report = judge(wires, [long_before, noise, *entries, lost])

    assert [fault.text for fault in report.faults] == ["noise bytes=4", "lose servo=5"]
    assert report.sentences[1] == "2 faults were injected; the log has no answer to 2 of them."
