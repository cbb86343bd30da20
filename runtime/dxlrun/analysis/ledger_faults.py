"""Faults that were injected into the simulated bus, and which event of the log answers each."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from dxlrun.events import Event, EventCode
from dxlrun.simulation import LedgerEntry

MARK = "fault: "
"""How the note of an injected fault begins in the ledger."""
WINDOW_NS = 2_000_000_000
"""An event that comes later answers something else [i]."""

_ANSWERS = frozenset(
    {
        EventCode.OVERRUN,
        EventCode.SETUP,
        EventCode.TORQUE_OFF,
        EventCode.SHUTDOWN_FAILED,
        EventCode.REGISTER_DIFFERS,
        EventCode.READ_LOST,
        EventCode.READ_BACK,
        EventCode.SERVO_ERROR,
        EventCode.SERVO_LIMP,
        EventCode.BUS_NOISE,
        EventCode.PORT_LOST,
        EventCode.CONTROLLER_FAULT,
        EventCode.GUARDIAN,
    }
)
_OF_ONE_JOINT = frozenset(
    {EventCode.READ_LOST, EventCode.READ_BACK, EventCode.SERVO_ERROR, EventCode.SERVO_LIMP}
)
_SERVO = re.compile(r"\bservo=(\d+)\b")


@dataclass(frozen=True, slots=True)
class Answer:
    """An event of the log that came soon after a fault and may be due to it."""

    name: str
    source: str
    text: str
    after_ms: float


@dataclass(frozen=True, slots=True)
class FaultAnswers:
    """One injected fault with what the runtime said within two seconds."""

    seconds: float
    """Since the log's first packet."""
    bus: str
    text: str
    answers: tuple[Answer, ...]
    """In order of time; empty: the runtime said nothing, as of a fault that it bears in silence."""


def faults_in(entries: Iterable[LedgerEntry]) -> list[LedgerEntry]:
    """Return the notes of injected faults, in order of time."""
    faults = [entry for entry in entries if entry.direction == "note" and entry.note.startswith(MARK)]
    return sorted(faults, key=lambda entry: entry.t_ns)


def answered(
    faults: Sequence[LedgerEntry],
    events: Sequence[Event],
    joints: Mapping[tuple[str, int], str],
    begin_ns: int,
) -> tuple[FaultAnswers, ...]:
    """Return each fault with the events that may answer it.

    `joints`: the joint of each servo, by bus and ID; an event about a servo answers only a fault of that
    servo, and any fault that names none.
    """
    return tuple(
        FaultAnswers(
            seconds=(fault.t_ns - begin_ns) / 1e9,
            bus=fault.bus,
            text=fault.note.removeprefix(MARK),
            answers=tuple(
                Answer(event.name, event.source, event.text, (event.t_ns - fault.t_ns) / 1e6)
                for event in events
                if 0 <= event.t_ns - fault.t_ns <= WINDOW_NS and _may_answer(event, fault, joints)
            ),
        )
        for fault in faults
    )


def _may_answer(event: Event, fault: LedgerEntry, joints: Mapping[tuple[str, int], str]) -> bool:
    if event.code not in _ANSWERS:
        return False
    named = _SERVO.search(fault.note)
    if named is None or event.code not in _OF_ONE_JOINT:
        return True
    return event.source == joints.get((fault.bus, int(named[1])), event.source)
