"""What the verdict says about late and long cycles, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.machine import INTERRUPTS, OTHERS, STEAL
from dxlrun_analysis.causes.rules import cause_findings
from dxlrun_analysis.causes.tables import causes_table
from dxlrun_analysis.cycles.worst import Cause, CauseKind, CauseShare
from dxlrun_analysis.finding import Finding, Rank

OTHER = Cause("unexplained", "", 20, 30_000_000, 2_000_000, 30_000_000)


def found(*causes: Cause, throttled: int = 0, long: int = 10) -> list[Finding]:
    all_of_them = Causes(5, long, sum(one.total_ns for one in causes), causes, (), throttled)
    return list(cause_findings(all_of_them, "Remedy for wake-ups."))


def cause(kind: CauseKind, subject: str = "", servo: str = "") -> Cause:
    return Cause(kind, subject, 10, 70_000_000, 9_000_000, 70_000_000, servo)


@pytest.mark.parametrize(
    ("one", "code", "accused", "remedy"),
    [
        (cause("controller", "left_arm"), "slow_controller", "left_arm", "`left_arm: {rate: ...}`"),
        (cause("machine", STEAL), "busy_machine", "machine", "virtual machine"),
        (cause("machine", OTHERS), "busy_machine", "machine", "core of its own"),
        (cause("machine", INTERRUPTS), "busy_machine", "machine", "irqbalance"),
        (cause("late wake-up"), "late_wake_ups", "machine", "Remedy for wake-ups."),
        (cause("own work"), "own_work", "loop", "Remedy for wake-ups."),
        (cause("late reply", "servo 5 (elbow)", "elbow"), "late_exchanges", "elbow", "return_delay_time"),
        (cause("late reply", "bus main"), "late_exchanges", "main", "return_delay_time"),
        (cause("write call", "bus main"), "slow_writes", "main", "adapter"),
        (cause("plan"), "rate_too_high", "loop", "`rate`"),
    ],
)
def test_what_has_most_of_the_time_is_named_with_a_remedy(
    one: Cause, code: str, accused: str, remedy: str
) -> None:
    (finding,) = found(one, OTHER)
    assert (finding.code, finding.subject, finding.rank) == (code, accused, Rank.CAUSE)
    assert "70.00 ms of 100.00 ms in 10 cycles" in finding.sentence
    assert remedy in finding.remedy
    assert finding.share == pytest.approx(0.7)
    assert "{" not in finding.sentence


@pytest.mark.parametrize(
    "one",
    [
        replace(cause("controller", "left_arm"), cycles=2),
        replace(cause("controller", "left_arm"), long_ns=29_000_000),
        cause("missing reply", "servo 5 (elbow)", "elbow"),
        cause("retry", "servo 5 (elbow)", "elbow"),
        cause("unexplained"),
    ],
    ids=["twice", "less than half", "missing", "retry", "unexplained"],
)
def test_what_is_rare_small_or_told_elsewhere_is_no_finding(one: Cause) -> None:
    assert found(one, OTHER) == []


def test_two_long_cycles_accuse_nothing() -> None:
    assert found(cause("controller", "left_arm"), long=2) == []
    assert found() == []


def test_a_processor_that_was_hot_and_slow_is_reported() -> None:
    (finding,) = found(OTHER, throttled=4)
    assert (finding.code, finding.subject) == ("throttled_processor", "machine")
    assert "for 4 seconds" in finding.sentence


def test_the_table_has_the_causes_and_their_shares() -> None:
    table = causes_table(Causes(5, 10, 100_000_000, (cause("controller", "left_arm"), OTHER)))
    assert table.title == "Causes: 5 cycles woke late, 10 cycles took too long, 100.00 ms together"
    assert [cell.text for cell in table.rows[0]] == [
        "controller",
        "left_arm",
        "10",
        "70.00 ms",
        "70.0%",
        "9000 us",
    ]
    assert causes_table(Causes()).rows == ()


def test_a_cause_in_a_sentence_has_its_subject_and_what_the_machine_did_is_the_cause() -> None:
    shares = (
        CauseShare("machine", STEAL, 5.0),
        CauseShare("controller", "arm", 4.0),
        CauseShare("own work", "", 1.0),
    )
    assert [share.name for share in shares] == ["steal by the host", "controller of arm", "own work"]
