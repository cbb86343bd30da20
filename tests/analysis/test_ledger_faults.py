"""Which event answers which fault, and which event has no cause: above all, what must not pass."""

from __future__ import annotations

import pytest

from dxlrun.channels.events import Event, EventCode, Severity
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.ledger.faults import answered, faults_in, uncaused

JOINTS = {("main", 3): "elbow", ("main", 5): "wrist", ("legs", 3): "knee"}
MS = 1_000_000
PERIOD_NS = 20 * MS
LOOP = (
    Event(100 * MS, EventCode.LOOP_STARTED, Severity.INFO, "loop", ""),
    Event(90_000 * MS, EventCode.LOOP_STOPPED, Severity.INFO, "loop", ""),
)


def fault(t_ms: int, text: str, bus: str = "main") -> LedgerEntry:
    return LedgerEntry(t_ms * MS, bus, "note", b"", f"fault: {text}")


def event(t_ms: int, code: EventCode, source: str, text: str = "said") -> Event:
    return Event(t_ms * MS, code, Severity.WARNING, source, text)


def answers(one: LedgerEntry, *events: Event) -> list[tuple[str, str]]:
    (found,) = answered([one], [*LOOP, *events], JOINTS, 0, PERIOD_NS)
    return [(answer.name, answer.source) for answer in found.answers]


def unanswered(one: LedgerEntry, *events: Event, before: LedgerEntry | None = None) -> tuple[str, ...]:
    entries = [one] if before is None else [before, one]
    return answered(entries, [*LOOP, *events], JOINTS, 0, PERIOD_NS)[-1].unanswered


def causeless(entries: list[LedgerEntry], *events: Event) -> list[tuple[str, str]]:
    return [(one.name, one.source) for one in uncaused(entries, events, JOINTS, 0)]


def test_only_notes_of_faults_count_and_they_come_in_order_of_time():
    notes = [
        fault(20, "lose servo=3"),
        LedgerEntry(5, "main", "note", b"", "collision: two at once"),
        LedgerEntry(6, "main", "in", b"fault: ", ""),
        fault(10, "noise size=4"),
    ]
    assert [each.t_ns for each in faults_in(notes)] == [10 * MS, 20 * MS]


def test_a_lost_reply_answers_the_fault_of_its_own_servo():
    events = [
        event(1015, EventCode.READ_LOST, "wrist"),
        event(1020, EventCode.READ_LOST, "elbow", "no reply"),
    ]
    (found,) = answered([fault(1000, "lose servo=3")], events, JOINTS, 500 * MS, PERIOD_NS)

    assert (found.seconds, found.bus, found.text) == (0.5, "main", "lose servo=3")
    (answer,) = found.answers
    assert (answer.name, answer.source, answer.text, answer.after_ms) == (
        "read_lost",
        "elbow",
        "no reply",
        20.0,
    )


def test_a_fault_of_the_whole_line_is_answered_by_any_servo_of_it_and_by_no_other():
    one = fault(1000, "noise size=4")
    found = answers(
        one,
        event(1015, EventCode.READ_LOST, "wrist"),
        event(1016, EventCode.BUS_NOISE, "main"),
        event(1017, EventCode.READ_LOST, "knee"),
        event(1018, EventCode.BUS_NOISE, "legs"),
    )
    assert found == [("read_lost", "wrist"), ("bus_noise", "main")]


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
    ids=[
        "long after it",
        "of another servo",
        "of the same ID on another bus",
        "of another kind",
        "of an end of silence",
        "of the loop",
        "of noise",
        "of a refusal because of another servo",
        "of a refusal because of another bus",
        "of the end",
    ],
)
def test_what_is_of_another_time_servo_or_kind_is_no_answer(wrong: Event):
    one = fault(1000, "silence servo=3")
    assert answers(one, wrong) == []
    assert unanswered(one, wrong) == ("elbow",)


def test_what_came_before_is_no_answer():
    assert answers(fault(1000, "lose servo=3"), event(999, EventCode.READ_LOST, "elbow")) == []


def test_a_refused_start_answers_the_fault_of_the_servo_that_it_names():
    refusal = event(50, EventCode.SETUP, "loop", "elbow (ID 3 on bus main) does not answer: check power")
    assert answers(fault(10, "silence servo=3"), refusal) == [("setup", "loop")]
    several = "none of the 8 servos on bus main answers: check: knee (ID 4) and those with the IDs 13, 3, 5"
    assert answers(fault(10, "silence servo=3"), event(50, EventCode.SETUP, "loop", several)) == [
        ("setup", "loop")
    ]
    others = event(50, EventCode.SETUP, "loop", several.replace(" 3,", " 33,"))
    assert answers(fault(10, "silence servo=3"), others) == []
    assert answers(fault(10, "unplug"), refusal) == [("setup", "loop")]
    assert answers(fault(10, "unplug", "legs"), refusal) == []


def test_no_servo_answers_the_fault_of_one_that_the_plan_does_not_name():
    assert answers(fault(1000, "lose servo=9"), event(1001, EventCode.READ_LOST, "elbow")) == []


def test_a_fault_of_a_kind_that_is_not_known_has_no_answer():
    assert answers(fault(1000, "gremlins servo=3"), event(1001, EventCode.READ_LOST, "elbow")) == []
    assert unanswered(fault(1000, "gremlins servo=3")) == ()


@pytest.mark.parametrize(
    ("text", "who"),
    [
        ("silence servo=3", ("elbow",)),
        ("silence servo=3 for=80ms", ("elbow",)),
        ("reboot servo=5", ("wrist",)),
        ("brownout", ("elbow", "wrist")),
        ("wedge for=100ms", ("elbow", "wrist")),
        ("unplug for=100ms", ("main",)),
    ],
)
def test_what_lasts_must_be_noticed(text: str, who: tuple[str, ...]):
    assert unanswered(fault(1000, text)) == who
    shown = [
        event(1010, EventCode.PORT_LOST if one == "main" else EventCode.READ_LOST, one) for one in who[:-1]
    ]
    assert unanswered(fault(1000, text), *shown) == who[-1:]


@pytest.mark.parametrize(
    "text",
    ["lose servo=3", "lose from=host", "noise size=4", "silence servo=3 for=79ms", "duplicate servo=3"],
)
def test_what_a_run_may_bear_in_silence_need_not_be_noticed(text: str):
    assert unanswered(fault(1000, text)) == ()


@pytest.mark.parametrize("t_ms", [99, 88_001], ids=["before the loop", "at its very end"])
def test_only_faults_of_the_running_loop_must_be_noticed(t_ms: int):
    assert unanswered(fault(t_ms, "silence servo=3")) == ()


def test_a_servo_that_is_silent_already_has_nothing_to_lose():
    lost = event(900, EventCode.READ_LOST, "elbow")
    one = fault(1000, "silence servo=3")
    assert unanswered(one, lost) == ()
    assert unanswered(one, lost, event(950, EventCode.READ_BACK, "elbow")) == ("elbow",)
    assert unanswered(one, event(900, EventCode.READ_LOST, "wrist")) == ("elbow",)


def test_a_lost_port_speaks_for_the_servos_of_its_line_only():
    one = fault(1000, "brownout")
    assert unanswered(one, event(1001, EventCode.PORT_LOST, "main")) == ()
    assert unanswered(one, event(1001, EventCode.PORT_LOST, "legs")) == ("elbow", "wrist")


def test_of_two_servos_with_one_id_the_other_one_answers():
    one = fault(1000, "silence servo=3")
    assert unanswered(one, before=fault(500, "duplicate_id servo=3")) == ()
    assert unanswered(one, before=fault(500, "duplicate_id servo=5")) == ("elbow",)
    assert unanswered(one, before=fault(500, "duplicate_id servo=3", "legs")) == ("elbow",)


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
    ids=[
        "nothing at all",
        "no unplug",
        "a later fault",
        "a fault long ago",
        "a fault of another bus",
        "a fault of another kind",
        "a reboot of another servo",
        "the heat of another servo",
        "a silent servo",
        "the plug of another bus",
    ],
)
def test_an_event_without_a_cause_is_found(entries: list[LedgerEntry], shown: Event):
    assert causeless(entries, shown) == [(shown.name, shown.source)]


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
    ids=[
        "its own fault",
        "of the request before it",
        "the request",
        "still silent",
        "shut down",
        "late",
        "its own shutdown",
    ],
)
def test_an_event_with_a_cause_is_none_of_them(entries: list[LedgerEntry], shown: Event):
    assert causeless(entries, shown) == []


def test_a_servo_silent_since_a_fault_may_report_it_late():
    entries = [fault(1000, "reboot servo=3 for=100ms"), fault(1050, "silence servo=3 for=8s")]
    lost, back = event(1010, EventCode.READ_LOST, "elbow"), event(1020, EventCode.READ_BACK, "elbow")
    rebooted = event(9800, EventCode.SERVO_REBOOTED, "elbow")
    assert causeless(entries, lost, rebooted) == []
    assert causeless(entries, lost, back, rebooted) == [("servo_rebooted", "elbow")]


def test_good_news_needs_no_cause():
    shown = Event(MS, EventCode.SERVO_ERROR, Severity.INFO, "elbow", "reports no error")
    assert causeless([], shown) == []
