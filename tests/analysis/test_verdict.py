"""The verdict: what a run may not have to be good, the order of findings, and one verdict everywhere."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs
from tests.analysis.judged import MS, REAL, accusing, lost, on_bus, plan, totals
from tests.kit.made_logs import loop_of
from tests.kit.totals import totals_of

from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode, EventGroup, Severity
from dxlrun.log import log_reader, log_writer
from dxlrun.log.log_reader import Log, open_log, read_log
from dxlrun.output.json import json_text
from dxlrun.run.run_log import log_header
from dxlrun.testing import plan_of, simulated_robot
from dxlrun_analysis.conduct import steering_history
from dxlrun_analysis.cycles import punctuality
from dxlrun_analysis.cycles.punctuality import Periods
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.goal_tracking import JointTracking
from dxlrun_analysis.plan_excerpt import NO_LOOP, LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.plan_excerpt import plan_of as plan_in
from dxlrun_analysis.report import analyze, analyze_log
from dxlrun_analysis.servos import exchanges as pairing
from dxlrun_analysis.servos.losses import ServoLosses
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RealTime, RunTotals, Tally
from dxlrun_analysis.verdict import judge_run
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlwire.packets import PacketKind

Make = Callable[..., Any]
TORSO = Path(__file__).parents[2] / "robots/bioloid_torso.yaml"
PLANNED = {"name": "main", "port": "/dev/ttyUSB3", "baud_rate": 1_000_000, "return_delay_ns": 500_000}
ASK = bytes.fromhex("ffff0504022406ca")
ANSWER = bytes.fromhex("ffff05080000020000000000f0")


def tolerating(share: float) -> LoggedPlan:
    return LoggedPlan(structs.replace(NO_LOOP, tolerated_skips=share))


def test_a_good_run_is_good() -> None:
    verdict = judge_run(totals())
    assert verdict.good
    assert verdict.sentences == (
        "Good: ran for 20.0 s without a motion.",
        "The loop kept 50 Hz: 0 of 1000 periods skipped, worst wake-up 80 us late.",
    )


@pytest.mark.parametrize(
    ("code", "source", "text", "sentence"),
    [
        (EventCode.PORT_LOST, "main", "main: the adapter is gone", "Bus main was lost: main: the adapter"),
        (EventCode.SERVO_LOST, "elbow", "missed 3", "Servos failed: elbow was lost."),
        (EventCode.SERVO_REBOOTED, "elbow", "rebooted", "Servos failed: elbow rebooted."),
        (EventCode.SERVO_LIMP, "elbow", "Torque Enable 0", "Servos failed: elbow lost its torque."),
        (EventCode.CONTROLLER_FAULT, "head", "no", "One error was logged; the first, of head: no"),
        (EventCode.WATCHDOG, "main", "stopped", "One error was logged; the first, of main: stopped"),
    ],
)
def test_no_run_with_a_loss_or_an_error_is_good(  # noqa: PLR0917  what is written, and fixtures
    write: Make, cycle: Make, said: Make, code: EventCode, source: str, text: str, sentence: str
) -> None:
    cycles = [cycle(number) for number in range(100)]
    verdict = analyze_log(write(cycles, events=[said(code, Severity.ERROR, text, source)])).verdict
    assert not verdict.good
    assert verdict.sentences[1].startswith(sentence)


def test_all_that_happened_to_one_servo_is_one_sentence(write: Make, cycle: Make, said: Make) -> None:
    codes = [EventCode.SERVO_LOST, EventCode.SERVO_REBOOTED, EventCode.SERVO_LOST, EventCode.SERVO_LIMP]
    events = [said(EventCode.SERVO_LOST, Severity.ERROR, "away", "wrist")]
    events += [said(code, Severity.ERROR, "", "elbow") for code in codes]
    events += [said(EventCode.SERVO_REBOOTED, Severity.ERROR, "", name) for name in ("knee", "toe")]
    sentence = analyze_log(write([cycle(0)], events=events)).verdict.sentences[1]
    assert sentence == (
        "Servos failed: elbow rebooted, was lost 2 times and lost its torque; wrist was lost; "
        "knee rebooted; and 1 more servo. Check its plugs, and whether the supply can give the current."
    )


def test_a_failure_beside_the_loop_is_the_runs(write: Make, cycle: Make) -> None:
    path = write(
        [cycle(0)], metadata={"failures": {"0": "the simulated bus exited before the end of the run"}}
    )
    verdict = analyze_log(path).verdict
    assert not verdict.good
    assert verdict.sentences[1] == "The run failed: the simulated bus exited before the end of the run."


@pytest.mark.parametrize(("skipped", "good"), [(0, True), (100, True), (101, False)])
def test_as_many_periods_may_be_skipped_as_the_file_tolerates(skipped: int, good: bool) -> None:
    account = Periods(1000, 1000 - skipped, skipped, 0, True, 50.0, 20.0, (50.0,))
    verdict = judge_run(totals(periods=account))
    assert verdict.good is good
    assert verdict.sentences[1].startswith("The loop kept" if good else "The loop did not keep 50 Hz: 101 of")
    assert judge_run(totals(periods=account, plan=tolerating(0.5))).good
    assert judge_run(totals(periods=account, plan=tolerating(0.0))).good is (skipped == 0)


def test_the_tolerance_is_that_of_the_robot_file_in_the_log(tmp_path: Path, write: Make, cycle: Make) -> None:
    robot = tmp_path / "robot.yaml"
    text = TORSO.read_text().replace("loop:\n", "loop:\n  tolerated_skips: 60 %\n")
    robot.write_text(text.replace("model: {urdf", "# {"))
    log = tmp_path / "simulated.mcap"
    simulated_robot(robot, duration_s=0.1, log=log).run()
    assert totals_of(log).plan.loop.tolerated_skips == 0.6

    path = write([cycle(0), cycle(20, skipped=19)], plan={"loop": loop_of(tolerated_skips=0.6)})
    assert analyze_log(path).verdict.good
    path.unlink()
    path = write([cycle(0), cycle(20, skipped=19)], plan={"loop": loop_of(tolerated_skips="all")})
    assert not analyze_log(path).verdict.good


@pytest.mark.parametrize(("skipped", "good"), [(10, True), (11, False)])
def test_a_short_run_may_skip_what_one_of_two_seconds_may(skipped: int, good: bool) -> None:
    short = Periods(20, 20 - skipped, skipped, 0, True, 50.0, 0.4, (50.0,))
    assert judge_run(totals(periods=short)).good is good


@pytest.mark.parametrize(("invalid", "good"), [(2, True), (3, False)])
def test_two_replies_of_a_short_run_may_be_missing(invalid: int, good: bool) -> None:
    short = Periods(20, 20, 0, 0, True, 50.0, 0.4, (50.0,))
    assert judge_run(totals(periods=short, invalid=(invalid, 0))).good is good


@pytest.mark.parametrize(("invalid", "good"), [(0, True), (10, True), (11, False), (500, False)])
def test_a_joint_may_be_unknown_in_one_cycle_of_a_hundred(invalid: int, good: bool) -> None:
    verdict = judge_run(totals(invalid=(0, invalid)))
    assert verdict.good is good
    if not good:
        assert verdict.sentences[1] == (
            f"States were invalid: wrist in {invalid / 10:.1f}% of the cycles; 1% is tolerated."
        )


def answered(joint: str, servo_id: int, asked: int, missing: int, own: int) -> ServoTraffic:
    losses = ServoLosses(asked, own, broken_off=missing - own if servo_id == 0 else 0)
    counts = (0, asked, missing, asked - missing, 0, (), 900.0, 990.0, 950.0)
    return ServoTraffic("main", servo_id, joint, *counts, losses=losses)


@pytest.mark.parametrize(("own", "waiting", "subject"), [(40, 1, "elbow"), (1, 2, "main")])
def test_invalid_states_are_those_of_the_first_servo_without_a_reply(
    own: int, waiting: int, subject: str
) -> None:
    servos = [LoggedServo(joint, at, row=at) for at, joint in enumerate(("elbow", "wrist"))]
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=servos)])
    replies = (answered("elbow", 0, 1000, 50, own), answered("wrist", 1, 1000, 50, 0))
    findings = judge_run(totals(plan=plan, invalid=(50, 50), servos=replies)).findings
    (found,) = (one for one in findings if one.code == "invalid_states")
    assert found.subject == subject
    assert found.sentence.startswith("States were invalid: elbow in 5.0%, wrist in 5.0% of the cycles, ")
    assert f"{waiting} of these joints because a preceding reply was missing" in found.sentence


@pytest.mark.parametrize("spoilt", ["", "noise", "another_host"])
def test_positions_that_the_loop_did_not_believe_are_named_where_replies_are_intact(spoilt: str) -> None:
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=[LoggedServo("elbow", 1, row=0)])])
    text = "elbow jumped by 60 deg in 10 ms, faster than it can turn: value discarded"
    events = (EventGroup(EventCode.IMPLAUSIBLE, Severity.WARNING, "elbow", 3, 5 * 10**9, text),)
    other = (accusing(spoilt, "main", share=9.0),) * bool(spoilt)
    run = totals(plan=plan, events=events, servos=on_bus("elbow", bus="main"), findings=other)
    jumped = [one for one in judge_run(run).findings if one.code == "position_jumped"]
    assert [one.sentence for one in jumped] == [f"{text}."] * (not spoilt)


def test_invalid_states_are_counted_by_joint(write: Make, cycle: Make) -> None:
    path = write([cycle(number, valid=number % 2 == 0) for number in range(100)])
    sentence = analyze_log(path).verdict.sentences[1]
    assert sentence.startswith("States were invalid: left_elbow_joint in 50.0% of the cycles;")


def test_what_hurt_most_comes_first(write: Make, cycle: Make, said: Make) -> None:
    cycles = [cycle(number + number // 5, skipped=int(number % 5 == 0 < number)) for number in range(100)]
    half = [replace(one, valid=index % 2 == 0) for index, one in enumerate(cycles)]
    tenth = [replace(one, valid=index % 10 > 0) for index, one in enumerate(cycles)]
    lost = said(EventCode.SERVO_LOST, Severity.ERROR, "", "elbow")
    gone = said(EventCode.PORT_LOST, Severity.ERROR, "unplugged", "main")

    def shown(cycles: list[Any], *events: Any) -> list[str]:
        path = write(cycles, events=events)
        sentences = analyze_log(path).verdict.sentences
        path.unlink()
        return [sentence.split(maxsplit=2)[1] for sentence in sentences[1:]]

    assert shown(half) == ["were", "loop"]  # 50 % of the states, 16 % of the periods
    assert shown(tenth) == ["loop", "were"]
    assert shown(half, lost, gone) == ["main", "failed:", "were", "loop"]


def test_findings_are_sorted_and_decide_whether_a_run_was_good() -> None:
    remark, cause, loss = (
        Finding(code, subject, f"{code}.", remedy, rank)
        for code, subject, remedy, rank in (
            ("oscillates", "elbow", "", Rank.REMARK),
            ("supply", "wrist", "Mend it.", Rank.CAUSE),
            ("silent", "foot", "", Rank.SERVO),
        )
    )
    verdict, bad = (judge_run(totals(findings=found)) for found in ((remark, cause), (remark, cause, loss)))
    assert (verdict.good, bad.good) == (True, False)
    assert verdict.sentences[1] == "supply. Mend it."
    assert any(one.startswith("oscillates.") for one in verdict.sentences[2:])
    codes = {"silent", "supply", "oscillates"}
    assert [one.code for one in bad.findings if one.code in codes] == ["silent", "supply", "oscillates"]
    shown = json.loads(json_text(verdict))
    assert list(shown) == ["good", "word", "sentences", "findings"]
    told = {"code": "supply", "subject": "wrist", "sentence": "supply.", "remedy": "Mend it."}
    assert shown["findings"][1] == told | {"rank": 8, "share": 0.0}


LOST, REBOOTED = lost("elbow"), lost("elbow", code=EventCode.SERVO_REBOOTED)


# Servos and buses that are lost


def test_a_servo_that_is_lost_alone_is_told_with_its_angle() -> None:
    joint = JointTracking("elbow", 0, 0.0, 0, None, None, None, None, None, None, lost_at=0.5)
    for events, told in (((LOST,), "elbow was lost, at 29 deg."), ((LOST, lost("wrist")), "wrist was lost.")):
        sentences = [one.sentence for one in judge_run(totals(events=events, tracking=(joint,))).findings]
        assert any(sentence.endswith(told) for sentence in sentences)


def test_why_the_start_was_refused_is_said_first() -> None:
    text = "knee is at 70.0 deg\nelbow has angle limits 1850..2246"
    refused = EventGroup(EventCode.SETUP, Severity.ERROR, "loop", 1, MS, text)
    found = judge_run(
        replace(totals(events=(refused,)), periods=Periods(0, 0, 0, 0, True, 50.0, 0.0, ()))
    ).findings
    why = "knee is at 70.0 deg; elbow has angle limits 1850..2246"
    assert found[1].sentence == f"The loop never ran a cycle: {why}."


def test_a_servo_that_answers_again_and_is_not_taken_back_is_told_with_why() -> None:
    again, buses = lost("elbow", count=3), plan(REAL, REAL)
    why = "answers again, but is not ready: elbow is model number 1030, not a XM430-W350 (1020)"
    returns = {"elbow": ["sends garbled or double replies", why]}
    verdict = judge_run(totals(events=(lost("wrist"), again), returns=returns, plan=buses))
    (servo,) = (one for one in verdict.findings if one.code == "servo_lost")
    told = f"Servos failed: elbow was lost; wrist was lost. elbow {why}."
    assert (servo.subject, servo.sentence) == ("elbow", told)
    assert "the values of the robot file" in servo.remedy


@pytest.mark.parametrize("port", ["/dev/ttyUSB0", "sim"])
def test_what_to_do_about_a_servo_that_answers_twice_is_told_of_a_real_one(port: str) -> None:
    returns = {
        "elbow": ["sends garbled or double replies: do two servos have its ID? If not, check its cable"]
    }
    verdict = judge_run(totals(events=(lost("elbow"),), returns=returns, plan=plan(port, port)))
    told = " ".join(verdict.sentences)
    assert "elbow sends garbled or double replies" in told
    assert ("check its cable" in told.lower()) is (port != "sim")


@pytest.mark.parametrize(
    ("at_ms", "told"),
    [
        ((5, 30, 60, 90), {"machine": "buses bus0 and bus1 were lost at once"}),
        ((5, 30, 900, 950), {"bus0": "All 2 servos of bus bus0", "bus1": "All 2 servos of bus bus1"}),
        ((5, 30, 60, None), {"bus0": "All 2 servos of bus bus0"}),
        ((5, None, 60, None), {}),
    ],
    ids=["both at once", "one after the other", "one of them", "a servo each"],
)
def test_buses_that_fall_silent_at_once_are_not_accused_one_by_one(
    at_ms: tuple[int | None, ...], told: dict[str, str]
) -> None:
    joints = ("elbow", "wrist", "hip", "knee")
    servos = on_bus(*joints[:2]) + on_bus(*joints[2:], bus="bus1")
    events = tuple(lost(joint, at) for joint, at in zip(joints, at_ms, strict=True) if at is not None)
    verdict = judge_run(totals(events=events, servos=servos, plan=plan(REAL, REAL)))
    found = {one.subject: one for one in verdict.findings if one.sentence.startswith("All ")}
    assert found.keys() == told.keys()
    assert all(told[subject] in one.sentence for subject, one in found.items())
    assert {one.code for one in found.values()} <= {"servo_lost"}
    assert all(one.remedy for one in found.values())
    assert not any(one.remedy for one in verdict.findings if one.subject in joints) or not told


def test_servos_of_a_lost_bus_are_not_accused() -> None:
    gone = EventGroup(EventCode.PORT_LOST, Severity.ERROR, "bus0", 1, 4 * MS, "gone")
    for events, accused in (((gone, lost("elbow")), False), ((lost("elbow"),), True)):
        verdict = judge_run(totals(events=events, servos=on_bus("elbow", "wrist"), plan=plan(REAL)))
        (servo,) = (one for one in verdict.findings if one.code == "servo_lost")
        assert bool(servo.remedy) is accused
        assert ("bus bus0 was lost" in verdict.sentences[0]) is not accused
        assert ("elbow was lost" in verdict.sentences[0]) is accused


@pytest.mark.parametrize(
    ("events", "shared"),
    [
        ((lost("elbow"), lost("wrist", 400)), True),
        ((lost("elbow"), lost("wrist", 600)), False),
        ((lost("elbow"),), False),
        ((lost("elbow"), lost("wrist", count=2)), False),
        ((lost("elbow"), lost("wrist"), lost("hand")), False),
        ((lost("elbow"), lost("wrist", code=EventCode.SERVO_REBOOTED)), False),
        ((REBOOTED, lost("wrist", code=EventCode.SERVO_REBOOTED), lost("wrist", 9)), True),
        ((lost("elbow", code=EventCode.SERVO_LIMP), lost("wrist", code=EventCode.SERVO_LIMP)), False),
        ((lost("elbow"), lost("far")), False),
    ],
    ids=["at once", "later", "one", "again", "all", "one rebooted", "both rebooted", "limp", "two buses"],
)
def test_servos_that_are_lost_at_once_share_a_cable(events: tuple[EventGroup, ...], shared: bool) -> None:
    servos = (*on_bus("elbow", "wrist", "hand"), *on_bus("far", "other", "third", bus="bus1"))
    verdict = judge_run(totals(events=events, servos=servos, plan=plan(REAL)))
    assert any("they share a supply or a cable" in one.sentence for one in verdict.findings) is shared


def test_why_a_servo_did_not_come_back_is_told_where_few_were_lost() -> None:
    for joints in (("elbow", "wrist"), ("elbow", "wrist", "hand")):
        returns = {"elbow": ["sends garbled or double replies", "answers too late"]}
        servos = on_bus("elbow", "wrist", "hand", "head")
        events = tuple(lost(joint, 400 * at) for at, joint in enumerate(joints))
        verdict = judge_run(totals(events=events, returns=returns, servos=servos, plan=plan(REAL)))
        assert any("elbow answers too late." in one.sentence for one in verdict.findings) is (
            len(joints) == 2
        )


@pytest.mark.parametrize(
    ("data", "granted"),
    [
        (b'{"request":"scheduler","granted":true}', True),
        (b'{"request":"scheduler","granted":false}', False),
        (b'{"request":"locked memory","granted":true}', False),
        (b"", False),
    ],
)
def test_what_was_granted_is_read_from_the_log(write: Make, said: Make, data: bytes, granted: bool) -> None:
    about = {"scheduler": {"policy": "round_robin"}, "kernel": {"version": "#1 SMP PREEMPT_RT"}}
    path = write(events=[said(EventCode.SCHEDULER, Severity.INFO, "in words", "loop", data)], metadata=about)
    assert totals_of(path).real_time == RealTime(True, granted, True)


def exchanges(wire: Make, took_us: int, count: int = 25) -> list[Any]:
    packets = []
    for at in range(0, count * 50_000, 50_000):
        packets.append(wire(PacketKind.INSTRUCTION, 5, at, ASK))
        packets.append(wire(PacketKind.STATUS, 5, at + took_us - 10, ANSWER, at + took_us))
    return packets


@pytest.mark.parametrize(
    ("extra_us", "latency_ms", "shown"),
    [
        (300, 1, ""),
        (2900, 1, ""),
        (3100, 1, "Replies on bus main are delayed by 3.1 ms (planned for the adapter: 1 ms"),
        (
            15_800,
            1,
            "a latency timer of 16 ms: 100% of its exchanges. `echo 1 | sudo tee /sys/bus/usb-serial/",
        ),
        (15_800, 16, ""),
    ],
)
def test_replies_are_compared_with_the_plan(  # noqa: PLR0917  what is written, and fixtures
    write: Make, cycle: Make, wire: Make, extra_us: int, latency_ms: int, shown: str
) -> None:
    wire_us = 10 * (len(ASK) + len(ANSWER)) + 500
    plan = {"buses": [PLANNED | {"latency_ns": latency_ms * MS}]}
    report = analyze_log(write([cycle(0)], exchanges(wire, wire_us + extra_us), plan=plan))
    assert report.totals.buses[0].extra_us == pytest.approx(extra_us)
    assert report.verdict.good
    (late,) = [one for one in report.verdict.sentences if one.startswith("Replies on")] or [""]
    assert shown in late
    assert ("latency timer" in late) is (extra_us > 12_000 and latency_ms == 1)
    assert "cable" not in late


def test_a_request_that_waits_for_the_line_is_not_late(write: Make, cycle: Make, wire: Make) -> None:
    goals = bytes.fromhex("ffffff") + bytes(500)  # 5 ms of the line
    packets = []
    for at in range(0, 250_000, 50_000):
        packets.append(wire(PacketKind.INSTRUCTION, 254, at, goals))
        packets.append(wire(PacketKind.INSTRUCTION, 5, at + 10, ASK))
        packets.append(wire(PacketKind.STATUS, 5, at + 5900, ANSWER))
    plan = {"buses": [PLANNED | {"latency_ns": MS}]}
    extra_us = analyze_log(write([cycle(0)], packets, plan=plan)).totals.buses[0].extra_us
    assert extra_us is not None
    assert extra_us < 500


# One verdict


@pytest.fixture(scope="module")
def storm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a stormy run, in small chunks, with streams, pauses and refusals."""
    path = tmp_path_factory.mktemp("storm") / "run.mcap"
    robot = simulated_robot(TORSO, duration_s=4.0, log=path)
    script = FaultScript(
        [parse_fault("storm seed=3 faults=12 within=3s kinds=lose,silence,noise,reboot at=300ms")]
    )
    script.attach(robot.buses)
    asked = (
        *((at, "rate", b'{"rate": 40}') for at in (600, 1900)),
        *((at, "pause", b"") for at in (700, 2000)),
        (750, "pause", b""),
        *((at, "resume", b"") for at in (900, 2500)),
    )
    for number, (at_ms, kind, data) in enumerate(asked, start=1):
        command = CommandMessage(number, "", kind, data, "anna")
        robot.buses[0].at(at_ms * MS, lambda command=command: robot.inbox.waiting.append(command))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_writer, "CHUNK_BYTES", 4096)
        robot.run()
    return path


def test_a_log_counted_in_slices_is_the_log_counted_as_a_whole(
    storm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (pairing, punctuality, steering_history):
        monkeypatch.setattr(module, "DISORDER_NS", 200 * MS)
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    slices: list[Log] = []
    slices.extend(open_log(storm).slices())
    assert len(slices) > 20
    assert max(len(one.cycles) for one in slices) < 20
    tally = Tally()
    tally.add_slice(read_log(storm))
    whole = tally.totals(read_log(storm))
    assert totals_of(storm) == whole
    assert whole.servos[0].lost
    assert len(whole.pauses) == 2
    assert whole.events


def test_an_event_is_not_cut_where_a_slice_ends(
    write: Make, said: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 64)
    text = "Traceback\n" + "x" * 2000 + "\nValueError: the end"
    events = [
        said(EventCode.CONTROLLER_FAULT, Severity.ERROR, text),
        said(EventCode.LOOP_STARTED, Severity.INFO, ""),
    ]
    path = write(events=events)
    assert totals_of(path).events == analyze_totals(path).events
    assert totals_of(path).events[0].text == text


def analyze_totals(path: Path) -> RunTotals:
    log = read_log(path)
    tally = Tally()
    tally.add_slice(log)
    return tally.totals(log)


def test_page_and_json_and_run_have_the_same_verdict(storm: Path) -> None:
    from dxlrun_analysis.page.report_page import analyzed_page

    log = read_log(storm)
    report = analyze(log)
    said = judge_run(totals_of(storm))
    assert not said.good
    assert report.verdict == said
    shown = json.loads(json_text(report.numbers))["verdict"]
    assert (shown["good"], tuple(shown["sentences"])) == (said.good, said.sentences)
    _, text = analyzed_page(log)
    assert f"<h1>{said.findings[0].sentence}</h1>" in text
    assert all(f"<p>{finding.sentence}" in text for finding in said.findings[1:])


def test_damage_is_reported_of_a_scanned_log_too(storm: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    data = storm.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert judge_run(totals_of(cut)) == analyze_log(cut).verdict
    assert any("log is incomplete" in sentence for sentence in judge_run(totals_of(cut)).sentences)


@pytest.mark.parametrize("virtual", [False, True])
def test_a_simulated_bus_is_known_when_the_link_to_its_port_is_gone(
    write: Make, cycle: Make, tmp_path: Path, virtual: bool
) -> None:
    master, line = os.openpty()
    link = tmp_path / "robot"
    link.symlink_to(os.ttyname(line))
    arguments = {"port": "/dev/ttyUSB0" if virtual else str(link)}
    try:
        header = log_header(plan_of("robots/single_joint.yaml", arguments=arguments), 0, virtual=virtual)
    finally:
        link.unlink()
        os.close(master)
        os.close(line)
    plan = json.loads(header.attachments["plan.json"])
    for run, simulated in (({}, False), (header.metadata["run"], True)):
        path = write([cycle(0)], plan=plan, metadata={"run": run})
        assert plan_in(read_log(path)).is_simulated("main") is simulated
        path.unlink()


@pytest.mark.parametrize("code", [EventCode.PORT_LOST, EventCode.SERVO_LOST, EventCode.DEVICE_LOST])
def test_servos_that_were_lost_did_not_answer_every_time(code: EventCode) -> None:
    servo = ServoTraffic("bus0", 1, "elbow", 9, 9, 0, 9, 0, (), 0.0, 0.0)
    lost = EventGroup(code, Severity.ERROR, "elbow", 1, 5 * MS, "gone: was it unplugged?")
    said = " ".join(judge_run(totals(events=(lost,), servos=(servo,))).sentences)
    assert "answered every time" not in said
    assert "?." not in said
    assert "answered every time" in " ".join(judge_run(totals(servos=(servo,))).sentences)
