"""Rules of the verdict on totals: the culprit that they name, and their evidence. Their words: totals.txt."""

import ast
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs
from tests.analysis.judged import (
    BUSY,
    COMMANDS,
    LATE,
    NO_LOOP,
    REAL,
    SIMULATED,
    accusing,
    check_case,
    on_bus,
    plan,
    totals,
)
from tests.kit.cases import case_parameters, read_cases

import dxlrun_analysis
from dxlrun.channels.event_records import GoalTotals
from dxlrun.dynamixel.remedies import INJECTED
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.machine_load import MachineLoad, SimulationWait
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun.plan.played_goals import find_unreached_goals
from dxlrun_analysis.causes.cause_tables import causes_table
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.loop_rules import own_work
from dxlrun_analysis.causes.machine_history import STEAL
from dxlrun_analysis.cycles.punctuality import Periods
from dxlrun_analysis.cycles.worst_cycles import Cause, CauseKind, CauseShare
from dxlrun_analysis.evidence import accused
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.lost import CODES
from dxlrun_analysis.plan_excerpt import LoggedPlan, LoggedServo
from dxlrun_analysis.rules import RULES, Needs
from dxlrun_analysis.verdict import judge_run


@pytest.mark.parametrize("case", case_parameters(Path(__file__).with_name("totals.txt")))
def test_verdict_on_totals(case):
    check_case(case)


@pytest.mark.parametrize("begun", [0, 1, 2])
def test_each_goal_of_a_motion_that_is_played_twice_has_to_begin(begun):
    loop, goals = (
        structs.replace(NO_LOOP, commands=COMMANDS[:1] * 2),
        GoalTotals(begun={COMMANDS[0].origin: begun}),
    )
    never = [goal.sentence for goal in find_unreached_goals(loop, goals, 60_000_000_000)]
    assert never == ["wave of arm never began"] * (2 - begun)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a\n  machine lazy\n  => good\n", "a.txt:2: machine lazy"),
        ("a\n  => not good\n", "a.txt:2: not good"),
        ("a\n  => 0: Bad\n", "a.txt:2: 0: Bad"),
        ("a\n  => has noise\n", "a.txt:2: has noise"),
        ("a\n  servos elbow\n  => none: answered\n", "a.txt:3: none: answered"),
        ("a\n  machine busy\n  => no busy_machine\n", "a.txt:3: no busy"),
        ("a\n  machine busy\n  => no fix busy_machine machine: End other\n", "a.txt:3: no fix"),
    ],
)
def test_what_does_not_hold_is_named_with_its_line(text, told, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    (case,) = read_cases(tmp_path / "a.txt")
    with pytest.raises(AssertionError, match=told):
        check_case(case)


LACKING: dict[str, tuple[Needs, dict[str, Any]]] = {
    "nothing": (Needs.NOTHING, {}),
    "a busy machine": (Needs.MACHINE, {"causes": BUSY}),
    "late wake-ups": (Needs.MACHINE, {"latency": LATE}),
    "one stall of the simulation": (Needs.NOTHING, {"wait": SimulationWait(9_000_000, 1)}),
    "stalls of the simulation": (Needs.MACHINE, {"wait": SimulationWait(9_000_000, 3)}),
    "skipped periods": (Needs.LOOP, {"periods": Periods(1000, 800, 200, 0, True, 50.0, 20.0, (50.0,))}),
    "a loop that never ran": (Needs.LOOP, {"periods": Periods(0, 0, 0, 0, True, 50.0, 0.0, ())}),
    "lost records": (Needs.LOG, {"gaps": 3}),
    "missing cycles": (Needs.LOG, {"periods": Periods(1000, 900, 0, 100, False, 50.0, 20.0, (50.0,))}),
    "invalid states": (Needs.STATES, {"invalid": (500, 0)}),
}
"""What is wrong with the evidence of a run, and which needs of a rule it leaves unfulfilled."""
ELBOW = on_bus("elbow", "wrist")
TWO_BUSES = (*ELBOW, *on_bus("hip", "knee", bus="bus1"))
SPOILS = ("another_host", "noise", "power_lost", "broken_replies", "bus_lost", "lossy_line")
SUBJECTS = {"bus": "bus0", "machine": "machine", "loop": "loop", "device": "elbow", "": ""}
"""Something that a rule may accuse, by the first word of what it does; else the joint elbow."""


@pytest.mark.parametrize("lack", LACKING)
@pytest.mark.parametrize("code", RULES)
def test_rule_accuses_only_where_the_evidence_that_it_needs_is_complete(code, lack):
    missing, wrong = LACKING[lack]
    subject = SUBJECTS.get(RULES[code].accuses.split(",")[0], "elbow")
    found = accused(totals(servos=ELBOW, plan=plan(REAL), **wrong), [accusing(code, subject, share=0.05)])
    assert bool(found) is not bool(missing & RULES[code].needs)


@pytest.mark.parametrize("code", SPOILS)
def test_joint_is_not_accused_where_the_replies_of_its_bus_are_spoilt(code):
    run = totals(servos=TWO_BUSES, plan=plan(REAL, REAL))
    judged = [code for code, rule in RULES.items() if Needs.INTACT in rule.needs]
    assert judged
    for rule in judged:
        spoilt = accusing(code, share=9.0)
        found = accused(run, [spoilt, accusing(rule, "elbow"), accusing(rule, "hip")])
        assert [one.subject for one in found] == ["bus0", "hip"]


def test_joint_of_two_servos_is_not_accused_beside_the_noise_of_their_bus():
    two = plan(REAL)
    two.buses[0].servos = [LoggedServo("hip", row + 1, row=row, name=f"hip_{row + 1}") for row in (0, 1)]
    two.loop = structs.replace(two.loop, joints=(JointPlan("hip", -1.0, 1.0, None),))
    pair = CouplingPlan("hip", (0,), (0, 1), ((0.5, 0.5),), ((1.0,), (1.0,)))
    two.mechanics = MechanicsPlan(couplings=(pair,), servos=("hip_1", "hip_2"))
    run = totals(servos=on_bus("hip_1", "hip_2"), plan=two)
    found = accused(run, [accusing("noise"), accusing("follows_worse", "hip")])
    assert [one.code for one in found] == ["noise"]


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if Needs.LOOP not in rule.needs])
def test_share_that_the_machine_does_not_explain_accuses_all_the_same(code):
    half = Causes(load=MachineLoad(10, busy_s=5, no_idle_core_s=5))
    run = totals(causes=half, servos=ELBOW, plan=plan(REAL))
    for share, stays in ((0.55, Needs.MACHINE not in RULES[code].needs), (0.65, True)):
        assert bool(accused(run, [accusing(code, "elbow", share=share)])) is stays


@pytest.mark.parametrize("code", ["servo_lost", "servo_rebooted", "torque_lost", "silent"])
@pytest.mark.parametrize(
    ("wrong", "beside", "has_remedy"),
    [
        ({}, (), True),
        ({"causes": BUSY}, (), False),
        ({}, (accusing("noise"),), False),
        ({}, (accusing("late_replies", "machine"),), False),
        ({}, (accusing("noise", "bus1"),), True),
        ({}, (accusing("supply", "wrist"),), True),
    ],
    ids=["alone", "busy machine", "its bus", "all buses", "another bus", "another servo"],
)
def test_failure_is_reported_and_has_a_remedy_only_where_nothing_explains_it(code, wrong, beside, has_remedy):
    run = totals(servos=TWO_BUSES, plan=plan(REAL, REAL), **wrong)
    *_, failed = accused(run, [*beside, accusing(code, "elbow", rank=Rank.SERVO)])
    assert (failed.code, failed.rank) == (code, Rank.SERVO)
    reset = code in ("servo_rebooted", "torque_lost")  # which no machine does to a servo
    assert bool(failed.remedy) is (has_remedy or (reset and not beside))


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if rule.remedy])
@pytest.mark.parametrize("subject", ["elbow", "bus0", "bus0 7", "joint of two servos"])
def test_simulated_part_has_no_remedy_for_a_real_one(code, subject):
    rule = RULES[code]
    for own in ("", "Exchange the cable."):
        one = replace(accusing(code, subject), remedy=own)
        (simulated,) = accused(totals(plan=plan(SIMULATED), servos=on_bus("elbow")), [one])
        (real,) = accused(totals(plan=plan(REAL), servos=on_bus("elbow")), [one])
        if rule.accuses.startswith("loop"):  # a controller may have the name of a simulated bus
            assert simulated.remedy == real.remedy
        else:
            assert simulated.remedy.lower() == f"{INJECTED}."
        assert real.remedy.startswith((own or rule.remedy).partition("{")[0])


def test_controller_with_the_name_of_a_simulated_bus_keeps_its_remedy():
    buses = [structs.replace(bus, name="arm") for bus in plan(SIMULATED).buses]
    (found,) = accused(totals(plan=LoggedPlan(plan(SIMULATED).loop, buses)), [accusing("own_work", "arm")])
    assert "rate" in found.remedy


ROOM = Path(next(iter(dxlrun_analysis.__path__)))
FILES = [file for file in ROOM.rglob("*.py") if file != ROOM / "rules.py"]
MADE_BY = ("Finding", "FollowingFailure", "cause", "joint_finding")
"""Calls whose first argument is a code, or a name that holds one."""
NAMES = {"port", "servo_id", "name", "bus"}


def _words(node: ast.AST) -> Iterator[str]:
    """Return the words that an expression may be."""
    if isinstance(node, ast.IfExp):
        yield from (*_words(node.body), *_words(node.orelse))
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def _emitted() -> set[str]:
    calls = (
        node
        for file in FILES
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MADE_BY
    )
    return {word for call in calls if call.args for word in _words(call.args[0])} | {*CODES.values()}


def test_every_emitted_code_has_a_rule_and_every_rule_is_emitted():
    assert _emitted() == set(RULES)


@pytest.mark.parametrize("code", RULES)
def test_rule_has_a_signal_and_a_bound(code):
    rule = RULES[code]
    assert rule.signal
    assert rule.bound
    assert set(re.findall(r"\{(\w+)\}", rule.remedy.replace("{{", "").replace("}}", ""))) <= NAMES
    if rule.accuses.startswith("joint"):
        assert rule.needs & Needs.INTACT, "a joint is not judged by positions of spoilt replies"
    assert rule.accuses or not rule.needs, "what accuses nothing is always told"


OTHER = Cause("unexplained", "", 20, 30_000_000, 2_000_000, 30_000_000)


def found(*causes: Cause, long: int = 10) -> list[Finding]:
    return list(own_work(Causes(5, long, sum(one.total_ns for one in causes), causes, ())))


def cause(kind: CauseKind, subject: str = "", servo: str = "") -> Cause:
    return Cause(kind, subject, 10, 70_000_000, 9_000_000, 70_000_000, servo)


ARM, STOLEN = cause("controller", "left_arm"), cause("machine", STEAL)


@pytest.mark.parametrize(
    ("one", "accused"),
    [
        (ARM, "left_arm"),
        (cause("own work"), "loop"),
        (cause("write call", "bus main"), "main"),
        (cause("plan"), "loop"),
    ],
)
def test_work_of_the_loop_that_has_most_of_the_time_is_named(one, accused):
    (finding,) = found(one, OTHER)
    assert (finding.code, finding.subject, finding.rank) == ("own_work", accused, Rank.CAUSE)
    assert "70.00 ms of 100.00 ms in 10 cycles" in finding.sentence
    assert finding.share == pytest.approx(0.7)


ELSEWHERE = {
    "twice": replace(ARM, cycles=2),
    "less than half": replace(ARM, long_ns=29_000_000),
    "machine": STOLEN,
    "late": cause("late wake-up"),
    "late reply": cause("late reply", "bus main"),
    "missing": cause("missing reply", "servo 5 (elbow)", "elbow"),
    "retry": cause("retry", "servo 5 (elbow)", "elbow"),
    "unexplained": cause("unexplained"),
}


@pytest.mark.parametrize("case", ELSEWHERE)
def test_what_is_rare_small_or_told_elsewhere_is_no_finding(case):
    assert found(ELSEWHERE[case], OTHER) == []


def test_two_long_cycles_accuse_nothing():
    assert found(ARM, long=2) == []
    assert found() == []


@pytest.mark.parametrize(("cycles", "named"), [(10, True), (2, False)])
def test_machine_that_made_most_of_the_long_cycles_is_named(cycles, named):
    causes = Causes(5, 10, 100_000_000, (replace(STOLEN, cycles=cycles), OTHER), throttled=4)
    findings = judge_run(totals(causes=causes)).findings
    machine = [one.sentence for one in findings if one.code == "busy_machine"]
    assert len(machine) == named
    assert all("host of the virtual machine took 70.00 ms of 100.00 ms" in one for one in machine)
    assert all("heat throttled the processor for 4 seconds" in one for one in machine)


def test_table_has_the_causes_and_their_shares():
    table = causes_table(Causes(5, 10, 100_000_000, (ARM, OTHER)))
    assert table.title == "Causes: 5 cycles woke late, 10 cycles took too long; total excess 100.00 ms"
    row = ["controller", "left_arm", "10", "70.00 ms", "70.0%", "9000 us"]
    assert [cell.text for cell in table.rows[0]] == row
    assert causes_table(Causes()).rows == ()
    shares = ("machine", STEAL), ("controller", "arm"), ("own work", "")
    labels = [CauseShare(kind, subject, 1.0).label for kind, subject in shares]
    assert labels == ["host of the virtual machine", "controller of arm", "own work"]
