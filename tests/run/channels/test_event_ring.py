"""Events through a ring: each comes out as it went in."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dxlrun.channels.event_records import (
    LONGEST_EVENT,
    LONGEST_TEXT,
    Event,
    EventBody,
    EventCode,
    EventRing,
    Severity,
    event_capacity,
)
from dxlrun.channels.ring import Handover, record_size
from dxlrun.channels.tagged import decode
from dxlwire.clock import VirtualClock


def emitted(code: EventCode, severity: Severity, source: str, text: str, at_ns: int = 5) -> bytes:
    records: list[bytes] = []
    ring = EventRing(Handover(lambda _, payload: records.append(bytes(payload))), VirtualClock(at_ns))
    ring.emit_event(source, EventBody(code, severity, text))
    (record,) = records
    assert len(record) <= LONGEST_EVENT
    return record


def decoded(record: bytes) -> Event:
    event = decode(record)
    assert isinstance(event, Event)
    return event


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=600)


@settings(max_examples=100, deadline=None)
@example(EventCode.GATE, Severity.INFO, "ä" * 600)
@example(EventCode.GATE, Severity.INFO, "x" + "€" * 600)
@given(st.sampled_from(EventCode), st.sampled_from(Severity), TEXT)
def test_an_event_comes_out_as_it_went_in(code, severity, text):
    event = decoded(emitted(code, severity, "head_yaw_joint", text))
    assert event == Event(5, code, severity, "head_yaw_joint", text)


def test_what_cannot_be_encoded_or_is_endless_is_still_recorded():
    event = decoded(
        emitted(EventCode.CONTROLLER_FAULT, Severity.ERROR, "\N{ROBOT FACE}" * 500, "\udcff" + "€" * 100_000)
    )
    assert event.text == "?" + "€" * (LONGEST_TEXT - 1)
    assert event.source == "\N{ROBOT FACE}" * 64


def test_a_code_of_a_newer_version_stays_a_number():
    newer = decoded(msgspec.msgpack.encode(Event(5, 999, 30, "a", "b")))
    assert (newer, newer.name) == (Event(5, 999, 30, "a", "b"), "code_999")
    assert Event(5, 40, 30, "a", "b").name == "gate"


@pytest.mark.parametrize("cut", [0, 3, 8])
def test_a_cut_event_is_refused(cut):
    with pytest.raises(ValueError, match="truncated"):
        decoded(emitted(EventCode.GATE, Severity.WARNING, "a", "b")[:cut])


def test_the_ring_holds_ten_seconds_of_the_worst_storm():
    text = "the reply of servo 17 on bus legs was missed for the 3rd time, and is missed on"
    record = emitted(EventCode.READ_LOST, Severity.WARNING, "right_shoulder_swing_joint", text)
    assert event_capacity(1_000_000, 18) >= 10 * 1000 * 22 * record_size(len(record))
