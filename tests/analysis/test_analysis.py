"""Analysis: runs that are known to the last number, and what is said of them on terminals of any width."""

import io
from statistics import median, mode

import numpy as np
import pytest
from rich.console import Console
from tests.kit.made_logs import Cycle, Said, Wire

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.log import log_reader, log_writer
from dxlrun.output.terminal import show_parts
from dxlrun.output.text_table import Table, microseconds
from dxlrun_analysis.parts.cycles import CONTROLLERS, STEPS
from dxlrun_analysis.parts.history import EVENTS
from dxlrun_analysis.parts.part import Report
from dxlrun_analysis.report import analyze_log, parts, tables
from dxlwire.packets import PacketKind

ASK_5 = bytes.fromhex("ffff0504022406ca")
ASK_21 = bytes.fromhex("ffff1504022406ba")
ANSWER = bytes.fromhex("ffff05080000020000000000f0")
GOALS = bytes.fromhex("fffffe0483")


def shown(report: Report, width: int = 160, *, only_tables: bool = False) -> str:
    file = io.StringIO()
    console = Console(file=file, width=width, force_terminal=only_tables or None, color_system=None)
    show_parts(*(one for one in parts(report) if isinstance(one, Table) or not only_tables), console=console)
    return file.getvalue()


def asked_and_answered(at: int, error: int = 0) -> list[Wire]:
    answer = bytearray(ANSWER)
    answer[4] = error
    return [
        Wire(PacketKind.INSTRUCTION, 5, at, ASK_5, at + 10),
        Wire(PacketKind.STATUS, 5, at + 600, bytes(answer), at + 640),
    ]


def test_good_run_is_good(write):
    packets = asked_and_answered(0) + asked_and_answered(20_000)
    cycles = [Cycle(number, late=83 if number == 7 else 60) for number in range(50)]
    verdict = analyze_log(write(cycles, packets)).verdict
    assert verdict.good
    assert verdict.sentences == (
        "Good: ran for 1.0 s without a motion.",
        "The loop kept 50 Hz: 0 of 50 periods skipped, worst wake-up 83 us late.",
        "The servo answered every time.",
    )


def test_run_without_a_cycle_is_reported(write):
    report = analyze_log(write())
    assert not report.verdict.good
    assert report.verdict.sentences == (
        "Not good: the loop never ran a cycle.",
        "The loop never ran a cycle.",
    )
    assert (report.totals.latency, STEPS.numbers_of(report)) == (None, ())
    assert "torso" in shown(report)


@pytest.mark.parametrize(
    "late",
    [[4, 4, 4, 62, 151, 1001, 20_001, 3], [(number * 7919) % 2003 for number in range(2000)]],
    ids=["few", "many"],
)
def test_wake_up_latency_is_that_of_the_records(write, late):
    report = analyze_log(write([Cycle(number, late=us) for number, us in enumerate(late)]))
    latency = report.totals.latency
    assert latency is not None
    assert (latency.mean_us, latency.deviation_us) == pytest.approx((np.mean(late), np.std(late)))
    assert (latency.max_us, latency.mode_us, latency.median_us) == (
        max(late),
        mode(sorted(late)),
        median(late),
    )
    shares = latency.share_over_150_us, latency.share_over_1_ms, latency.share_over_period
    assert shares == tuple(np.mean(np.array(late) > us) for us in (150, 1000, 20_000))
    expected = np.quantile(late, (0.99, 0.999), method="inverted_cdf").tolist()
    assert [latency.p99_us, latency.p999_us] == expected
    rows = {str(row[0].text): row[1].text for row in tables(report)["periods"].rows}
    assert [rows[name] for name in ("  99 %", "  99.9 %")] == [microseconds(us) for us in expected]


def test_steps_take_the_times_of_the_records(write):
    cycles = [Cycle(n, late=50, read=5000 + n, update=100, write=300 - n) for n in range(101)]
    report = analyze_log(write(cycles))
    steps = {step.name: (step.median_us, step.p99_us, step.max_us) for step in STEPS.numbers_of(report)}
    assert steps["read"] == pytest.approx((5050, 5099, 5100))
    assert steps["update"] == pytest.approx((100, 100, 100))
    assert steps["write"] == pytest.approx((250, 299, 300))
    assert steps["cycle"] == pytest.approx((5400, 5400, 5400))
    head, idle = CONTROLLERS.numbers_of(report)
    assert (head.name, head.cycles, head.max_us) == ("head", 101, 50)
    assert (idle.name, idle.cycles) == ("idle", 0)


def test_periods_that_were_skipped_are_accounted_for(write):
    report = analyze_log(write([Cycle(0), Cycle(1), Cycle(22, skipped=20), Cycle(23)]))
    periods = report.totals.periods
    assert (periods.elapsed, periods.records, periods.skipped) == (24, 4, 20)
    assert (periods.missing, periods.agree) == (0, True)
    assert not report.verdict.good
    told = "did not keep 50 Hz: 20 of 24 periods skipped (83.33%; 10 tolerated in a short run)"
    assert told in report.verdict.sentences[1]


@pytest.mark.parametrize(
    "numbers",
    [[(0, 0), (1, 0), (4, 0)], [(0, 0), (3, 1)], [(0, 0), (3, 0), (4, 2)], [(2, 0)]],
    ids=["undeclared", "half declared", "declared late", "no beginning"],
)
def test_periods_that_vanished_are_reported(write, numbers):
    report = analyze_log(write([Cycle(number, skipped=skipped) for number, skipped in numbers]))
    assert not report.totals.periods.agree
    assert not report.verdict.good
    assert any("neither recorded nor declared skipped" in one for one in report.verdict.sentences)


@pytest.mark.parametrize(
    ("cycles", "told"),
    [
        (
            [Cycle(0), Cycle(1, read=23_000), Cycle(3, read=21_000, skipped=1)],
            "; a cycle took up to 23.40 ms, its read 23.00 ms: own work.",
        ),
        (
            [Cycle(number, late=200 if number < 3 else 10) for number in range(100)],
            "worst wake-up 200 us late, 3.0% later than 150 us.",
        ),
    ],
    ids=["a long cycle", "rough wake-ups"],
)
def test_long_cycle_and_rough_wake_ups_are_reported(write, monkeypatch, cycles, told):
    """In whichever slice of the log they are."""
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 64)
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    assert told in analyze_log(write(cycles)).verdict.sentences[1]


def test_without_known_limits_tracking_compares_with_the_goal_of_the_cycle_before(write):
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


def test_servo_that_was_silent_is_named(write):
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
    assert (elbow.servo_id, elbow.joint, elbow.asked, elbow.lost) == (5, "left_elbow_joint", 1, 0)
    assert (elbow.replies, elbow.reply_median_us, elbow.reply_max_us) == (1, 640, 640)
    assert (head.servo_id, head.joint, head.asked, head.lost, head.replies) == (21, "head_yaw_joint", 2, 2, 0)
    (bus,) = report.totals.buses
    assert (bus.instructions, bus.broadcasts, bus.replies, bus.noise_bytes) == (5, 2, 1, 3)
    assert (bus.bytes_out, bus.bytes_in) == (3 * 8 + 2 * 5, len(ANSWER) + 3)
    missing = "Replies are missing: servo 21 (head_yaw_joint) 2 of 2 times (100.00%)"
    assert report.verdict.sentences[2] == f"{missing}; 1 of 2 servos answered every time."


def test_error_bits_are_named(write):
    packets = asked_and_answered(0) + asked_and_answered(20_000, error=0x24)
    report = analyze_log(write([Cycle(number, late=60) for number in range(50)], packets))
    assert report.totals.servos[0].error_names == ("overheating", "overload")
    error = "Servos reported errors: servo 5 (left_elbow_joint): overheating, overload in 1 reply."
    assert error in report.verdict.sentences
    assert not report.verdict.good
    robot, first, *others = shown(report).splitlines()
    assert robot == "Not good: left_elbow_joint reported errors; ran for 1.0 s without a motion."
    assert first.startswith("Servos reported errors: ")
    for words in ("recorded + skipped = elapsed", "left_elbow_joint", "overload", "read", "head", "640 us"):
        assert words in "\n".join(others)


def test_errors_gaps_and_a_log_without_end_are_reported(write):
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
    counts = {event.name: event.count for event in EVENTS.numbers_of(report)}
    assert counts == {"controller_fault": 1, "recorder_gap": 1, "loop_started": 1}


@pytest.mark.parametrize(("value", "text"), [(83.4, "83 us"), (16_949.0, "16.95 ms"), (2.5e6, "2.50 s")])
def test_times_are_written_in_fitting_units(value, text):
    assert microseconds(value) == text


def test_no_line_is_longer_than_the_terminal_or_than_reads_well(write):
    text = "torque is on: " + ", ".join(f"joint_number_{number}" for number in range(30))
    events = [
        Said(EventCode.TORQUE_ON, Severity.INFO, text),
        Said(EventCode.READ_LOST, Severity.WARNING, "head (ID 21) did not answer"),
    ]
    report = analyze_log(write([Cycle(0), Cycle(1, position=0.25)], asked_and_answered(0), events))
    lines = {width: shown(report, width, only_tables=True).splitlines() for width in (60, 80, 100, 120, 200)}
    for width in (80, 100, 200):
        assert max(len(line) for line in lines[width]) <= min(width, 120)
    (servo,) = (line for line in lines[60] if line.startswith("main 5"))
    assert servo.split() == ["main", "5", "left_elbow_joint", "1", "0", "0", "640", "us", "640", "us"]
    for width in (60, 120):  # a wide terminal shows the details
        assert any("instructions" in one and "slowest" in one for one in lines[width]) == (width == 120)
    assert "head (ID 21) did not answer" in "\n".join(lines[120])
    assert "head: head (ID 21)" not in "\n".join(lines[120])
