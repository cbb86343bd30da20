"""The gate in front of the rules: who may accuse, what failed all the same, and which remedy is offered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs
from tests.analysis.judged import BUSY, LATE, REAL, SIMULATED, accusing, on_bus, plan, totals

from dxlrun.dynamixel.remedies import INJECTED
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.machine_load import MachineLoad, SimulationWait
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.cycles.punctuality import Periods
from dxlrun_analysis.evidence import accused
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan_excerpt import LoggedPlan, LoggedServo
from dxlrun_analysis.rules import RULES, Needs

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
def test_rule_accuses_only_where_the_evidence_that_it_needs_is_complete(code: str, lack: str) -> None:
    missing, wrong = LACKING[lack]
    subject = SUBJECTS.get(RULES[code].accuses.split(",")[0], "elbow")
    found = accused(totals(servos=ELBOW, plan=plan(REAL), **wrong), [accusing(code, subject, share=0.05)])
    assert bool(found) is not bool(missing & RULES[code].needs)


@pytest.mark.parametrize("code", SPOILS)
def test_joint_is_not_accused_where_the_replies_of_its_bus_are_spoilt(code: str) -> None:
    run = totals(servos=TWO_BUSES, plan=plan(REAL, REAL))
    judged = [code for code, rule in RULES.items() if Needs.INTACT in rule.needs]
    assert judged
    for rule in judged:
        spoilt = accusing(code, share=9.0)
        found = accused(run, [spoilt, accusing(rule, "elbow"), accusing(rule, "hip")])
        assert [one.subject for one in found] == ["bus0", "hip"]


def test_joint_of_two_servos_is_not_accused_beside_the_noise_of_their_bus() -> None:
    two = plan(REAL)
    two.buses[0].servos = [LoggedServo("hip", row + 1, row=row, name=f"hip_{row + 1}") for row in (0, 1)]
    two.loop = structs.replace(two.loop, joints=(JointPlan("hip", -1.0, 1.0, None),))
    pair = CouplingPlan("hip", (0,), (0, 1), ((0.5, 0.5),), ((1.0,), (1.0,)))
    two.mechanics = MechanicsPlan(couplings=(pair,), servos=("hip_1", "hip_2"))
    run = totals(servos=on_bus("hip_1", "hip_2"), plan=two)
    found = accused(run, [accusing("noise"), accusing("follows_worse", "hip")])
    assert [one.code for one in found] == ["noise"]


@pytest.mark.parametrize("code", [code for code, rule in RULES.items() if Needs.LOOP not in rule.needs])
def test_share_that_the_machine_does_not_explain_accuses_all_the_same(code: str) -> None:
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
def test_failure_is_reported_and_has_a_remedy_only_where_nothing_explains_it(
    code: str, wrong: dict[str, Any], beside: tuple[Finding, ...], has_remedy: bool
) -> None:
    run = totals(servos=TWO_BUSES, plan=plan(REAL, REAL), **wrong)
    *_, failed = accused(run, [*beside, accusing(code, "elbow", rank=Rank.SERVO)])
    assert (failed.code, failed.rank) == (code, Rank.SERVO)
    reset = code in ("servo_rebooted", "torque_lost")  # which no machine does to a servo
    assert bool(failed.remedy) is (has_remedy or (reset and not beside))


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


def test_controller_with_the_name_of_a_simulated_bus_keeps_its_remedy() -> None:
    buses = [structs.replace(bus, name="arm") for bus in plan(SIMULATED).buses]
    (found,) = accused(totals(plan=LoggedPlan(plan(SIMULATED).loop, buses)), [accusing("own_work", "arm")])
    assert "rate" in found.remedy
