"""Analysis: runs that are known to the last number, and what is said of them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from rich.console import Console
from tests.kit.made_logs import Cycle, Said, Wire

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.errors import LogError
from dxlrun.log.log_reader import read_log
from dxlrun.output.json import json_text
from dxlrun.output.terminal import show_parts
from dxlrun.output.text_table import microseconds
from dxlrun_analysis.cycles.punctuality import Durations, Punctuality
from dxlrun_analysis.parts.cycles import CONTROLLERS, STEPS
from dxlrun_analysis.parts.history import EVENTS
from dxlrun_analysis.parts.part import Report
from dxlrun_analysis.report import analyze_log, parts, tables
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
ASK_5 = bytes.fromhex("ffff0504022406ca")
ASK_21 = bytes.fromhex("ffff1504022406ba")
ANSWER = bytes.fromhex("ffff05080000020000000000f0")
GOALS = bytes.fromhex("fffffe0483")


def shown(report: Report) -> str:
    console = Console(file=io.StringIO(), width=160)
    show_parts(*parts(report), console=console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO, given above
    return text


def asked_and_answered(at: int, error: int = 0) -> list[Any]:
    answer = bytearray(ANSWER)
    answer[4] = error
    return [
        Wire(PacketKind.INSTRUCTION, 5, at, ASK_5, at + 10),
        Wire(PacketKind.STATUS, 5, at + 600, bytes(answer), at + 640),
    ]


def test_a_good_run_is_good(write: Make) -> None:
    packets = [packet for at in (0, 20_000) for packet in asked_and_answered(at)]
    report = analyze_log(
        write([Cycle(number, late=83 if number == 7 else 60) for number in range(50)], packets)
    )
    assert report.verdict.good
    assert report.verdict.sentences == (
        "Good: ran for 1.0 s without a motion.",
        "The loop kept 50 Hz: 0 of 50 periods skipped, worst wake-up 83 us late.",
        "The servo answered every time.",
    )


def test_the_wake_up_latency_is_that_of_the_records(write: Make) -> None:
    late = [4, 4, 4, 62, 151, 1001, 20_001, 3]
    latency = analyze_log(write([Cycle(number, late=us) for number, us in enumerate(late)])).totals.latency
    assert latency is not None
    mean = sum(late) / 8
    assert latency.max_us == 20_001
    assert latency.mean_us == pytest.approx(mean)
    assert latency.deviation_us == pytest.approx((sum((us - mean) ** 2 for us in late) / 8) ** 0.5)
    assert latency.mode_us == 4
    assert (latency.share_over_150_us, latency.share_over_1_ms, latency.share_over_period) == (
        3 / 8,
        2 / 8,
        1 / 8,
    )
    assert (latency.median_us, latency.p99_us, latency.p999_us) == (33, 20_001, 20_001)


def test_percentiles_of_wake_ups_are_values_that_occurred(write: Make) -> None:
    late = [(number * 7919) % 2003 for number in range(2000)]
    report = analyze_log(write([Cycle(number, late=us) for number, us in enumerate(late)]))
    expected = [sorted(late)[rank - 1] for rank in (1980, 1998)]
    assert report.totals.latency is not None
    assert [report.totals.latency.p99_us, report.totals.latency.p999_us] == expected
    assert report.totals.latency.median_us == median(late)
    rows = {str(row[0].text): row[1].text for row in tables(report)["periods"].rows}
    assert [rows[name] for name in ("  99 %", "  99.9 %")] == [microseconds(us) for us in expected]


def test_the_steps_take_the_times_of_the_records(write: Make) -> None:
    cycles = [
        Cycle(number, late=50, read=5000 + number, update=100, write=300 - number) for number in range(101)
    ]
    report = analyze_log(write(cycles))
    steps = {step.name: (step.median_us, step.p99_us, step.max_us) for step in STEPS.numbers_of(report)}
    assert steps["read"] == pytest.approx((5050, 5099, 5100))
    assert steps["update"] == pytest.approx((100, 100, 100))
    assert steps["write"] == pytest.approx((250, 299, 300))
    assert steps["cycle"] == pytest.approx((5400, 5400, 5400))
    head, idle = CONTROLLERS.numbers_of(report)
    assert (head.name, head.cycles, head.max_us) == ("head", 101, 50)
    assert (idle.name, idle.cycles) == ("idle", 0)


def test_periods_that_were_skipped_are_accounted_for(write: Make) -> None:
    report = analyze_log(write([Cycle(0), Cycle(1), Cycle(22, skipped=20), Cycle(23)]))
    assert (report.totals.periods.elapsed, report.totals.periods.records, report.totals.periods.skipped) == (
        24,
        4,
        20,
    )
    assert (report.totals.periods.missing, report.totals.periods.agree) == (0, True)
    assert not report.verdict.good
    assert (
        "did not keep 50 Hz: 20 of 24 periods skipped (83.33%; 10 tolerated in a short run)"
        in report.verdict.sentences[1]
    )


@pytest.mark.parametrize(
    "numbers",
    [[(0, 0), (1, 0), (4, 0)], [(0, 0), (3, 1)], [(0, 0), (3, 0), (4, 2)], [(2, 0)]],
    ids=["undeclared", "half declared", "declared late", "no beginning"],
)
def test_periods_that_vanished_are_reported(write: Make, numbers: list[tuple[int, int]]) -> None:
    report = analyze_log(write([Cycle(number, skipped=skipped) for number, skipped in numbers]))
    assert not report.totals.periods.agree
    assert not report.verdict.good
    assert any("neither recorded nor declared skipped" in one for one in report.verdict.sentences)


def test_a_servo_that_was_silent_is_named(write: Make) -> None:
    packets = asked_and_answered(0)
    packets += [
        Wire(PacketKind.INSTRUCTION, 21, 1000, ASK_21),
        Wire(PacketKind.NOISE, 254, 1500, b"\xff\x00\xff"),
        Wire(PacketKind.INSTRUCTION, 254, 2000, GOALS),
        Wire(PacketKind.INSTRUCTION, 21, 3000, ASK_21),
        Wire(PacketKind.INSTRUCTION, 254, 4000, GOALS),
    ]
    report = analyze_log(write([Cycle(0)], packets))
    elbow, head = report.totals.servos
    assert (elbow.servo_id, elbow.joint, elbow.asked, elbow.lost, elbow.replies) == (
        5,
        "left_elbow_joint",
        1,
        0,
        1,
    )
    assert (elbow.reply_median_us, elbow.reply_max_us) == (640, 640)
    assert (head.servo_id, head.joint, head.asked, head.lost, head.replies) == (21, "head_yaw_joint", 2, 2, 0)
    (bus,) = report.totals.buses
    assert (bus.instructions, bus.broadcasts, bus.replies, bus.noise_bytes) == (5, 2, 1, 3)
    assert (bus.bytes_out, bus.bytes_in) == (3 * 8 + 2 * 5, len(ANSWER) + 3)
    assert report.verdict.sentences[2] == (
        "Replies are missing: servo 21 (head_yaw_joint) 2 of 2 times (100.00%); "
        "1 of 2 servos answered every time."
    )


def test_error_bits_are_named(write: Make) -> None:
    packets = [*asked_and_answered(0), *asked_and_answered(20_000, error=0x24)]
    report = analyze_log(write([Cycle(0)], packets))
    assert report.totals.servos[0].error_names == ("overheating", "overload")
    assert (
        "Servos reported errors: servo 5 (left_elbow_joint): overheating, overload in 1 reply."
        in report.verdict.sentences
    )
    assert not report.verdict.good


def test_without_known_limits_tracking_compares_with_the_goal_of_the_cycle_before(write: Make) -> None:
    cycles = [
        Cycle(0, position=0.0, goal=0.5),
        Cycle(1, position=0.4, goal=0.7, clamped=2),
        Cycle(2, position=9.9, goal=0.7, valid=False),
        Cycle(3, position=0.9, goal=0.0),
    ]
    elbow, head = analyze_log(write(cycles)).totals.tracking
    assert elbow.rms_rad == pytest.approx(((0.1**2 + 0.2**2) / 2) ** 0.5)
    assert elbow.worst_rad == pytest.approx(0.2)
    assert (elbow.invalid, elbow.oldest_ms, elbow.clamped) == (1, 20.0, 1)
    assert (head.rms_rad, head.invalid) == (None, 0)


def test_a_cycle_longer_than_its_period_is_reported_with_its_longest_step(write: Make) -> None:
    sentences = analyze_log(write([Cycle(0), Cycle(1, read=23_000)])).verdict.sentences
    assert sentences[1].endswith("; a cycle took up to 23.40 ms, its read 23.00 ms: own work.")


def test_rough_wake_ups_are_reported(write: Make) -> None:
    report = analyze_log(write([Cycle(number, late=200 if number < 3 else 10) for number in range(100)]))
    assert "worst wake-up 200 us late, 3.0% later than 150 us." in report.verdict.sentences[1]


def test_errors_gaps_and_a_log_without_end_are_reported(write: Make) -> None:
    events = [
        Said(EventCode.LOOP_STARTED, Severity.INFO, "50 Hz"),
        Said(EventCode.CONTROLLER_FAULT, Severity.ERROR, "Traceback\nValueError: no"),
    ]
    report = analyze_log(write([Cycle(0)], events=events, gaps=17, close=False))
    assert (report.totals.gaps, report.about.complete) == (17, False)
    assert not report.verdict.good
    assert report.verdict.sentences[1] == "One error was logged; the first, of head: ValueError: no"
    assert "still being written by a run" in report.verdict.sentences[2]
    assert "17 records were lost" in report.verdict.sentences[2]
    assert "ValueError: no" in shown(report)
    assert [(event.name, event.count) for event in EVENTS.numbers_of(report)] == [
        ("controller_fault", 1),
        ("recorder_gap", 1),
        ("loop_started", 1),
    ]


def test_a_run_without_a_cycle_is_reported(write: Make) -> None:
    report = analyze_log(write())
    assert not report.verdict.good
    assert report.verdict.sentences == (
        "Not good: the loop never ran a cycle.",
        "The loop never ran a cycle.",
    )
    assert (report.totals.latency, STEPS.numbers_of(report)) == (None, ())
    assert "torso" in shown(report)


def test_the_terminal_shows_the_verdict_first_and_every_number_after(write: Make) -> None:
    report = analyze_log(write([Cycle(number, late=60) for number in range(50)], asked_and_answered(0, 0x20)))
    text = shown(report)
    robot, first, *_ = text.splitlines()
    assert robot == "Not good: left_elbow_joint reported errors; ran for 1.0 s without a motion."
    assert first.startswith("Servos reported errors: ")
    for words in ("recorded + skipped = elapsed", "left_elbow_joint", "overload", "read", "head", "640 us"):
        assert words in text


def test_json_carries_the_whole_report(write: Make) -> None:
    read = json.loads(json_text(analyze_log(write([Cycle(0)])).numbers))
    assert read["verdict"]["good"] is True
    assert read["periods"] == {
        "elapsed": 1,
        "records": 1,
        "skipped": 0,
        "missing": 0,
        "agree": True,
        "rate_hz": 50.0,
        "seconds": 0.02,
        "rates_hz": [50.0],
        "begin_ns": 1_000_000_000,
    }
    assert read["joints"][0]["name"] == "left_elbow_joint"
    assert set(read["extremes"][0]) == {"joint", "hottest_c", "lowest_volts"}


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("name: torso\n")
    with pytest.raises(LogError, match="not an MCAP file"):
        analyze_log(tmp_path / "robot.yaml")


@pytest.mark.parametrize(("value", "text"), [(83.4, "83 us"), (16_949.0, "16.95 ms"), (2.5e6, "2.50 s")])
def test_times_are_written_in_fitting_units(value: float, text: str) -> None:
    assert microseconds(value) == text


def test_slices_give_what_the_whole_log_gives(write: Make) -> None:
    cycles = [
        Cycle(n, late=(n * 37) % 900, read=4000 + n, skipped=2 * (n == 40))
        for n in range(120)
        if n not in (38, 39)
    ]
    log = read_log(write(cycles))
    whole = Punctuality(), Durations()
    sliced = Punctuality(), Durations()
    for one in whole:
        one.add_slice(log)
    for begin in range(0, len(log.cycles), 7):
        for one in sliced:
            one.add_slice(replace(log, cycles=log.cycles[begin : begin + 7], activation=None))
    assert sliced[0].compute_latency() == whole[0].compute_latency()
    assert sliced[1].compute_durations() == whole[1].compute_durations()
    assert sliced[0].slowest == whole[0].slowest
