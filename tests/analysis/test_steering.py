"""Analysis of steered runs: periods are counted through other rates and pauses, and printed to people."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs
from rich.console import Console
from tests.kit.virtual_run import Asked, VirtualRun, ask, rate, send, switch

from dxlrun.channels.commands import CommandMessage
from dxlrun.log.log_reader import Log, read_log
from dxlrun.output.terminal import show_parts
from dxlrun_analysis.cycles.punctuality import cycle_periods_ns
from dxlrun_analysis.report import analyze, parts, tables

MS = 1_000_000
ROBOT = """\
name: pair
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
controllers:
  states: {type: joint_state_broadcaster}
  head: {type: joint_group_position_controller, joints: [pan, tilt]}
  tail: {type: joint_group_position_controller, joints: [tilt], active: false}
"""
INACTIVE = "head is not active; activate it by `dxlrun switch --activate head`"
STREAMED = send("head", "positions", 0.1, 0.1, lease_ns=50 * MS)
COMMAND = send("head", "positions", 0.1, 0.1)
HAND_OVER = switch(["tail"], ["head"])
ASKED: Asked = {
    5: [rate(100)],
    15: [ask("pause"), ask("pause")],
    25: [rate(50)],
    30: [ask("resume")],
    **{cycle: [STREAMED] for cycle in range(31, 39)},
    50: [HAND_OVER, STREAMED],
    51: [STREAMED, send("tail", "positions", 0.1)],
    55: [CommandMessage(0, "", "load", b'{"name":', "mallory"), ask("stop")],
}


def run(directory: Path, asked: Asked) -> Log:
    return read_log(VirtualRun.of_text(directory, ROBOT, 2.0, asked=asked).logged())


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return run(tmp_path_factory.mktemp("steered"), ASKED)


@pytest.fixture(scope="module")
def report(log):
    return analyze(log)


def test_periods_are_those_of_each_cycle(log, report):
    expected = [20 * MS] * 5 + [10 * MS] * 20 + [20 * MS] * 31
    assert cycle_periods_ns(log).tolist() == expected
    account = report.totals.periods
    assert (account.elapsed, account.records, account.skipped, account.missing) == (56, 56, 0, 0)
    assert account.agree
    assert account.seconds == pytest.approx(sum(expected) / 1e9)
    assert account.rates_hz == (50.0, 100.0)


def test_verdict_has_it(report):
    robot, loop, steered, *_ = report.verdict.sentences
    assert robot.startswith("Good: moved by clients within ")
    assert loop == "The loop kept 50 Hz and 100 Hz: 0 of 56 periods skipped, on virtual time."
    assert steered == (
        "Requests of clients: 2 rate requests, 1 pause request, 1 switch request, 1 command, "
        "1 stop request, 1 stream of 8 set-points, 3 refused; the loop was paused for 200.00 ms."
    )


def test_table_has_each_request_with_its_origin(report):
    rows = [[cell.text for cell in row[1:]] for row in tables(report)["steering"].rows]
    assert rows == [
        ["5", "rate 100 Hz", "anna", "done"],
        ["15", "pause", "anna", "done"],
        ["15", "pause", "anna", "refused: the loop is paused already"],
        ["25", "rate 50 Hz", "anna", "done"],
        ["30", "resume", "anna", "done"],
        ["31", "stream of positions for head, 8 set-points, lease 50 ms", "anna", "done"],
        ["50", "switch activate tail; deactivate head", "anna", "done"],
        ["50", "stream of positions for head, 2 set-points, lease 50 ms", "anna", f"refused: {INACTIVE}"],
        ["51", "positions for tail", "anna", "done"],
        ["55", 'load {"name":', "mallory", rows[-2][-1]],
        ["55", "stop", "anna", "done"],
    ]
    assert report.totals.acts[1].time_s == pytest.approx(0.2)


def test_pause_is_counted_in_periods_and_in_seconds(report):
    (pause,) = report.totals.pauses
    assert (pause.begin_s, pause.end_s) == pytest.approx((0.2, 0.4))
    assert pause.periods == 15
    file = io.StringIO()
    show_parts(*parts(report), console=Console(file=file, width=160))
    shown = file.getvalue()
    assert "periods paused" in shown
    assert "pair, 50 Hz and 100 Hz, 0.9 s" in shown
    assert "switch activate tail; deactivate head" in shown


def test_refusal_is_that_of_its_command_among_equal_ones_of_a_cycle(tmp_path):
    report = analyze(run(tmp_path, {5: [COMMAND, HAND_OVER, COMMAND]}))
    rows = [[cell.text for cell in row[2:]] for row in tables(report)["steering"].rows]
    assert [row[-1] for row in rows] == ["done", "done", f"refused: {INACTIVE}"]


def test_streams_of_two_clients_are_two(tmp_path):
    other = structs.replace(STREAMED, origin="bob")
    report = analyze(run(tmp_path, {cycle: [other if cycle % 2 else STREAMED] for cycle in range(5, 9)}))
    assert {row[3].text for row in tables(report)["steering"].rows} == {"anna", "bob"}


@pytest.mark.parametrize(
    ("later", "ends"),
    [
        ({}, "; the lease of the stream for head expired at 0.4 s, and its joints were held"),
        ({25: [send("head", "positions", 0.2, 0.2)]}, ""),
        ({25: [HAND_OVER]}, "; the lease of the stream for head expired at 0.4 s"),
        ({cycle: [STREAMED] for cycle in range(18, 100)}, ""),
    ],
    ids=["held", "asked again", "handed over", "to the end"],
)
def test_stream_that_ended_by_its_lease_is_told(tmp_path, later, ends):
    stream = {cycle: [STREAMED] for cycle in range(5, 18)}
    report = analyze(run(tmp_path, {**stream, **later}))
    (steered,) = (one for one in report.verdict.findings if one.code == "steered")
    assert steered.remedy == ""
    sentence = steered.sentence.removesuffix(".")
    assert sentence.endswith(ends)
    assert bool(ends) == (" expired at " in sentence)
    assert (report.verdict.findings[1] == steered) is ends.endswith("its joints were held")


def test_cycle_is_measured_by_its_own_period(tmp_path):
    log = run(tmp_path, {5: [rate(200)], 60: [rate(25)]})
    whole = log.cycles["written_ns"] - log.cycles["woken_ns"]
    stretched = log.cycles.copy()
    stretched["written_ns"][30] += 8 * MS - whole[30]
    stretched["written_ns"][70] += 16 * MS
    report = analyze(replace(log, cycles=stretched))
    sentence = next(one for one in report.verdict.sentences if one.startswith("The loop kept"))
    assert sentence.endswith("; a cycle took up to 8000 us, its write 7400 us: own work.")


def test_pause_that_no_client_ends_lasts_until_its_lease_expires(tmp_path, monkeypatch):
    monkeypatch.setattr("dxlrun.control.steering.PAUSE_LEASE_NS", 200 * MS)
    log = run(tmp_path, {10: [ask("pause")], 40: [ask("pause")], 45: [ask("resume")], 60: [ask("pause")]})
    pauses = [(round(one.begin_s, 2), one.periods) for one in analyze(log).totals.pauses]
    assert pauses == [(0.2, 11), (0.8, 5), (1.2, 11)]


def test_pause_that_the_run_ends_in_lasts_to_the_end(tmp_path):
    (pause,) = analyze(run(tmp_path, {10: [ask("pause")], 20: [ask("stop")]})).totals.pauses
    assert pause.periods == 11
    without = analyze(run(tmp_path, {20: []}))
    assert (without.totals.acts, without.totals.pauses) == ((), ())
    assert not any("steered" in sentence for sentence in without.verdict.sentences)


def test_page_shows_it(log, report):
    from dxlrun_analysis.page.report_page import analyzed_page

    _, text = analyzed_page(log)
    assert 'id="steering"' in text
    assert "switch activate tail; deactivate head" in text
    assert "Shaded: the loop was paused. Dotted lines: controllers, rate or policy were changed." in text
    assert text.count('"BoxAnnotation"') >= 4  # and those that tools draw with
