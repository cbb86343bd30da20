"""Which event answers which fault."""

from __future__ import annotations

import pytest

from dxlrun.analysis.ledger_faults import answered, faults_in
from dxlrun.events import Event, EventCode, Severity
from dxlrun.simulation import LedgerEntry

JOINTS = {("main", 3): "elbow", ("main", 5): "wrist"}
MS = 1_000_000


def fault(t_ms: int, text: str, bus: str = "main") -> LedgerEntry:
    return LedgerEntry(t_ms * MS, bus, "note", b"", f"fault: {text}")


def event(t_ms: int, code: EventCode, source: str) -> Event:
    return Event(t_ms * MS, code, Severity.WARNING, source, "said")


def test_only_notes_of_faults_count_and_they_come_in_order_of_time():
    notes = [
        fault(20, "lose servo=3"),
        LedgerEntry(5, "main", "note", b"", "collision: two at once"),
        LedgerEntry(6, "main", "in", b"fault: ", ""),
        fault(10, "noise bytes=4"),
    ]
    assert [each.t_ns for each in faults_in(notes)] == [10 * MS, 20 * MS]


def test_a_lost_reply_answers_the_fault_of_its_own_servo():
    events = [
        event(1015, EventCode.READ_LOST, "wrist"),
        event(1020, EventCode.READ_LOST, "elbow"),
        event(1040, EventCode.READ_BACK, "elbow"),
    ]
    (found,) = answered([fault(1000, "lose servo=3")], events, JOINTS, 500 * MS)

    assert (found.seconds, found.bus, found.text) == (0.5, "main", "lose servo=3")
    assert [(one.name, one.source, one.after_ms) for one in found.answers] == [
        ("read_lost", "elbow", 20.0),
        ("read_back", "elbow", 40.0),
    ]


def test_a_fault_of_the_whole_line_may_be_answered_by_anybody():
    events = [event(1015, EventCode.READ_LOST, "wrist"), event(1016, EventCode.PORT_LOST, "main")]
    (found,) = answered([fault(1000, "unplug for=1s")], events, JOINTS, 0)
    assert [one.name for one in found.answers] == ["read_lost", "port_lost"]


@pytest.mark.parametrize(
    "late",
    [
        event(999, EventCode.READ_LOST, "elbow"),
        event(3001, EventCode.READ_LOST, "elbow"),
        event(1001, EventCode.COMMAND, "elbow"),
    ],
    ids=["before it", "long after it", "of another kind"],
)
def test_what_came_before_long_after_or_of_another_kind_is_no_answer(late: Event):
    (found,) = answered([fault(1000, "lose servo=3")], [late], JOINTS, 0)
    assert found.answers == ()


def test_a_fault_of_a_servo_that_the_plan_does_not_name_may_be_answered_by_anybody():
    (found,) = answered([fault(1000, "lose servo=9")], [event(1001, EventCode.READ_LOST, "elbow")], JOINTS, 0)
    assert len(found.answers) == 1
