"""The judges of a run beside its ledger can fail: which fault has no event, and which event no cause."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit import judges

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlsim.bus.ledger import LedgerEntry

SERVOS = {"main": {3: "elbow", 5: "wrist"}, "legs": {3: "knee"}}
PLAN = {
    "buses": [
        {"name": bus, "servos": [{"joint": joint, "servo_id": each} for each, joint in servos.items()]}
        for bus, servos in SERVOS.items()
    ]
}
MS = 1_000_000
LOOP = (
    Event(100 * MS, EventCode.LOOP_STARTED, Severity.INFO, "loop", ""),
    Event(90_000 * MS, EventCode.LOOP_STOPPED, Severity.INFO, "loop", ""),
)


def log(*events: Event) -> Any:
    """A log of a run at 50 Hz with these events."""
    return SimpleNamespace(
        events=(*LOOP, *events),
        period_ns=20 * MS,
        metadata={},
        attachments={"plan.json": json.dumps(PLAN).encode()},
    )


def fault(t_ms: int, text: str, bus: str = "main") -> LedgerEntry:
    return LedgerEntry(t_ms * MS, bus, "note", b"", f"fault: {text}")


def event(t_ms: int, code: EventCode, source: str, text: str = "said") -> Event:
    return Event(t_ms * MS, code, Severity.WARNING, source, text)


def unnoticed(one: LedgerEntry, *events: Event, before: LedgerEntry | None = None) -> tuple[str, ...]:
    """Return which joints and buses had no event of a fault."""
    entries = [one] if before is None else [one, before]
    found = dict(judges.unnoticed(log(*events), entries))
    return found.get(one.note.removeprefix("fault: "), ())


def uncaused(entries: list[LedgerEntry], *events: Event) -> list[tuple[str, str]]:
    return [(one.name, one.source) for one in judges.uncaused(log(*events), entries)]


@pytest.mark.parametrize(
    "wrong",
    [
        event(3001, EventCode.READ_LOST, "elbow"),
        event(1001, EventCode.READ_LOST, "wrist"),
        event(1001, EventCode.READ_LOST, "knee"),
        event(1001, EventCode.SERVO_ERROR, "elbow"),
        event(1001, EventCode.READ_BACK, "elbow"),
        event(1001, EventCode.OVERRUN, "loop"),
        event(1001, EventCode.BUS_NOISE, "main"),
        event(1001, EventCode.SETUP, "loop", "wrist (ID 5 on bus main) does not answer"),
        event(1001, EventCode.SETUP, "loop", "knee (ID 3 on bus legs) does not answer"),
        event(1001, EventCode.TORQUE_OFF, "loop", "torque is off"),
    ],
)
def test_what_is_of_another_time_servo_or_kind_is_no_answer(wrong: Event):
    one = fault(1000, "silence servo=3")
    assert unnoticed(one, wrong) == ("elbow",)


@pytest.mark.parametrize(
    ("text", "sources"),
    [
        ("silence servo=3", ("elbow",)),
        ("silence servo=3 for=80ms", ("elbow",)),
        ("reboot servo=5", ("wrist",)),
        ("brownout", ("elbow", "wrist")),
        ("wedge for=100ms", ("elbow", "wrist")),
        ("unplug for=100ms", ("main",)),
    ],
)
def test_what_lasts_must_be_noticed(text: str, sources: tuple[str, ...]):
    assert unnoticed(fault(1000, text)) == sources
    shown = [
        event(1010, EventCode.PORT_LOST if one == "main" else EventCode.READ_LOST, one)
        for one in sources[:-1]
    ]
    assert unnoticed(fault(1000, text), *shown) == sources[-1:]


@pytest.mark.parametrize(
    "text",
    ["lose servo=3", "lose from=host", "noise size=4", "silence servo=3 for=79ms", "duplicate servo=3"],
)
def test_what_a_run_may_bear_in_silence_need_not_be_noticed(text: str):
    assert unnoticed(fault(1000, text)) == ()


@pytest.mark.parametrize("t_ms", [99, 88_001])
def test_only_faults_of_the_running_loop_must_be_noticed(t_ms: int):
    assert unnoticed(fault(t_ms, "silence servo=3")) == ()


def test_a_servo_that_is_silent_already_has_nothing_to_lose():
    lost = event(900, EventCode.READ_LOST, "elbow")
    one = fault(1000, "silence servo=3")
    assert unnoticed(one, lost) == ()
    assert unnoticed(one, lost, event(950, EventCode.READ_BACK, "elbow")) == ("elbow",)
    assert unnoticed(one, event(900, EventCode.READ_LOST, "wrist")) == ("elbow",)


def test_a_lost_port_speaks_for_the_servos_of_its_line_only():
    one = fault(1000, "brownout")
    assert unnoticed(one, event(1001, EventCode.PORT_LOST, "main")) == ()
    assert unnoticed(one, event(1001, EventCode.PORT_LOST, "legs")) == ("elbow", "wrist")


def test_of_two_servos_with_one_id_the_other_one_answers():
    one = fault(1000, "silence servo=3")
    assert unnoticed(one, before=fault(500, "duplicate_id servo=3")) == ()
    assert unnoticed(one, before=fault(500, "duplicate_id servo=5")) == ("elbow",)
    assert unnoticed(one, before=fault(500, "duplicate_id servo=3", "legs")) == ("elbow",)


# Events without a cause


@pytest.mark.parametrize(
    ("entries", "shown"),
    [
        ([], event(1000, EventCode.READ_LOST, "elbow")),
        ([], event(1000, EventCode.PORT_LOST, "main")),
        ([fault(1001, "lose servo=3")], event(1000, EventCode.READ_LOST, "elbow")),
        ([fault(1000, "lose servo=3")], event(3001, EventCode.READ_LOST, "elbow")),
        ([fault(1000, "lose servo=3", "legs")], event(1001, EventCode.READ_LOST, "elbow")),
        ([fault(1000, "lose servo=3")], event(1001, EventCode.SERVO_REBOOTED, "elbow")),
        ([fault(1000, "reboot servo=5")], event(1001, EventCode.SERVO_REBOOTED, "elbow")),
        ([fault(1000, "overheat servo=5")], event(1001, EventCode.SERVO_ERROR, "elbow")),
        ([fault(1000, "silence servo=3")], event(1001, EventCode.PORT_LOST, "main")),
        ([fault(1000, "unplug", "legs")], event(1001, EventCode.PORT_LOST, "main")),
    ],
)
def test_an_event_without_a_cause_is_found(entries: list[LedgerEntry], shown: Event):
    assert uncaused(entries, shown) == [(shown.name, shown.source)]


@pytest.mark.parametrize(
    ("entries", "shown"),
    [
        ([fault(1000, "lose servo=3")], event(1001, EventCode.READ_LOST, "elbow")),
        ([fault(1000, "lose servo=3")], event(1001, EventCode.READ_LOST, "wrist")),
        ([fault(1000, "lose from=host")], event(1001, EventCode.READ_LOST, "wrist")),
        ([fault(1000, "silence servo=3")], event(60_000, EventCode.READ_LOST, "elbow")),
        ([fault(1000, "overheat servo=3 for=1s")], event(60_000, EventCode.SERVO_ERROR, "elbow")),
        (
            [LedgerEntry(990 * MS, "main", "out", b"\xff", "", 5 * MS)],
            event(1001, EventCode.READ_LOST, "elbow"),
        ),
        (
            [LedgerEntry(MS, "main", "note", b"", "servo 3: shutdown, torque off: overload")],
            event(1001, EventCode.SERVO_LIMP, "elbow"),
        ),
    ],
)
def test_an_event_with_a_cause_is_none_of_them(entries: list[LedgerEntry], shown: Event):
    assert uncaused(entries, shown) == []


def test_a_servo_silent_since_a_fault_may_report_it_late():
    entries = [fault(1000, "reboot servo=3 for=100ms"), fault(1050, "silence servo=3 for=8s")]
    lost, back = event(1010, EventCode.READ_LOST, "elbow"), event(1020, EventCode.READ_BACK, "elbow")
    rebooted = event(9800, EventCode.SERVO_REBOOTED, "elbow")
    assert uncaused(entries, lost, rebooted) == []
    assert uncaused(entries, lost, back, rebooted) == [("servo_rebooted", "elbow")]


def test_good_news_needs_no_cause():
    shown = Event(MS, EventCode.SERVO_ERROR, Severity.INFO, "elbow", "reports no error")
    assert uncaused([], shown) == []
