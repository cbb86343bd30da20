"""Faults that were injected into the simulated bus, the events that answer them, and events without a cause.

Both ways the same rules hold. An event answers a fault when it is of a fitting kind and of the fault's servo,
or of its bus where the fault names no servo. It has a cause when such a fault of its bus lasts, or ended not
longer than two seconds ago; on a line the servos behind a silent one lose their replies with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from dxlrun.channels.events import Event, EventCode, Severity
from dxlrun.errors import InputError
from dxlrun.simulation import LedgerEntry
from dxlrun.simulation.bus.ledger import FAULT, OTHER_HOST
from dxlrun.simulation.faults.fault import BABBLE_NS, BOOT_NS, BROWNOUT_NS, TURN_NS, Fault, parse_fault

WINDOW_NS = 2_000_000_000
"""An event that comes later answers something else [i]."""
LATE_NS = 1_000_000
"""A simulated reply that is later than this can be a lost one for the host [i]."""
_EVER = 1 << 62
_SHORTEST_PERIODS = 4
"""A servo that is silent for so many periods has missed a read, with all retries."""

_MISSED = frozenset((EventCode.READ_LOST, EventCode.SERVO_LOST, EventCode.DEVICE_LOST))
_GARBLED = _MISSED | {EventCode.BUS_NOISE}
_OTHER_HOST = _GARBLED | {EventCode.UNREQUESTED}
_POWER = frozenset((EventCode.SERVO_LIMP, EventCode.SERVO_REBOOTED))
_ERROR = frozenset((EventCode.SERVO_ERROR, EventCode.SERVO_LIMP))
_SENTENCES = frozenset((EventCode.SETUP, EventCode.SHUTDOWN_FAILED))
"""Events of the whole robot; their text names servos and buses."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """What one kind of fault leads to."""

    answers: frozenset[EventCode]
    """Events that the runtime may answer with."""
    lasts_ns: int = 0
    """Without `for=`."""
    leaves: frozenset[EventCode] = frozenset()
    """What the servo has of it until it is started again."""
    due: bool = False
    """The runtime must report it, when it lasts some periods; False: it may tolerate it."""


_KINDS: Mapping[str, _Kind] = {
    "lose": _Kind(_MISSED),
    "corrupt": _Kind(_GARBLED),
    "truncate": _Kind(_GARBLED),
    "delay": _Kind(_GARBLED),
    "duplicate": _Kind(_GARBLED),
    "noise": _Kind(_GARBLED),
    "babble": _Kind(_GARBLED, BABBLE_NS),
    "silence": _Kind(_MISSED, _EVER, due=True),
    "reboot": _Kind(_MISSED | _POWER, BOOT_NS, due=True),
    "brownout": _Kind(_MISSED | _POWER, BROWNOUT_NS, due=True),
    "voltage": _Kind(_MISSED | _POWER | _ERROR, _EVER, _ERROR),
    # only one that comes back is asked for its model again: it is then not taken back
    "other_model": _Kind(_MISSED, _EVER),
    "overload": _Kind(_ERROR, 0, _ERROR),
    "overheat": _Kind(_ERROR | {EventCode.SERVO_HOT}, _EVER, _ERROR),
    "turn": _Kind(frozenset((EventCode.IMPLAUSIBLE,)), TURN_NS),
    # the second one may be heard alone: it has a clock of its own, and no torque
    "duplicate_id": _Kind(_GARBLED | _POWER | {EventCode.IMPLAUSIBLE}, _EVER),
    "loose": _Kind(_GARBLED | _POWER, _EVER),
    "lossy": _Kind(_GARBLED | _POWER, _EVER),
    "slow": _Kind(_GARBLED, _EVER),
    "jam": _Kind(_ERROR | {EventCode.IMPLAUSIBLE}, _EVER, _ERROR),
    "sag": _Kind(_MISSED | _POWER | _ERROR, _EVER, _ERROR),
    "timer": _Kind(_GARBLED, _EVER),
    "unplug": _Kind(frozenset((EventCode.PORT_LOST,)), _EVER, due=True),
    "wedge": _Kind(_MISSED, _EVER, due=True),
}
_LATE = _Kind(_MISSED)
_SHARED = _GARBLED | {EventCode.IMPLAUSIBLE}
"""What a fault of one servo may do to the others of its line: they wait for it, or talk at the same time."""
_CONSEQUENCES: Mapping[str, frozenset[EventCode]] = {
    "lose": _GARBLED,  # a fast status lacks its part, and is no packet
    "silence": _GARBLED,
    "wedge": _GARBLED,
    "reboot": _GARBLED,
    "brownout": _GARBLED | _ERROR,  # its supply falls and rises
    "unplug": _GARBLED | _POWER | _ERROR,  # what happens meanwhile is seen when it is back
}
_NEEDS_CAUSE = _OTHER_HOST | _POWER | _ERROR | {EventCode.PORT_LOST, EventCode.SHUTDOWN_FAILED}
_SILENT = _MISSED | {EventCode.PORT_LOST}
_HEARD = frozenset((EventCode.READ_BACK, EventCode.SERVO_BACK, EventCode.DEVICE_BACK, EventCode.PORT_BACK))
_OWN = ("shutdown", "overload", "reboot", "power cycle")
"""What a simulated servo notes of itself, beside what is injected."""

Joints = Mapping[tuple[str, int], str]
"""The joint of each servo, or the device, by bus and ID."""


@dataclass(frozen=True, slots=True)
class EventAnswer:
    """An event of the log that came soon after a fault, of its servo or bus and of a kind that fits it."""

    name: str
    source: str
    text: str
    after_ms: float


@dataclass(frozen=True, slots=True)
class FaultAnswers:
    """One injected fault with the events that the runtime logged within two seconds."""

    seconds: float
    """Since the log's first packet."""
    bus: str
    text: str
    answers: tuple[EventAnswer, ...]
    """In order of time; empty: none, as for a fault that it tolerates."""
    unanswered: tuple[str, ...] = ()
    """Joints and buses whose event is missing."""


@dataclass(frozen=True, slots=True)
class UncausedEvent:
    """An event that reports a fault where the ledger has none."""

    seconds: float
    """Since the log's first packet."""
    name: str
    source: str
    text: str


@dataclass(frozen=True, slots=True)
class _Cause:
    """Something that happened to a bus or to one servo of it."""

    begin_ns: int
    end_ns: int
    bus: str
    servo: int | None
    """ID; None: the line, or all of them."""
    codes: frozenset[EventCode]
    """What it may lead to at the place where it happened."""


def faults_in(entries: Iterable[LedgerEntry]) -> list[LedgerEntry]:
    """Return the notes of injected faults, in order of time."""
    faults = [entry for entry in entries if entry.direction == "note" and entry.note.startswith(FAULT)]
    return sorted(faults, key=lambda entry: entry.t_ns)


def answered(
    entries: Iterable[LedgerEntry],
    events: Sequence[Event],
    joints: Joints,
    begin_ns: int,
    period_ns: int,
) -> tuple[FaultAnswers, ...]:
    """Return each injected fault of a ledger with the events that answer it.

    `begin_ns`: from when seconds are counted; `period_ns`: the loop's: a shorter fault may be missed.
    """
    faults = faults_in(entries)
    return tuple(
        FaultAnswers(
            seconds=(entry.t_ns - begin_ns) / 1e9,
            bus=entry.bus,
            text=entry.note.removeprefix(FAULT),
            answers=tuple(
                EventAnswer(event.name, event.source, event.text, (event.t_ns - entry.t_ns) / 1e6)
                for event in events
                if 0 <= event.t_ns - entry.t_ns <= WINDOW_NS and _answers(event, entry, joints)
            ),
            unanswered=_unanswered(entry, faults[:number], events, joints, period_ns),
        )
        for number, entry in enumerate(faults)
    )


def uncaused(
    entries: Iterable[LedgerEntry], events: Sequence[Event], joints: Joints, begin_ns: int
) -> tuple[UncausedEvent, ...]:
    """Return the events that report a fault without a cause in the ledger, in order of time.

    What the host did to itself (it was late, its disk was full) is not judged: no ledger knows it.
    """
    causes = _causes(entries)
    silent_ns: dict[str, int] = {}
    found: list[UncausedEvent] = []
    places = {joint: (bus, servo) for (bus, servo), joint in joints.items()}
    for event in sorted(events, key=lambda event: event.t_ns):
        if event.code in _NEEDS_CAUSE and event.severity >= Severity.WARNING:
            bus, _ = places.get(event.source, (event.source, None))
            since_ns = min(silent_ns.get(event.source, event.t_ns), silent_ns.get(bus, event.t_ns))
            if not any(_may_cause(cause, event, since_ns, joints) for cause in causes):
                seconds = (event.t_ns - begin_ns) / 1e9
                found.append(UncausedEvent(seconds, event.name, event.source, event.text))
        if event.code in _SILENT:
            silent_ns.setdefault(event.source, event.t_ns)
        elif event.code in _HEARD:
            silent_ns.pop(event.source, None)
    return tuple(found)


def _fault(entry: LedgerEntry) -> Fault | None:
    """Return the fault of a note; None where this version knows none of that kind."""
    try:
        return parse_fault(entry.note.removeprefix(FAULT))
    except InputError:
        return None


def _answers(event: Event, entry: LedgerEntry, joints: Joints) -> bool:
    fault = _fault(entry)
    if fault is None:
        return False
    if event.code in _SENTENCES:
        return _names(event, entry.bus, fault.servo, joints)
    return event.code in _KINDS[fault.kind].answers and _at(event, entry.bus, fault.servo, joints)


def _at(event: Event, bus: str, servo: int | None, joints: Joints) -> bool:
    """Return whether an event's source is this servo or its bus; None: any servo of the bus."""
    if event.source == bus:
        return True
    names = {joint for (of, servo_id), joint in joints.items() if of == bus and servo in (None, servo_id)}
    return event.source in names


def _names(event: Event, bus: str, servo: int | None, joints: Joints) -> bool:
    """Return whether a sentence is about this servo, or about this bus."""
    if servo is None:
        names = [joint for (of, _), joint in joints.items() if of == bus]
        return f"bus {bus}" in event.text or any(joint in event.text for joint in names)
    of_bus = re.search(rf"\bon bus {re.escape(bus)}\b", event.text)
    return of_bus is not None and re.search(rf"\bIDs? (\d+, )*{servo}\b", event.text) is not None


def _unanswered(
    entry: LedgerEntry,
    before: Sequence[LedgerEntry],
    events: Sequence[Event],
    joints: Joints,
    period_ns: int,
) -> tuple[str, ...]:
    """Return of which joints or buses the runtime had to tell that this fault came, and did not.

    A servo that was silent already has nothing to lose, and of two with one ID the other one answers.
    """
    fault = _fault(entry)
    kind = None if fault is None else _KINDS[fault.kind]
    if fault is None or kind is None or not kind.due:
        return ()
    if (fault.for_ns or kind.lasts_ns) < _SHORTEST_PERIODS * period_ns or not _running(events, entry.t_ns):
        return ()
    if fault.kind == "unplug":
        asked = {entry.bus}
    else:
        twins = [_fault(one) for one in before if one.bus == entry.bus]
        doubled = {one.servo for one in twins if one is not None and one.kind == "duplicate_id"}
        asked = {
            joint
            for (bus, servo_id), joint in joints.items()
            if bus == entry.bus and fault.servo in (None, servo_id) and servo_id not in doubled
        }
    silent = _silent_at(events, entry.t_ns)
    if entry.bus in silent:
        return ()
    soon = [event for event in events if entry.t_ns <= event.t_ns <= entry.t_ns + WINDOW_NS]
    if any(event.code == EventCode.PORT_LOST and event.source == entry.bus for event in soon):
        return ()
    answered_by = {event.source for event in soon if event.code in kind.answers}
    return tuple(sorted(asked - silent - answered_by))


def _running(events: Sequence[Event], t_ns: int) -> bool:
    """Return whether the loop ran at a time, and for as long after it as an answer may take."""
    times = {event.code: event.t_ns for event in events}
    begin_ns = times.get(EventCode.LOOP_STARTED, _EVER)
    return begin_ns < t_ns < times.get(EventCode.LOOP_STOPPED, 0) - WINDOW_NS


def _silent_at(events: Sequence[Event], t_ns: int) -> set[str]:
    silent: set[str] = set()
    for event in sorted(events, key=lambda event: event.t_ns):
        if event.t_ns > t_ns:
            break
        if event.code in _SILENT:
            silent.add(event.source)
        elif event.code in _HEARD:
            silent.discard(event.source)
    return silent


def _causes(entries: Iterable[LedgerEntry]) -> list[_Cause]:
    """Return what may lead to events: injected faults, what servos note of themselves, and late replies."""
    found: list[_Cause] = []
    for entry in entries:
        if entry.direction == "out" and entry.late_ns > LATE_NS:
            found.append(_Cause(entry.t_ns, entry.t_ns + entry.late_ns, entry.bus, None, _GARBLED))
        elif entry.direction != "note":
            continue
        elif entry.note.startswith(FAULT):
            found += _causes_of(entry)
        elif entry.note.startswith("collision: "):
            found.append(_Cause(entry.t_ns, entry.t_ns, entry.bus, None, _GARBLED))
        elif entry.note.startswith(OTHER_HOST):
            found.append(_Cause(entry.t_ns, entry.t_ns, entry.bus, None, _OTHER_HOST))
        elif entry.note.startswith("servo "):
            number, _, what = entry.note.removeprefix("servo ").partition(": ")
            if number.isdecimal() and what.startswith(_OWN):
                codes = _MISSED | _POWER if what.startswith(("reboot", "power")) else _ERROR
                found.append(_Cause(entry.t_ns, _EVER, entry.bus, int(number), codes))
    return found


def _causes_of(entry: LedgerEntry) -> list[_Cause]:
    fault = _fault(entry)
    if fault is None:
        return []
    kind = _KINDS[fault.kind]
    lasts_ns = (fault.for_ns or kind.lasts_ns) + (fault.by_ns or 0)
    cause = _Cause(
        entry.t_ns,
        entry.t_ns + lasts_ns,
        entry.bus,
        fault.servo,
        kind.answers | _CONSEQUENCES.get(fault.kind, frozenset()) | _SENTENCES,
    )
    found = [cause, replace(cause, end_ns=_EVER, codes=kind.leaves)]
    if fault.servo is not None:
        found.append(replace(cause, servo=None, codes=_SHARED & cause.codes))
    return found


def _may_cause(cause: _Cause, event: Event, since_ns: int, joints: Joints) -> bool:
    """Return whether a cause is the reason of an event, whose source was silent since `since_ns` already."""
    if event.code not in cause.codes or cause.begin_ns > event.t_ns or cause.end_ns + WINDOW_NS < since_ns:
        return False
    if event.code in _SENTENCES:
        return _names(event, cause.bus, None, joints)
    return _at(event, cause.bus, cause.servo, joints)
