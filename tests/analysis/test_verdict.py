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
from tests.kit.made_logs import loop_of
from tests.kit.totals import totals_of

from dxlrun.channels.commands import Command
from dxlrun.channels.events import EventCode, EventGroup, Severity
from dxlrun.channels.packets import PacketKind
from dxlrun.log import log_writer, reader
from dxlrun.log.reader import Log, open_log, read_log
from dxlrun.output.json import json_text
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.machine_load import MachineLoad
from dxlrun.run.run_log import log_header
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript
from dxlrun.testing import plan_of, simulated_robot
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.conduct import steering
from dxlrun_analysis.cycles import latency
from dxlrun_analysis.cycles.latency import Latency, Periods
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.tracking import JointTracking
from dxlrun_analysis.plan import NO_LOOP, LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.plan import plan_of as plan_in
from dxlrun_analysis.report import analyze, analyze_log
from dxlrun_analysis.servos import exchanges as pairing
from dxlrun_analysis.servos.losses import ServoLosses
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RealTime, RunTotals, Tally
from dxlrun_analysis.verdict import judge

Make = Callable[..., Any]
TORSO = Path(__file__).parents[2] / "robots/bioloid_torso.yaml"
MS = 1_000_000
PLANNED = {"name": "main", "port": "/dev/ttyUSB3", "baud_rate": 1_000_000, "return_delay_ns": 500_000}
ASK = bytes.fromhex("ffff0504022406ca")
ANSWER = bytes.fromhex("ffff05080000020000000000f0")


def totals(**changed: Any) -> RunTotals:
    """Totals of a good run, changed."""
    account = Periods(1000, 1000, 0, 0, True, 50.0, 20.0, (50.0,))
    good = RunTotals(account, Latency(80.0, 10.0, 5.0, 9, 0.0, 0.0, 0.0), joints=("elbow", "wrist"))
    return replace(good, **changed)


def tolerating(share: float) -> LoggedPlan:
    return LoggedPlan(structs.replace(NO_LOOP, tolerated_skips=share))


def test_a_good_run_is_good() -> None:
    verdict = judge(totals())
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
        (EventCode.SERVO_REBOOTED, "elbow", "started anew", "Servos failed: elbow rebooted."),
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
    path = write([cycle(0)], metadata={"failures": {"0": "the simulated bus ended before the run did"}})
    verdict = analyze_log(path).verdict
    assert not verdict.good
    assert verdict.sentences[1] == "The run failed: the simulated bus ended before the run did."


@pytest.mark.parametrize(("skipped", "good"), [(0, True), (100, True), (101, False)])
def test_as_many_periods_may_be_skipped_as_the_file_tolerates(skipped: int, good: bool) -> None:
    account = Periods(1000, 1000 - skipped, skipped, 0, True, 50.0, 20.0, (50.0,))
    verdict = judge(totals(periods=account))
    assert verdict.good is good
    assert verdict.sentences[1].startswith("The loop kept" if good else "The loop did not keep 50 Hz: 101 of")
    assert judge(totals(periods=account, plan=tolerating(0.5))).good
    assert judge(totals(periods=account, plan=tolerating(0.0))).good is (skipped == 0)


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
    assert judge(totals(periods=short)).good is good


@pytest.mark.parametrize(("invalid", "good"), [(2, True), (3, False)])
def test_two_replies_of_a_short_run_may_be_missing(invalid: int, good: bool) -> None:
    short = Periods(20, 20, 0, 0, True, 50.0, 0.4, (50.0,))
    assert judge(totals(periods=short, invalid=(invalid, 0))).good is good


@pytest.mark.parametrize(("invalid", "good"), [(0, True), (10, True), (11, False), (500, False)])
def test_a_joint_may_be_unknown_in_one_cycle_of_a_hundred(invalid: int, good: bool) -> None:
    verdict = judge(totals(invalid=(0, invalid)))
    assert verdict.good is good
    if not good:
        assert verdict.sentences[1] == (
            f"States were invalid: wrist in {invalid / 10:.1f}% of the cycles; 1% tolerated."
        )


def answered(joint: str, servo_id: int, asked: int, missing: int, own: int) -> ServoTraffic:
    losses = ServoLosses(asked, own, own, broken_off=missing - own if servo_id == 0 else 0)
    counts = (0, asked, missing, asked - missing, 0, (), 900.0, 990.0, 950.0)
    return ServoTraffic("main", servo_id, joint, *counts, losses=losses)


@pytest.mark.parametrize(
    ("own", "subject", "sentence"),
    [
        (
            40,
            "elbow",
            "States were invalid: elbow in 5.0% of the cycles, and of 1 more because replies before",
        ),
        (
            1,
            "main",
            "States of 2 joints on bus main were invalid, in up to 5.0% of the cycles, as whole chains",
        ),
    ],
)
def test_invalid_states_are_those_of_the_first_servo_without_a_reply(
    own: int, subject: str, sentence: str
) -> None:
    servos = [LoggedServo(joint, at, row=at) for at, joint in enumerate(("elbow", "wrist"))]
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=servos)])
    replies = (answered("elbow", 0, 1000, 50, own), answered("wrist", 1, 1000, 50, 0))
    worse = tuple(accusing("joint_shakes", joint, rank=Rank.CAUSE) for joint in ("elbow", "wrist"))
    findings = judge(totals(plan=plan, invalid=(50, 50), servos=replies, findings=worse)).findings
    (found,) = (one for one in findings if one.code == "invalid_states")
    assert found.subject == subject
    assert found.sentence.startswith(sentence)
    assert ("servo 0 (elbow)" in found.sentence) is (subject == "main")
    # what moves worse while replies before its own are missing is not accused
    blamed = {one.subject for one in findings if one.code == "joint_shakes" and one.remedy}
    assert blamed == ({"elbow"} if subject == "elbow" else set())


def test_states_of_chains_are_no_open_question_where_their_first_servo_is_accused() -> None:
    servos = [LoggedServo(joint, at, row=at) for at, joint in enumerate(("elbow", "wrist"))]
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=servos)])
    replies = (answered("elbow", 0, 1000, 50, 1), answered("wrist", 1, 1000, 50, 0))
    for code, is_open in (("lossy_servo", False), ("hot_joint", True)):
        run = totals(plan=plan, invalid=(50, 50), servos=replies, findings=(accusing(code, "elbow"),))
        (found,) = (one for one in judge(run).findings if one.code == "invalid_states")
        assert ("lost on the line" in found.sentence) is is_open
        assert ("missing behind servo 0 (elbow);" in found.sentence) is not is_open


@pytest.mark.parametrize("spoilt", ["", "noise", "another_host"])
def test_positions_that_the_loop_did_not_believe_are_named_where_replies_are_intact(spoilt: str) -> None:
    plan = LoggedPlan(buses=[LoggedBus(name="main", servos=[LoggedServo("elbow", 1, row=0)])])
    text = "elbow jumped by 60 deg in 10 ms, faster than it can turn: not believed"
    events = (EventGroup(EventCode.IMPLAUSIBLE, Severity.WARNING, "elbow", 3, 5 * 10**9, text),)
    other = (Finding(spoilt, "main", "It is.", rank=Rank.CAUSE),) * bool(spoilt)
    verdict = judge(totals(plan=plan, events=events, invalid=(30, 0), findings=other))
    jumped = [one for one in verdict.findings if one.code == "position_jumped"]
    assert [one.subject for one in jumped] == ["elbow"] * (not spoilt)
    first = "states of elbow were often invalid" if spoilt else "positions of elbow were often not believed"
    assert first in verdict.sentences[0]


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


def test_findings_are_sorted_and_say_whether_a_run_was_good() -> None:
    remark, cause, loss = (
        Finding(code, subject, f"{code}.", remedy, rank)
        for code, subject, remedy, rank in (
            ("remark", "elbow", "", Rank.REMARK),
            ("cause", "wrist", "Mend it.", Rank.CAUSE),
            ("loss", "elbow", "", Rank.SERVO),
        )
    )
    verdict, bad = (judge(totals(findings=found)) for found in ((remark, cause), (remark, cause, loss)))
    assert (verdict.good, bad.good) == (True, False)
    assert verdict.sentences[1] == "cause. Mend it."
    assert "remark." in verdict.sentences[2:]
    assert [one for one in bad.findings if one in {loss, cause, remark}] == [loss, cause, remark]
    shown = json.loads(json_text(verdict))
    assert list(shown) == ["good", "word", "sentences", "findings"]
    assert shown["findings"][1] == {
        "code": "cause",
        "subject": "wrist",
        "sentence": "cause.",
        "remedy": "Mend it.",
        "rank": 8,
        "share": 0.0,
    }


def test_findings_of_other_rooms_are_in_the_verdict() -> None:
    slow = Finding("slow_controller", "head", "head is slow.", rank=Rank.SHARE_CAUSE)
    assert judge(totals(findings=(slow,))).findings[1] == slow


# What helps


@pytest.mark.parametrize(
    ("real_time", "helps"),
    [
        (RealTime(), "`loop: {scheduler: {policy: round_robin}}` in the robot file helps."),
        (
            RealTime(requested=True),
            "The real-time scheduler that the robot file asks for was not granted, and",
        ),
        (
            RealTime(requested=True, granted=True),
            "The real-time scheduler was granted; a real-time kernel helps.",
        ),
        (RealTime(True, True, True), "Scheduler and kernel are real-time ones, so it is the machine"),
    ],
)
def test_no_scheduler_is_recommended_that_was_granted(real_time: RealTime, helps: str) -> None:
    rough = Latency(900.0, 100.0, 50.0, 9, 0.03, 0.0, 0.0)
    verdict = judge(totals(latency=rough, real_time=real_time))
    assert verdict.good
    assert f"3.0% came later than 150 us. {helps}" in verdict.sentences[2]


# A machine that is too busy, and servos that are simulated

REAL, SIMULATED = "/dev/ttyUSB0", "sim"
BUSY = Causes(load=MachineLoad(10, busy_s=10, no_idle_core_s=9, waited_s=2))


def lost(joint: str, at_ms: int = 5, count: int = 1, code: EventCode = EventCode.SERVO_LOST) -> EventGroup:
    return EventGroup(code, Severity.ERROR, joint, count, at_ms * MS, "missed 3")


LOST, REBOOTED = lost("elbow"), lost("elbow", code=EventCode.SERVO_REBOOTED)


def plan(*ports: str) -> LoggedPlan:
    """Buses `bus0`, `bus1` ... with a servo each: elbow, wrist; and a controller."""
    joints = (LoggedServo(joint, number) for number, joint in enumerate(("elbow", "wrist"), 1))
    buses = [LoggedBus(f"bus{n}", port, servos=[next(joints)]) for n, port in enumerate(ports)]
    arm = ControllerPlan("arm", "", "", "{}", (), (), (), active=True, every=1)
    return LoggedPlan(structs.replace(NO_LOOP, controllers=(arm,)), buses)


def accusing(code: str, subject: str = "bus0", share: float = 0.5, rank: Rank = Rank.CAUSE) -> Finding:
    return Finding(code, subject, f"{subject} has it.", "Exchange the cable.", rank, share)


@pytest.mark.parametrize("port", [REAL, SIMULATED])
def test_a_busy_machine_stands_for_what_it_explains(port: str) -> None:
    explained = ("late_replies", "slow_servo", "lossy_line", "loose_cable", "missing_replies")
    found = (*map(accusing, explained), accusing("late_exchanges", share=1.0))  # of the excess of few cycles
    verdict = judge(totals(findings=found, causes=BUSY, plan=plan(port)))
    _, machine, loop = verdict.findings
    assert (machine.code, machine.subject, loop.code) == ("busy_machine", "machine", "rate_kept")
    assert machine.sentence == (
        "The machine was too busy: no core was idle in 9 of 10 s, the loop waited for a core in 2 of 10 s."
    )
    assert machine.remedy.startswith("End other programs")
    assert ("--virtual" in machine.remedy) is (port == SIMULATED)
    assert verdict.good


@pytest.mark.parametrize(
    "finding",
    [
        accusing("hot_joint", "elbow"),
        accusing("noise"),
        accusing("late_replies", share=1.0),
        accusing("bus_lost", rank=Rank.LINE),
    ],
    ids=lambda one: one.code,
)
def test_a_busy_machine_is_no_excuse_for_what_it_does_not_do(finding: Finding) -> None:
    half = replace(BUSY, load=MachineLoad(10, busy_s=5, no_idle_core_s=5))
    verdict = judge(totals(findings=(finding,), causes=half, plan=plan(REAL)))
    assert [one.code for one in verdict.findings] == ["robot", finding.code, "rate_kept"]
    assert verdict.findings[1].remedy == "Exchange the cable."


def test_a_machine_that_was_busy_without_effect_is_not_told() -> None:
    assert [one.code for one in judge(totals(causes=BUSY)).findings] == ["robot", "rate_kept"]


@pytest.mark.parametrize(
    ("port", "event", "codes"),
    [
        (SIMULATED, LOST, ["busy_machine", "servo_lost", "rate_kept"]),
        (SIMULATED, lost("elbow", code=EventCode.DEVICE_LOST), ["busy_machine", "device_lost", "rate_kept"]),
        (REAL, LOST, ["servo_lost", "rate_kept"]),
        (SIMULATED, REBOOTED, ["servo_rebooted", "rate_kept"]),
    ],
)
def test_a_simulated_servo_that_a_busy_machine_lost_makes_a_run_bad_and_is_not_accused(
    port: str, event: EventGroup, codes: list[str]
) -> None:
    verdict = judge(totals(events=(event,), causes=BUSY, plan=plan(port)))
    assert not verdict.good
    assert [one.code for one in verdict.findings[1:]] == codes
    failed = next(one for one in verdict.findings if one.rank == Rank.SERVO)
    assert bool(failed.remedy) is (codes[0] != "busy_machine")


@pytest.mark.parametrize("subject", ["elbow", "bus0", "bus0 7", "joint of two servos"])
def test_no_simulated_part_has_a_remedy_for_a_real_one(subject: str) -> None:
    for code in ("slow_servo", "hot_joint", "a rule to come"):
        (_, simulated, _) = judge(totals(findings=(accusing(code, subject),), plan=plan(SIMULATED))).findings
        assert "simulated" in simulated.remedy
        assert "cable" not in simulated.remedy
        (_, real, _) = judge(totals(findings=(accusing(code, subject),), plan=plan(REAL))).findings
        assert real.remedy == "Exchange the cable."


@pytest.mark.parametrize(
    ("subject", "simulated"),
    [("elbow", True), ("bus0", True), ("wrist", False), ("bus1 7", False), ("arm", False)],
)
def test_of_two_buses_each_has_its_own_remedies(subject: str, simulated: bool) -> None:
    (_, finding, _) = judge(totals(findings=(accusing("x", subject),), plan=plan(SIMULATED, REAL))).findings
    assert ("simulated" in finding.remedy) is simulated


@pytest.mark.parametrize(("code", "simulated"), [("power_lost", True), ("slow_controller", False)])
def test_a_controller_may_have_the_name_of_a_simulated_bus(code: str, simulated: bool) -> None:
    buses = [structs.replace(bus, name="arm") for bus in plan(SIMULATED).buses]
    named = LoggedPlan(plan(SIMULATED).loop, buses)
    (_, finding, _) = judge(totals(findings=(accusing(code, "arm"),), plan=named)).findings
    assert ("simulated" in finding.remedy) is simulated


# One accused part for one symptom


def on_bus(*joints: str, bus: str = "bus0") -> tuple[ServoTraffic, ...]:
    return tuple(
        ServoTraffic(bus, n, joint, 9, 9, 0, 9, 0, (), 0.0, 0.0) for n, joint in enumerate(joints, 1)
    )


@pytest.mark.parametrize(
    ("found", "kept"),
    [
        ([("lossy_line", "bus0"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        ([("silent_bus", "bus0"), ("latency_timer", "bus0")], [("latency_timer", "bus0")]),
        ([("noise", "bus0"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        ([("noise", "bus0"), ("lossy_servo", "elbow")], [("noise", "bus0")]),
        ([("slow_servo", "elbow"), ("late_replies", "bus0")], [("late_replies", "bus0")]),
        ([("slow_servo", "elbow"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        (
            [("lossy_line", "bus0"), ("late_replies_everywhere", "machine"), ("slow_servo", "elbow")],
            [("late_replies_everywhere", "machine")],
        ),
        (
            [("slow_servo", "elbow"), ("loose_cable", "wrist"), ("hot_joint", "elbow")],
            [("slow_servo", "elbow"), ("loose_cable", "wrist"), ("hot_joint", "elbow")],
        ),
        (
            [("lossy_line", "other"), ("slow_servo", "elbow")],
            [("lossy_line", "other"), ("slow_servo", "elbow")],
        ),
    ],
    ids=[
        "weak",
        "weak too",
        "late, not noise",
        "noise",
        "whole bus",
        "twice",
        "machine",
        "two servos",
        "two buses",
    ],
)
def test_what_has_the_most_direct_evidence_is_accused_alone(
    found: list[tuple[str, str]], kept: list[tuple[str, str]]
) -> None:
    findings = tuple(accusing(*one, share=0.5 - place / 10) for place, one in enumerate(found))
    verdict = judge(totals(findings=findings, servos=on_bus("elbow", "wrist"), plan=plan(REAL)))
    assert [(one.code, one.subject) for one in verdict.findings if one.rank == Rank.CAUSE] == kept


@pytest.mark.parametrize(
    ("code", "subject", "alone"),
    [("noise", "bus0", True), ("late_replies_everywhere", "machine", True), ("hot_joint", "elbow", False)],
)
def test_a_servo_that_a_bus_lost_is_not_accused(code: str, subject: str, alone: bool) -> None:
    found = (accusing(code, subject),)
    verdict = judge(totals(findings=found, events=(LOST,), servos=on_bus("elbow", "wrist"), plan=plan(REAL)))
    cause, lost = verdict.findings[1:3]
    assert (cause.code, cause.rank, lost.code) == (code, Rank.SERVO_CAUSE, "servo_lost")
    assert bool(lost.remedy) is not alone


def test_a_servo_that_is_lost_alone_is_told_with_its_angle() -> None:
    joint = JointTracking("elbow", 0, 0.0, 0, None, None, None, None, None, None, lost_at=0.5)
    for events, told in (((LOST,), "elbow was lost, at 29 deg."), ((LOST, lost("wrist")), "wrist was lost.")):
        sentences = [one.sentence for one in judge(totals(events=events, tracking=(joint,))).findings]
        assert any(sentence.endswith(told) for sentence in sentences)


def test_why_the_start_was_refused_is_said_first() -> None:
    text = "knee is at 70.0 deg\nelbow has angle limits 1850..2246"
    refused = EventGroup(EventCode.SETUP, Severity.ERROR, "loop", 1, MS, text)
    found = judge(
        replace(totals(events=(refused,)), periods=Periods(0, 0, 0, 0, True, 50.0, 0.0, ()))
    ).findings
    why = "knee is at 70.0 deg; elbow has angle limits 1850..2246"
    assert found[1].sentence == f"The loop never ran a cycle: {why}."


@pytest.mark.parametrize(("cycles", "said"), [(40, 1), (10, 0)])
def test_commands_beyond_limits_are_told_with_their_controller(cycles: int, said: int) -> None:
    text = "elbow, controller body: lowered to the upper position limit"
    gate = EventGroup(EventCode.GATE, Severity.WARNING, "elbow", 1, MS, text)
    joint = JointTracking("elbow", 0, 0.0, cycles, None, None, None, None, None, None)
    verdict = judge(totals(events=(gate,), tracking=(joint,)))
    found = [one.sentence for one in verdict.findings if one.code == "beyond_limits"]
    told = (
        "Commands of body for elbow were beyond its limits in 40 cycles: lowered to the upper position limit."
    )
    assert (found, verdict.good) == ([told] * said, True)


def test_replies_that_are_late_now_and_then_are_the_machines_where_the_loop_is_late_too() -> None:
    late = (accusing("late_now_and_then", "bus0", share=0.05),)
    for share, told in ((0.0, True), (0.01, False)):
        verdict = judge(totals(findings=late, latency=Latency(80.0, 10.0, 5.0, 9, 0.0, share, 0.0)))
        assert ("late_now_and_then" in {one.code for one in verdict.findings}) is told


def test_a_servo_that_answers_again_and_is_not_taken_back_is_told_with_why() -> None:
    again, buses = lost("elbow", count=3), plan(REAL, REAL)
    why = "answers again, but cannot take part: elbow is model number 1030, not a XM430-W350 (1020)"
    returns = {"elbow": ["answers garbled or twice", why]}
    verdict = judge(totals(events=(lost("wrist"), again), returns=returns, plan=buses))
    (servo,) = (one for one in verdict.findings if one.code == "servo_lost")
    told = f"Servos failed: elbow was lost; wrist was lost. elbow {why}."
    assert (servo.subject, servo.sentence) == ("elbow", told)
    assert "as in the robot file" in servo.remedy


@pytest.mark.parametrize("port", ["/dev/ttyUSB0", "sim"])
def test_what_to_do_about_a_servo_that_answers_twice_is_told_of_a_real_one(port: str) -> None:
    returns = {"elbow": ["answers garbled or twice: do two servos have its ID? If not, check its cable"]}
    verdict = judge(totals(events=(lost("elbow"),), returns=returns, plan=plan(port, port)))
    told = " ".join(verdict.sentences)
    assert "elbow answers garbled or twice" in told
    assert ("check its cable" in told.lower()) is (port != "sim")


@pytest.mark.parametrize(
    ("noise_ms", "others", "code", "accused"),
    [
        (0, 2, EventCode.SERVO_LOST, False),
        (0, 1, EventCode.SERVO_LOST, True),
        (-900, 2, EventCode.SERVO_LOST, True),
        (100, 2, EventCode.SERVO_LOST, True),
        (None, 2, EventCode.SERVO_LOST, True),
        (0, 2, EventCode.SERVO_REBOOTED, True),
    ],
    ids=["noise", "few others", "noise long before", "noise behind it", "no noise", "a reboot"],
)
def test_a_servo_that_was_lost_while_the_line_was_disturbed_is_not_accused(
    noise_ms: int | None, others: int, code: EventCode, accused: bool
) -> None:
    at_ns = 4 * 10**9
    events = [EventGroup(code, Severity.ERROR, "elbow", 1, at_ns, "missed 3 replies")]
    if noise_ms is not None:
        t_ns = at_ns + noise_ms * MS
        events.append(EventGroup(EventCode.BUS_NOISE, Severity.WARNING, "main", 1, t_ns, "9 bytes"))
    servos = [answered("elbow", 0, 1000, 3, 3)]
    servos += [answered(f"j{at}", at, 1000, 1, int(at <= others)) for at in range(1, 4)]
    verdict = judge(totals(events=tuple(events), servos=tuple(servos)))
    (servo,) = (one for one in verdict.findings if one.code in {"servo_lost", "servo_rebooted"})
    assert servo.subject == ("elbow" if accused else "main")
    assert ("Bytes that belong to no packet" in servo.sentence) is not accused


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
    verdict = judge(totals(events=events, servos=servos, plan=plan(REAL, REAL)))
    found = {one.subject: one for one in verdict.findings if one.code == "silent_bus"}
    assert found.keys() == told.keys()
    assert all(told[subject] in one.sentence for subject, one in found.items())
    assert ("the machine" in found["machine"].remedy) if "machine" in found else True


def test_servos_of_a_lost_bus_are_not_accused() -> None:
    gone = EventGroup(EventCode.PORT_LOST, Severity.ERROR, "bus0", 1, 4 * MS, "gone")
    for events, accused in (((gone, lost("elbow")), False), ((lost("elbow"),), True)):
        verdict = judge(totals(events=events, servos=on_bus("elbow", "wrist"), plan=plan(REAL)))
        (servo,) = (one for one in verdict.findings if one.code == "servo_lost")
        assert bool(servo.remedy) is accused
        assert ("bus bus0 was lost" in verdict.sentences[0]) is not accused
        assert ("elbow was lost" in verdict.sentences[0]) is accused


@pytest.mark.parametrize(
    ("subject", "other", "accused"),
    [("elbow", "bus0", False), ("bus0", "bus0", False), ("elbow", "bus1", True)],
)
def test_what_followed_worse_beside_another_host_is_not_accused(
    subject: str, other: str, accused: bool
) -> None:
    found = (accusing("another_host", other), accusing("error_grew", subject, rank=Rank.SERVO))
    verdict = judge(totals(findings=found, servos=on_bus("elbow", "wrist"), plan=plan(REAL)))
    (grew,) = (one for one in verdict.findings if one.code == "error_grew")
    assert bool(grew.remedy) is accused
    assert (verdict.findings[1].code == "another_host") is not accused


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
    verdict = judge(totals(events=events, servos=servos, plan=plan(REAL)))
    assert any("they share a supply or a cable" in one.sentence for one in verdict.findings) is shared


def test_why_a_servo_did_not_come_back_is_told_where_few_were_lost() -> None:
    for joints in (("elbow", "wrist"), ("elbow", "wrist", "hand")):
        returns = {"elbow": ["answers garbled or twice", "answers too late"]}
        servos = on_bus("elbow", "wrist", "hand", "head")
        events = tuple(lost(joint, 400 * at) for at, joint in enumerate(joints))
        verdict = judge(totals(events=events, returns=returns, servos=servos, plan=plan(REAL)))
        assert any("elbow answers too late." in one.sentence for one in verdict.findings) is (
            len(joints) == 2
        )


def test_on_virtual_time_no_machine_is_too_busy_for_simulated_servos() -> None:
    slow = (accusing("slow_servo"),)
    real_time, virtual = (
        judge(totals(findings=slow, plan=plan(SIMULATED), virtual=virtual)).findings[1].remedy
        for virtual in (False, True)
    )
    assert "machine was too busy" in real_time
    assert "machine" not in virtual


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


def exchanges(wire: Make, took_us: int, count: int = 5) -> list[Any]:
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
        (3100, 1, "Replies on bus main come 3.1 ms later than the wire needs, and 1 ms were planned for the"),
        (15_800, 1, "a latency timer of 16 ms. `echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB3/"),
        (15_800, 16, ""),
    ],
)
def test_replies_are_compared_with_the_plan(  # noqa: PLR0917  what is written, and fixtures
    write: Make, cycle: Make, wire: Make, extra_us: int, latency_ms: int, shown: str
) -> None:
    wire_us = 10 * (len(ASK) + len(ANSWER)) + 500
    plan = {"buses": [PLANNED | {"latency_ns": latency_ms * MS}]}
    report = analyze_log(write([cycle(0)], exchanges(wire, wire_us + extra_us), plan=plan))
    assert report.buses[0].extra_us == pytest.approx(extra_us)
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
    extra_us = analyze_log(write([cycle(0)], packets, plan=plan)).buses[0].extra_us
    assert extra_us is not None
    assert extra_us < 500


@pytest.mark.parametrize(
    ("port", "command"),
    [
        (
            "/dev/serial/by-id/usb-FTDI",
            "devices/$(basename $(readlink -f /dev/serial/by-id/usb-FTDI))/latency",
        ),
        ("sim", ""),
    ],
)
def test_the_timer_of_a_port_has_a_command_where_it_is_a_device(
    write: Make, cycle: Make, wire: Make, port: str, command: str
) -> None:
    wire_us = 10 * (len(ASK) + len(ANSWER)) + 500
    plan = {"buses": [PLANNED | {"latency_ns": MS, "port": port}]}
    (_, late, *_) = analyze_log(
        write([cycle(0)], exchanges(wire, wire_us + 15_900), plan=plan)
    ).verdict.findings
    assert (late.code, late.subject) == ("latency_timer", "main")
    assert command in late.remedy
    assert ("simulated" in late.remedy) is (port == "sim")


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
        command = Command(number, "", kind, data, "anna")
        robot.buses[0].at(at_ms * MS, lambda command=command: robot.inbox.waiting.append(command))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_writer, "CHUNK_BYTES", 4096)
        robot.run()
    return path


def test_a_log_counted_in_slices_is_the_log_counted_as_a_whole(
    storm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (pairing, latency, steering):
        monkeypatch.setattr(module, "DISORDER_NS", 200 * MS)
    monkeypatch.setattr(reader, "SLICE_BYTES", 1)
    slices: list[Log] = []
    slices.extend(open_log(storm).slices())
    assert len(slices) > 20
    assert max(len(one.cycles) for one in slices) < 20
    tally = Tally()
    tally.take(read_log(storm))
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
    tally.take(log)
    return tally.totals(log)


def test_page_and_json_and_run_have_the_same_verdict(storm: Path) -> None:
    from dxlrun_analysis.page.page import analyzed_page

    log = read_log(storm)
    report = analyze(log)
    said = judge(totals_of(storm))
    assert not said.good
    assert report.verdict == said
    shown = json.loads(json_text(report))["verdict"]
    assert (shown["good"], tuple(shown["sentences"])) == (said.good, said.sentences)
    _, text = analyzed_page(log)
    assert f"<h1>{said.findings[0].sentence}</h1>" in text
    assert all(f"<p>{finding.sentence}" in text for finding in said.findings[1:])


def test_damage_is_reported_of_a_scanned_log_too(storm: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    data = storm.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert judge(totals_of(cut)) == analyze_log(cut).verdict
    assert any("log is not whole" in sentence for sentence in judge(totals_of(cut)).sentences)


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
    said = " ".join(judge(totals(events=(lost,), servos=(servo,))).sentences)
    assert "answered every time" not in said
    assert "?." not in said
    assert "answered every time" in " ".join(judge(totals(servos=(servo,))).sentences)
