"""Rules of the verdict about losses in a run: buses, servos, devices, states and replies."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from dxlrun import ROTARY
from dxlrun.tooling.output import counted
from dxlrun.tooling.records import EventCode, EventGroup, Severity
from dxlrun_analysis.finding import HURTS, Finding, Rank, cause
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RunTotals

# A run is not good if more than this share of a joint's states is invalid.
INVALID_SHARE = 0.01
_FEW_INVALID = 2
"""Invalid states tolerated in a run of any length. A servo that misses three replies in a row is lost."""
_MOST_NAMED = 3


def severe_of(events: Iterable[EventGroup], *codes: EventCode) -> list[EventGroup]:
    """Return the event groups that have one of the codes, and severity error or above."""
    return [group for group in events if group.code in codes and group.severity >= Severity.ERROR]


def lost_lines(totals: RunTotals) -> Iterable[Finding]:
    """Report each bus whose port was lost, as the system reported it."""
    for group in severe_of(totals.events, EventCode.PORT_LOST):
        times = "" if group.count == 1 else f" {group.count} times"
        line = sentence_of(group)
        sentence = f"Bus {group.source} was lost{times}: {line}" + ("" if line.endswith("?") else ".")
        yield Finding("bus_lost", group.source, sentence, rank=Rank.LINE, share=group.count)


CODES = {
    EventCode.SERVO_REBOOTED: "servo_rebooted",
    EventCode.SERVO_LOST: "servo_lost",
    EventCode.SERVO_LIMP: "torque_lost",
}
_REFUSED = "Restore the values of the robot file; `dxlrun servo PORT ID get` prints those of the servo."
_CABLES = re.compile(r"\?.*")
_FEWEST_OF_BUS = 2  # A single servo does not show a common cause
_AT_ONCE_NS = 500_000_000  # Failures within half a second are simultaneous


def lost_servos(totals: RunTotals) -> Iterable[Finding]:
    """Report the servos that were lost, rebooted or lost their torque, in one finding about the worst."""
    by_source: dict[str, list[EventGroup]] = {}
    for group in severe_of(totals.events, *HURTS):
        by_source.setdefault(group.source, []).append(group)
    if not by_source:
        return
    failed = []
    ordered = sorted(
        by_source.items(),
        key=lambda item: (item[0] not in totals.returns, -sum(group.count for group in item[1])),
    )
    for source, happened in ordered:
        parts = []
        for code, what in HURTS.items():
            for group in [group for group in happened if group.code == code]:
                count = group.count - (len(totals.returns.get(source, ())) if what == "was lost" else 0)
                parts.append(what if count <= 1 else f"{what} {count} times")
        failed.append(f"{source} {_joined(parts)}")
    named = "; ".join(failed[:_MOST_NAMED])
    sentence = f"Servos failed: {named}{_more('; and', len(failed))}."
    lost_at = {one.name: one.lost_at for one in totals.tracking if one.unit is ROTARY}
    if len(by_source) == 1 and (at := lost_at.get(ordered[0][0])) is not None:
        sentence = f"{sentence[:-1]}, at {math.degrees(at):.0f} deg."
    # With more servos the common cause matters, not the reason of each servo.
    if len(by_source) <= _FEWEST_OF_BUS:
        for source, (*_, why) in totals.returns.items():
            # The rest of the text is about plugs, which a simulated servo does not have.
            seen = _CABLES.sub("?", why) if totals.plan.is_simulated(source) else why
            sentence += f" {source} {seen}" + ("" if seen.endswith("?") else ".")
    codes = {group.code for group in ordered[0][1]}
    first = next(code for code in HURTS if code in codes)
    rebooted = first == EventCode.SERVO_REBOOTED
    fix = _REFUSED if ordered[0][0] in totals.returns else ""
    if _failed_together(totals, by_source):
        sentence += f" They failed at once, while other servos {'ran on' if rebooted else 'answered'}: "
        sentence += "they share a supply or a cable."
        fix = "Check the cable, the plug and the fuse between them and the other servos."
    yield Finding(CODES[first], ordered[0][0], sentence, fix, Rank.SERVO)


def _failed_together(totals: RunTotals, failed: Mapping[str, Sequence[EventGroup]]) -> bool:
    """Return whether several but not all servos of a bus failed in the same way within half a second."""
    bus_of = {servo.joint: servo.bus for servo in totals.servos if servo.joint and not servo.device}
    bus, *others = {bus_of.get(source, "") for source in failed}
    first = [min(groups, key=lambda group: group.t_ns) for groups in failed.values()]
    times = [group.t_ns for group in first]
    same = {(group.code, group.count) for group in first} == {(first[0].code, first[0].count)}
    same &= first[0].code != EventCode.SERVO_LIMP
    few = _FEWEST_OF_BUS <= len(failed) < list(bus_of.values()).count(bus)
    return same and few and not others and max(times) - min(times) <= _AT_ONCE_NS


def lost_devices(totals: RunTotals) -> Iterable[Finding]:
    """Report all devices and sensors that were lost, in one finding that accuses the one lost most often."""
    lost: dict[str, int] = {}
    for group in severe_of(totals.events, EventCode.DEVICE_LOST):
        lost[group.source] = lost.get(group.source, 0) + group.count
    if lost:
        ordered = sorted(lost, key=lambda name: -lost[name])
        named = "; ".join(
            name if lost[name] == 1 else f"{name} {lost[name]} times" for name in ordered[:_MOST_NAMED]
        )
        sentence = f"Devices were lost: {named}{_more('; and', len(ordered))}."
        yield Finding("silent", ordered[0], sentence, rank=Rank.SERVO)


def whole_buses(totals: RunTotals) -> Iterable[Finding]:
    """Report each bus whose servos all rebooted or were lost at once, and several such buses as one.

    Servos of a bus share supply and adapter.
    """
    gone = {group.source for group in severe_of(totals.events, EventCode.PORT_LOST)}
    servos = [servo for servo in totals.servos if servo.joint and not servo.device]
    silent: dict[str, int] = {}  # Time of the first loss, ns, for each bus that lost all its servos
    for bus in sorted({servo.bus for servo in servos} - gone):
        joints = {servo.joint for servo in servos if servo.bus == bus}
        if _all_at_once(totals, EventCode.SERVO_REBOOTED, joints) is not None:
            what = f"All {len(joints)} servos of bus {bus} rebooted at once: their supply failed."
            yield Finding("power_lost", bus, what, rank=Rank.SERVO_CAUSE, share=2.0)
        elif (t_ns := _all_at_once(totals, EventCode.SERVO_LOST, joints)) is not None:
            silent[bus] = t_ns
    if len(silent) > 1 and max(silent.values()) - min(silent.values()) <= _AT_ONCE_NS:
        named = _joined(tuple(silent))
        what = f"All servos of buses {named} were lost at once: the cause is common to them."
        yield Finding("servo_lost", "machine", what, rank=Rank.SERVO_CAUSE)
        return
    for bus in silent:
        count = sum(servo.bus == bus for servo in servos)
        what = f"All {count} servos of bus {bus} were lost at once: the cause is not a single servo."
        fix = "Check the adapter, the first cable and the supply of the bus."
        yield Finding("servo_lost", bus, what, fix, Rank.SERVO_CAUSE)


def _all_at_once(totals: RunTotals, code: EventCode, joints: set[str]) -> int | None:
    """Return the time (ns) of the first event of a code, if all these joints had one within half a second.

    None: the events were not simultaneous, some joints had none, or there is only one joint.
    """
    times = {group.source: group.t_ns for group in severe_of(totals.events, code) if group.source in joints}
    if len(joints) < _FEWEST_OF_BUS or set(times) != joints:
        return None
    first = min(times.values())
    return first if max(times.values()) - first <= _AT_ONCE_NS else None


def _joined(parts: Sequence[str]) -> str:
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def invalid_states(totals: RunTotals) -> Iterable[Finding]:
    """Report joints whose states were invalid in too many cycles, in one finding."""
    cycles, counts = totals.periods.records, invalid_joints(totals)
    if not counts:
        return
    waited = waited_in_vain(totals)
    ordered = sorted((joint in waited, -count / cycles, joint) for joint, count in counts.items())
    named = ", ".join(f"{joint} in {-share:.1%}" for _, share, joint in ordered[:_MOST_NAMED])
    more = _more(", and", len(ordered), "more joint", "more joints")
    behind = f", {len(waited)} of these joints because a preceding reply was missing" if waited else ""
    sentence = f"States were invalid: {named} of the cycles{more}{behind}; {INVALID_SHARE:.0%} is tolerated."
    share = max(counts.values()) / cycles
    subject = ordered[0][2] if len(waited) < len(counts) else totals.bus_of(ordered[0][2])
    yield Finding("invalid_states", subject, sentence, rank=Rank.SHARE, share=share)


def invalid_joints(totals: RunTotals) -> dict[str, int]:
    """Return the number of cycles with an invalid state of each joint that exceeds the tolerance."""
    cycles = totals.periods.records
    return {
        joint: count
        for joint, count in zip(totals.joints, totals.invalid, strict=False)
        if cycles and count > max(_FEW_INVALID, INVALID_SHARE * cycles)
    }


def waited_in_vain(totals: RunTotals) -> set[str]:
    """Return the joints with too many invalid states because replies before those of their servos were
    missing, not their own."""
    counts = invalid_joints(totals)
    servos = {(servo.bus, servo.servo_id): servo for servo in totals.servos}
    found = set()
    for joint, movers in totals.plan.movers.items():
        mine = [servos.get((mover.bus.name, mover.servo.servo_id)) for mover in movers]
        lost = sum(one.lost for one in mine if one)
        own = sum(one.losses.lost for one in mine if one and one.losses)
        if joint in counts and 2 * (lost - own) >= counts[joint] > 2 * own:
            found.add(joint)
    return found


def implausible(totals: RunTotals) -> Iterable[Finding]:
    """Report each joint with positions that the loop rejected as implausible."""
    named = {one.subject for one in totals.findings if one.code == "position_jumped"}
    for group in totals.events:
        if group.code == EventCode.IMPLAUSIBLE and group.source in totals.plan.movers.keys() - named:
            yield cause("position_jumped", group.source, f"{sentence_of(group)}.", share=4.0)


def missing_replies(totals: RunTotals) -> Iterable[Finding]:
    """Report the servos and devices with missing replies, or that all answered every time, in one finding."""
    asked = [servo for servo in totals.servos if servo.asked]
    if not asked:
        return
    losers = sorted((servo for servo in asked if servo.lost), key=lambda servo: -servo.lost)
    if not losers and any(
        severe_of(totals.events, EventCode.PORT_LOST, EventCode.SERVO_LOST, EventCode.DEVICE_LOST)
    ):
        return  # Servos answered as long as they were asked; another rule reports the loss
    if not losers:
        yield Finding("replies", "", f"{_all(asked)} answered every time.")
        return
    named = ", ".join(
        f"{_name(servo)} {servo.lost} of {servo.asked} times ({servo.lost / servo.asked:.2%})"
        for servo in losers[:_MOST_NAMED]
    )
    more = _more(", and", len(losers))
    rest = len(asked) - len(losers)
    others = f"; {rest} of {len(asked)} {_kinds(asked)} answered every time" if rest else ""
    sentence = f"Replies are missing: {named}{more}{others}."
    yield Finding("replies", losers[0].subject, sentence)


def _all(asked: Sequence[ServoTraffic]) -> str:
    return f"All {len(asked)} {_kinds(asked)}" if len(asked) > 1 else "The servo"


def _kinds(asked: Sequence[ServoTraffic]) -> str:
    return "servos and devices" if any(one.device for one in asked) else "servos"


def servo_errors(totals: RunTotals) -> Iterable[Finding]:
    """Report the servos and devices whose replies had error bits, in one finding."""
    troubled = [servo for servo in totals.servos if servo.errors]
    if not troubled:
        return
    named = "; ".join(
        f"{_name(servo)}: {', '.join(servo.error_names) or 'unknown bit'} in "
        f"{counted(servo.errors, 'reply', 'replies')}"
        for servo in troubled[:_MOST_NAMED]
    )
    more = _more("; and", len(troubled))
    sentence = f"Servos reported errors: {named}{more}."
    yield Finding("servo_error", troubled[0].subject, sentence, rank=Rank.ERROR)


def _more(joining: str, count: int, one: str = "more servo", many: str = "more servos") -> str:
    """Return `joining` and the number of names beyond the three that a sentence lists, as text; empty if
    there are none."""
    beyond = count - _MOST_NAMED
    return f"{joining} {counted(beyond, one, many)}" if beyond > 0 else ""


def _name(servo: ServoTraffic) -> str:
    kind = "device" if servo.device else "servo"
    return f"{kind} {servo.servo_id} ({servo.joint or servo.bus})"


def sentence_of(group: EventGroup) -> str:
    """Return an event's text in one line: all problems of a refused start-up, otherwise the last line,
    such as that of a traceback."""
    lines = group.text.strip().splitlines() or [group.name]
    return "; ".join(lines) if group.code == EventCode.SETUP else lines[-1]
