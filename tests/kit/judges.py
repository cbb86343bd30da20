"""Judges of a run beside the ledger of its simulated buses, which the runtime cannot edit.

`log_has_every_byte`: the log has what passed the wire. `unnoticed` and `uncaused`: which injected faults have
no event that reports them, and which events report a fault that the ledger does not have. An event reports a
fault when it is of a fitting kind and of the fault's servo, or of its bus where the fault names no servo. It
has a cause when such a fault of its bus lasts, or ended not longer than two seconds ago; on a line the servos
behind a silent one lose their replies with it.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from tests.kit.line_faults import OTHER_HOST

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlrun.errors import InputError
from dxlrun.log.log_reader import Log
from dxlrun_analysis.plan_excerpt import plan_of
from dxlsim.bus.ledger import FAULT, LedgerEntry
from dxlsim.faults.fault import Fault, parse_fault
from dxlsim.faults.kinds import BABBLE_NS, BOOT_NS, BROWNOUT_NS, TURN_NS
from dxlwire.packets import PacketKind

WINDOW_NS = 2_000_000_000
"""An event that comes later reports something else [i]."""
LATE_NS = 1_000_000
"""A simulated reply that is later than this can be a lost one for the host [i]."""
UNREAD_BYTES = 4096
"""At most so many bytes come after the host has read for the last time."""
FEW_PERIODS = 4
"""A servo that is silent for so many periods has missed a read, with all retries."""
EVER = 1 << 62

Codes = frozenset[EventCode]
Joints = Mapping[tuple[str, int], str]
"""The joint of each servo, or the device, by bus and ID."""

NONE: Codes = frozenset()
MISSED = frozenset((EventCode.READ_LOST, EventCode.SERVO_LOST, EventCode.DEVICE_LOST))
GARBLED = MISSED | {EventCode.BUS_NOISE}
POWER = frozenset((EventCode.SERVO_LIMP, EventCode.SERVO_REBOOTED))
ERROR = frozenset((EventCode.SERVO_ERROR, EventCode.SERVO_LIMP))
PORT_LOST = frozenset((EventCode.PORT_LOST,))
IMPLAUSIBLE = frozenset((EventCode.IMPLAUSIBLE,))
ANOTHER_HOST = GARBLED | {EventCode.UNREQUESTED}
OF_THE_ROBOT = frozenset((EventCode.SETUP, EventCode.SHUTDOWN_FAILED))
"""Events of the whole robot; their text names servos and buses."""
NEEDS_CAUSE = ANOTHER_HOST | POWER | ERROR | PORT_LOST | {EventCode.SHUTDOWN_FAILED}
SILENT = MISSED | PORT_LOST
HEARD = frozenset((EventCode.READ_BACK, EventCode.SERVO_BACK, EventCode.DEVICE_BACK, EventCode.PORT_BACK))


class Kind(NamedTuple):
    """What one kind of fault leads to."""

    events: Codes
    lasts_ns: int = 0
    """Without `for=`."""
    leaves: Codes = NONE
    """What the servo has of it until it is started again."""
    due: bool = False
    """The runtime must report it, when it lasts some periods; False: it may tolerate it."""
    besides: Codes = NONE
    """What it may do beyond the events that report it."""


KINDS: Mapping[str, Kind] = {
    "lose": Kind(MISSED, besides=GARBLED),  # a fast status lacks its part, and is no packet
    "corrupt": Kind(GARBLED),
    "truncate": Kind(GARBLED),
    "delay": Kind(GARBLED),
    "duplicate": Kind(GARBLED),
    "noise": Kind(GARBLED),
    "babble": Kind(GARBLED, BABBLE_NS),
    "silence": Kind(MISSED, EVER, due=True, besides=GARBLED),
    "reboot": Kind(MISSED | POWER, BOOT_NS, due=True, besides=GARBLED),
    # its supply falls and rises
    "brownout": Kind(MISSED | POWER, BROWNOUT_NS, due=True, besides=GARBLED | ERROR),
    "voltage": Kind(MISSED | POWER | ERROR, EVER, ERROR),
    # only one that comes back is asked for its model again: it is then not taken back
    "other_model": Kind(MISSED, EVER),
    "overload": Kind(ERROR, 0, ERROR),
    "overheat": Kind(ERROR | {EventCode.SERVO_HOT}, EVER, ERROR),
    "turn": Kind(IMPLAUSIBLE, TURN_NS),
    # the second one may be heard alone: it has a clock of its own, and no torque
    "duplicate_id": Kind(GARBLED | POWER | IMPLAUSIBLE, EVER),
    "loose": Kind(GARBLED | POWER, EVER),
    "lossy": Kind(GARBLED | POWER, EVER),
    "slow": Kind(GARBLED, EVER),
    "jam": Kind(ERROR | IMPLAUSIBLE, EVER, ERROR),
    "sag": Kind(MISSED | POWER | ERROR, EVER, ERROR),
    "timer": Kind(GARBLED, EVER),
    # what happens meanwhile is seen when it is back
    "unplug": Kind(PORT_LOST, EVER, due=True, besides=GARBLED | POWER | ERROR),
    "wedge": Kind(MISSED, EVER, due=True, besides=GARBLED),
}
SHARED = GARBLED | IMPLAUSIBLE
"""What a fault of one servo may do to the others of its line: they wait for it, or talk at the same time."""


# The log beside the wire


def log_has_every_byte(log: Log, entries: Iterable[LedgerEntry]) -> None:
    """Compare all bytes of each bus; what arrived after the host's last look is not its business.

    Nor is what arrived while it did not have the line open: before a lost line was opened again.
    """
    entries = list(entries)
    for index, name in enumerate(log.buses):
        mine = [packet for packet in log.packets if packet.bus == index]
        sent = b"".join(packet.data for packet in mine if packet.kind == PacketKind.INSTRUCTION)
        received = [packet.data for packet in mine if packet.kind != PacketKind.INSTRUCTION]
        seen = [entry for entry in entries if entry.bus == name]
        assert sent == b"".join(entry.data for entry in seen if entry.direction == "in"), name
        replies, at = b"".join(entry.data for entry in seen if entry.direction == "out"), 0
        if any(entry.note == "adapter unplugged" for entry in seen):
            for each in received:
                at = replies.index(each, at) + len(each)
        else:
            assert replies.startswith(b"".join(received)), name
            assert sum(map(len, received)) > len(replies) - UNREAD_BYTES, name


# Faults without an event


def unnoticed(log: Log, entries: Iterable[LedgerEntry]) -> list[tuple[str, tuple[str, ...]]]:
    """Return the faults that the runtime had to report within two seconds, with the joints or buses missing.

    A servo that was silent already has nothing to lose, and of two with one ID the other one answers.
    """
    notes = [entry for entry in entries if entry.direction == "note" and entry.note.startswith(FAULT)]
    notes.sort(key=lambda entry: entry.t_ns)
    found = [
        (entry.note.removeprefix(FAULT), missing(log, entry, notes[:number]))
        for number, entry in enumerate(notes)
    ]
    return [(text, names) for text, names in found if names]


def missing(log: Log, entry: LedgerEntry, before: Sequence[LedgerEntry]) -> tuple[str, ...]:
    fault = fault_of(entry)
    kind = Kind(NONE) if fault is None else KINDS[fault.kind]
    if fault is None or not kind.due or not loop_runs(log.events, entry.t_ns):
        return ()
    if (fault.number("for") or kind.lasts_ns) < FEW_PERIODS * log.period_ns:
        return ()
    twins = [fault_of(one) for one in before if one.bus == entry.bus]
    doubled = {one.servo for one in twins if one is not None and one.kind == "duplicate_id"}
    asked = {entry.bus}
    if fault.kind != "unplug":
        asked = {
            joint
            for (bus, servo_id), joint in joints_of(log).items()
            if bus == entry.bus and fault.servo in (None, servo_id) and servo_id not in doubled
        }
    silent = silent_at(log.events, entry.t_ns)
    soon = [event for event in log.events if entry.t_ns <= event.t_ns <= entry.t_ns + WINDOW_NS]
    port_lost = any(event.code == EventCode.PORT_LOST and event.source == entry.bus for event in soon)
    if entry.bus in silent or port_lost:
        return ()
    return tuple(sorted(asked - silent - {event.source for event in soon if event.code in kind.events}))


def joints_of(log: Log) -> Joints:
    return {(bus.name, each): name for bus in plan_of(log).buses for each, name in bus.names.items()}


def fault_of(entry: LedgerEntry) -> Fault | None:
    """Return the fault of a note; None where this version knows none of that kind."""
    try:
        return parse_fault(entry.note.removeprefix(FAULT))
    except InputError:
        return None


def loop_runs(events: Sequence[Event], t_ns: int) -> bool:
    """Return whether the loop ran at a time, and for as long after it as an event may take."""
    times = {event.code: event.t_ns for event in events}
    begin_ns = times.get(EventCode.LOOP_STARTED, EVER)
    return begin_ns < t_ns < times.get(EventCode.LOOP_STOPPED, 0) - WINDOW_NS


def silent_at(events: Sequence[Event], t_ns: int) -> set[str]:
    """Return what did not answer at a time, as reported; also a servo that starts anew on request."""
    silent: set[str] = set()
    for event in sorted(events, key=lambda event: event.t_ns):
        if event.t_ns <= t_ns and event.code == EventCode.STEERED and event.text.startswith("reboot "):
            request = event.text.removeprefix("reboot ").rpartition(" from ")[0]
            silent.update(request.split(", "))
        if event.t_ns <= t_ns and event.code in SILENT:
            silent.add(event.source)
        elif event.t_ns <= t_ns and event.code in HEARD:
            silent.discard(event.source)
    return silent


# Events without a fault


class Cause(NamedTuple):
    """Something that happened to a bus or to one servo of it."""

    begin_ns: int
    end_ns: int
    bus: str
    servo: int | None
    """ID; None: the line, or all of them."""
    codes: Codes
    """What it may lead to at the place where it happened."""


def uncaused(log: Log, entries: Iterable[LedgerEntry]) -> list[Event]:
    """Return the events that report a fault without a cause in the ledger, in order of time.

    What the host did to itself (it was late, its disk was full) is not judged: no ledger knows it.
    """
    joints = joints_of(log)
    causes = [cause for entry in entries for cause in causes_of(entry)]
    silent_ns: dict[str, int] = {}
    found: list[Event] = []
    buses = {joint: bus for (bus, _), joint in joints.items()}
    for event in sorted(log.events, key=lambda event: event.t_ns):
        if event.code in NEEDS_CAUSE and event.severity >= Severity.WARNING:
            bus = buses.get(event.source, event.source)
            since_ns = min(silent_ns.get(event.source, event.t_ns), silent_ns.get(bus, event.t_ns))
            if not any(may_cause(cause, event, since_ns, joints) for cause in causes):
                found.append(event)
        if event.code in SILENT:
            silent_ns.setdefault(event.source, event.t_ns)
        elif event.code in HEARD:
            silent_ns.pop(event.source, None)
    return found


def causes_of(entry: LedgerEntry) -> list[Cause]:
    """Return what an entry may lead to: an injected fault, what a servo notes of itself, a late reply."""
    line = Cause(entry.t_ns, entry.t_ns, entry.bus, None, GARBLED)
    if entry.direction == "out" and entry.late_ns > LATE_NS:
        return [line._replace(end_ns=entry.t_ns + entry.late_ns)]
    if entry.direction != "note":
        return []
    if entry.note.startswith(("collision: ", OTHER_HOST)):
        return [line._replace(codes=ANOTHER_HOST if entry.note.startswith(OTHER_HOST) else GARBLED)]
    own = re.match(r"servo (\d+): (shutdown|overload|reboot|power cycle)", entry.note)
    if own:
        codes = MISSED | POWER if own[2] in {"reboot", "power cycle"} else ERROR
        return [line._replace(end_ns=EVER, servo=int(own[1]), codes=codes)]
    fault = fault_of(entry) if entry.note.startswith(FAULT) else None
    if fault is None:
        return []
    kind = KINDS[fault.kind]
    end_ns = entry.t_ns + (fault.number("for") or kind.lasts_ns) + (fault.number("by") or 0)
    codes = kind.events | kind.besides | OF_THE_ROBOT
    cause = line._replace(end_ns=end_ns, servo=fault.servo, codes=codes)
    of_others = [cause._replace(servo=None, codes=SHARED & codes)] if fault.servo is not None else []
    return [cause, cause._replace(end_ns=EVER, codes=kind.leaves), *of_others]


def may_cause(cause: Cause, event: Event, since_ns: int, joints: Joints) -> bool:
    """Return whether a cause is the reason of an event, whose source was silent since `since_ns` already."""
    if event.code not in cause.codes or cause.begin_ns > event.t_ns or cause.end_ns + WINDOW_NS < since_ns:
        return False
    if event.code in OF_THE_ROBOT:
        names = [joint for (bus, _), joint in joints.items() if bus == cause.bus]
        return f"bus {cause.bus}" in event.text or any(joint in event.text for joint in names)
    return event.source == cause.bus or any(
        event.source == joint
        for (bus, servo_id), joint in joints.items()
        if bus == cause.bus and cause.servo in (None, servo_id)
    )
