"""The gate in front of the rules: who may accuse, what failed all the same, and which remedy is offered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs
from tests.analysis.judged import BUSY, REAL, SIMULATED, accusing, lost, on_bus, plan, totals

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.remedies import INJECTED
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.machine_load import MachineLoad, SimulationWait
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.cycles.punctuality import Latency, Periods
from dxlrun_analysis.evidence import accused
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan_excerpt import LoggedPlan, LoggedServo
from dxlrun_analysis.rules import RULES, Needs
from dxlrun_analysis.tally import RealTime
from dxlrun_analysis.verdict import judge_run

LACKING: dict[str, tuple[Needs, dict[str, Any]]] = {
    "nothing": (Needs.NOTHING, {}),
    "a busy machine": (Needs.MACHINE, {"causes": BUSY}),
    "late wake-ups": (Needs.MACHINE, {"latency": Latency(9e3, 500.0, 90.0, 9, 0.05, 0.02, 0.0)}),
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
FAILURES = ("servo_lost", "servo_rebooted", "torque_lost", "silent")


def subject_of(code: str) -> str:
    """Return something that a rule may accuse: the joint elbow, its bus, the loop or the machine."""
    accuses = RULES[code].accuses
    words = {"bus": "bus0", "machine": "machine", "loop": "loop", "device": "elbow", "": ""}
    return next((subject for word, subject in words.items() if accuses.split(",")[0] == word), "elbow")


@pytest.mark.parametrize("lack", LACKING)
@pytest.mark.parametrize("code", RULES)
def test_rule_accuses_only_where_the_evidence_that_it_needs_is_complete(code: str, lack: str) -> None:
    missing, wrong = LACKING[lack]
    found = accused(
        totals(servos=ELBOW, plan=plan(REAL), **wrong), [accusing(code, subject_of(code), share=0.05)]
    )
    assert bool(found) is not bool(missing & RULES[code].needs)


@pytest.mark.parametrize(
    "code", ["another_host", "noise", "power_lost", "broken_replies", "bus_lost", "lossy_line"]
)
def test_joint_is_not_accused_where_the_replies_of_its_bus_are_spoilt(code: str) -> None:
    run = totals(servos=(*ELBOW, *on_bus("hip", "knee", bus="bus1")), plan=plan(REAL, REAL))
    for joint_rule in (code for code, rule in RULES.items() if Needs.INTACT in rule.needs):
        found = accused(
            run, [accusing(code, share=9.0), accusing(joint_rule, "elbow"), accusing(joint_rule, "hip")]
        )
        assert [one.subject for one in found] == ["bus0", "hip"]


def test_joint_of_two_servos_is_not_accused_beside_the_noise_of_their_bus() -> None:
    two = plan(REAL)
    two.buses[0].servos = [LoggedServo("hip", row + 1, row=row, name=f"hip_{row + 1}") for row in (0, 1)]
    two.loop = structs.replace(two.loop, joints=(JointPlan("hip", -1.0, 1.0, None),))
    pair = CouplingPlan("hip", (0,), (0, 1), ((0.5, 0.5),), ((1.0,), (1.0,)))
    two.mechanics = MechanicsPlan(couplings=(pair,), servos=("hip_1", "hip_2"))
    run = totals(servos=on_bus("hip_1", "hip_2"), plan=two)
    assert [one.code for one in accused(run, [accusing("noise"), accusing("follows_worse", "hip")])] == [
        "noise"
    ]


def test_another_host_that_only_reads_moves_no_joint() -> None:
    run = totals(servos=ELBOW, plan=plan(REAL))
    found = accused(run, [accusing("another_host", share=0.0), accusing("stood_still", "elbow")])
    assert [one.code for one in found] == ["another_host", "stood_still"]


def test_joint_is_not_accused_where_replies_of_all_buses_are_missing() -> None:
    run = totals(servos=ELBOW, plan=plan(REAL))
    found = accused(run, [accusing("lossy_line", "machine"), accusing("follows_worse", "elbow")])
    assert [one.code for one in found] == ["lossy_line"]


@pytest.mark.parametrize("lack", ["a busy machine", "late wake-ups"])
@pytest.mark.parametrize("port", [REAL, SIMULATED])
def test_busy_machine_is_named_with_its_numbers_and_a_remedy(port: str, lack: str) -> None:
    """A gate that closes without a word would leave a bad run without a cause."""
    run = totals(plan=plan(port), findings=(accusing("late_replies"),), **LACKING[lack][1])
    (machine,) = (one for one in judge_run(run).findings if one.code == "busy_machine")
    assert machine.subject == "machine"
    assert ("no core was idle in 9 of 10 s" in machine.sentence) is (lack == "a busy machine")
    assert machine.remedy.startswith("End other programs")
    assert ("--virtual" in machine.remedy) is (port == SIMULATED)
    (machine,) = (one for one in judge_run(replace(run, virtual=True)).findings if one.code == "busy_machine")
    assert "--virtual" not in machine.remedy


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if Needs.LOOP not in rule.needs])
def test_share_that_the_machine_does_not_explain_accuses_all_the_same(code: str) -> None:
    half = Causes(load=MachineLoad(10, busy_s=5, no_idle_core_s=5))
    run = totals(causes=half, servos=ELBOW, plan=plan(REAL))
    for share, stays in ((0.55, Needs.MACHINE not in RULES[code].needs), (0.65, True)):
        assert bool(accused(run, [accusing(code, "elbow", share=share)])) is stays


def test_servos_of_several_buses_lost_at_once_stand_for_the_late_replies_of_each() -> None:
    run = totals(servos=ELBOW, plan=plan(REAL))
    shared = accusing("servo_lost", "machine")
    assert accused(run, [accusing("late_replies", "bus0"), shared])[0].subject == "machine"
    assert [one.code for one in accused(run, [accusing("late_replies", "bus0"), shared])] == ["servo_lost"]


@pytest.mark.parametrize("code", FAILURES)
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
def test_failure_is_reported_and_has_a_remedy_only_where_nothing_explains_it(
    code: str, wrong: dict[str, Any], beside: tuple[Finding, ...], has_remedy: bool
) -> None:
    run = totals(servos=(*ELBOW, *on_bus("hip", bus="bus1")), plan=plan(REAL, REAL), **wrong)
    *_, failed = accused(run, [*beside, accusing(code, "elbow", rank=Rank.SERVO)])
    assert (failed.code, failed.rank) == (code, Rank.SERVO)
    reset = code in ("servo_rebooted", "torque_lost")  # which no machine does to a servo
    assert bool(failed.remedy) is (has_remedy or (reset and not beside))


# Remedies


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if rule.remedy])
@pytest.mark.parametrize("subject", ["elbow", "bus0", "bus0 7", "joint of two servos"])
def test_simulated_part_has_no_remedy_for_a_real_one(code: str, subject: str) -> None:
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


def test_remedy_names_port_and_servo() -> None:
    run = totals(plan=plan(REAL, "/dev/ttyUSB7"), servos=(*on_bus("elbow"), *on_bus("wrist", bus="bus1")))
    for code, subject, command in (
        ("torque_lost", "wrist", "`dxlrun servo /dev/ttyUSB7 2 get`"),
        ("broken_replies", "bus1 9", "`dxlrun scan PORT`"),
        ("another_host", "bus0", "`fuser /dev/ttyUSB0`"),
    ):
        (found,) = accused(run, [accusing(code, subject)])
        assert command in found.remedy


@pytest.mark.parametrize(
    ("subject", "simulated"),
    [("elbow", True), ("bus0", True), ("wrist", False), ("bus1 7", False), ("arm", False)],
)
def test_each_of_two_buses_has_its_own_remedies(subject: str, simulated: bool) -> None:
    (found,) = accused(totals(plan=plan(SIMULATED, REAL)), [accusing("supply", subject)])
    assert ("simulation" in found.remedy) is simulated


def test_controller_with_the_name_of_a_simulated_bus_keeps_its_remedy() -> None:
    buses = [structs.replace(bus, name="arm") for bus in plan(SIMULATED).buses]
    run = totals(plan=LoggedPlan(plan(SIMULATED).loop, buses))
    (found,) = accused(run, [accusing("own_work", "arm")])
    assert "rate" in found.remedy


@pytest.mark.parametrize(
    ("real_time", "helps"),
    [
        (RealTime(), "Write `loop: {scheduler: {policy: round_robin}}` into the robot file."),
        (RealTime(requested=True), "The requested real-time scheduler was not granted"),
        (RealTime(requested=True, granted=True), "End other programs."),
    ],
)
def test_scheduler_is_recommended_only_where_it_was_not_granted(real_time: RealTime, helps: str) -> None:
    (_, machine, *_) = judge_run(totals(causes=BUSY, real_time=real_time, plan=plan(REAL))).findings
    assert helps in machine.remedy
    assert ("scheduler" in machine.remedy) is not real_time.granted


@pytest.mark.parametrize("code", ["servo_lost", "late_replies", "lossy_line"])
def test_buses_that_fail_together_are_told_to_check_what_they_share(code: str) -> None:
    """Only a busy machine is helped by ending other programs."""
    (found,) = accused(totals(plan=plan(REAL, REAL)), [accusing(code, "machine")])
    assert "End other programs" not in found.remedy


# One accused part for one symptom


@pytest.mark.parametrize(
    ("found", "kept"),
    [
        ([("lossy_line", "bus0"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        ([("noise", "bus0"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        ([("noise", "bus0"), ("lossy_servo", "elbow")], [("noise", "bus0")]),
        ([("slow_servo", "elbow"), ("late_replies", "bus0")], [("late_replies", "bus0")]),
        ([("slow_servo", "elbow"), ("slow_servo", "elbow")], [("slow_servo", "elbow")]),
        ([("lossy_line", "bus0"), ("late_replies", "machine")], [("late_replies", "machine")]),
        ([("slow_servo", "elbow"), ("lossy_servo", "wrist"), ("supply", "elbow")], []),
        ([("lossy_line", "bus1"), ("slow_servo", "elbow")], []),
    ],
    ids=["weak", "late, not noise", "noise", "whole bus", "twice", "machine", "two servos", "two buses"],
)
def test_most_direct_evidence_about_replies_accuses_alone(
    found: list[tuple[str, str]], kept: list[tuple[str, str]]
) -> None:
    run = totals(servos=ELBOW, plan=plan(REAL))
    stayed = accused(run, [accusing(*one, share=0.5 - at / 10) for at, one in enumerate(found)])
    assert [(one.code, one.subject) for one in stayed] == (kept or found)


@pytest.mark.parametrize(
    ("code", "subject", "rank"),
    [
        ("noise", "bus0", Rank.SERVO_CAUSE),
        ("late_replies", "machine", Rank.SERVO_CAUSE),
        ("supply", "elbow", Rank.SERVO_CAUSE),
        ("supply", "wrist", Rank.CAUSE),
    ],
)
def test_cause_comes_before_the_failure_that_it_explains(code: str, subject: str, rank: Rank) -> None:
    run = totals(servos=on_bus("elbow", "hand"), events=(lost("elbow"),), plan=plan(REAL))
    (found,) = accused(run, [accusing(code, subject)])
    assert found.rank == rank


def test_cause_of_skipped_periods_comes_before_them() -> None:
    run = totals(servos=ELBOW, plan=plan(REAL))
    first, _ = accused(run, [accusing("noise"), accusing("skipped", "loop", rank=Rank.SHARE)])
    assert first.rank == Rank.SHARE_CAUSE


def test_lost_device_is_explained_as_a_lost_servo_is() -> None:
    run = totals(servos=ELBOW, plan=plan(REAL), events=(lost("foot", code=EventCode.DEVICE_LOST),))
    (found,) = accused(run, [accusing("frozen", "foot")])
    assert found.rank == Rank.SERVO_CAUSE
