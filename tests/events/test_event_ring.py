"""The event ring: what is said arrives, long texts in pieces."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dxlrun.clock import VirtualClock
from dxlrun.run.channels.events import (
    EVENT_SLOT,
    Event,
    EventCode,
    EventRing,
    Severity,
    decode_event,
    event_slots,
)
from dxlrun.run.channels.ring import Handover


def emitted(code: EventCode, severity: Severity, source: str, text: str, at_ns: int = 5) -> list[bytes]:
    slots: list[bytes] = []
    ring = EventRing(Handover(lambda payload: slots.append(bytes(payload)), EVENT_SLOT), VirtualClock(at_ns))
    ring.emit(code, severity, source, text)
    return slots


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=600)


@settings(max_examples=100, deadline=None)
@example(EventCode.GATE, Severity.INFO, "ä" * 600)
@example(EventCode.GATE, Severity.INFO, "x" + "€" * 600)
@given(st.sampled_from(EventCode), st.sampled_from(Severity), TEXT)
def test_an_event_comes_out_as_it_went_in(code: EventCode, severity: Severity, text: str) -> None:
    slots = emitted(code, severity, "head_yaw_joint", text)
    events = [decode_event(slot) for slot in slots]
    assert all(len(slot) <= EVENT_SLOT for slot in slots)
    assert "".join(event.text for event in events) == text
    assert [event.part for event in events] == list(range(len(events)))
    for event in events:
        assert (event.t_ns, event.code, event.severity, event.source) == (5, code, severity, "head_yaw_joint")


def test_what_cannot_be_encoded_or_is_endless_is_still_said() -> None:
    slots = emitted(EventCode.CONTROLLER_FAULT, Severity.ERROR, "x" * 500, "\udcff" + "y" * 100_000)
    assert len(slots) == 32
    assert decode_event(slots[0]).text.startswith("?yyy")


def test_a_code_of_a_newer_version_stays_a_number() -> None:
    slot = bytearray(emitted(EventCode.GATE, Severity.WARNING, "a", "b")[0])
    slot[8:10] = (999).to_bytes(2, "little")
    assert decode_event(slot) == Event(5, 999, 30, "a", "b")
    assert decode_event(slot).name == "code_999"
    assert Event(5, 40, 30, "a", "b").name == "gate"


@pytest.mark.parametrize("cut", [3, 17])
def test_a_cut_event_is_refused(cut: int) -> None:
    with pytest.raises(ValueError, match="an event"):
        decode_event(emitted(EventCode.GATE, Severity.WARNING, "a", "b")[0][:cut])


def test_the_ring_holds_ten_seconds_of_the_worst_storm() -> None:
    assert event_slots(1_000_000, 18) >= 10 * 1000 * 18
