"""What the verdict says about late and long cycles, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.analysis.judged import totals

from dxlrun_analysis.causes.cause_tables import causes_table
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.loop_rules import own_work
from dxlrun_analysis.causes.machine_history import STEAL
from dxlrun_analysis.cycles.worst_cycles import Cause, CauseKind, CauseShare
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.verdict import judge_run

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
def test_work_of_the_loop_that_has_most_of_the_time_is_named(one: Cause, accused: str) -> None:
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
def test_what_is_rare_small_or_told_elsewhere_is_no_finding(case: str) -> None:
    assert found(ELSEWHERE[case], OTHER) == []


def test_two_long_cycles_accuse_nothing() -> None:
    assert found(ARM, long=2) == []
    assert found() == []


@pytest.mark.parametrize(("cycles", "named"), [(10, True), (2, False)])
def test_machine_that_made_most_of_the_long_cycles_is_named(cycles: int, named: bool) -> None:
    causes = Causes(5, 10, 100_000_000, (replace(STOLEN, cycles=cycles), OTHER), throttled=4)
    findings = judge_run(totals(causes=causes)).findings
    machine = [one.sentence for one in findings if one.code == "busy_machine"]
    assert len(machine) == named
    assert all("host of the virtual machine took 70.00 ms of 100.00 ms" in one for one in machine)
    assert all("heat throttled the processor for 4 seconds" in one for one in machine)


def test_table_has_the_causes_and_their_shares() -> None:
    table = causes_table(Causes(5, 10, 100_000_000, (ARM, OTHER)))
    assert table.title == "Causes: 5 cycles woke late, 10 cycles took too long; total excess 100.00 ms"
    row = ["controller", "left_arm", "10", "70.00 ms", "70.0%", "9000 us"]
    assert [cell.text for cell in table.rows[0]] == row
    assert causes_table(Causes()).rows == ()
    shares = ("machine", STEAL), ("controller", "arm"), ("own work", "")
    labels = [CauseShare(kind, subject, 1.0).label for kind, subject in shares]
    assert labels == ["host of the virtual machine", "controller of arm", "own work"]
