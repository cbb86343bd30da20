"""The one gate in front of all rules: is the evidence complete, and what does a finding still accuse?

A rule speaks only where the evidence that it needs (`Needs` in rules.py) is complete, start-up included. A
machine that was too busy is named in any case, and stands for what it explains: late and missing replies,
which it causes for real servos, too, as they wait in its driver, and all that is derived from goals and
states that did not come when they were due. What failed is told all the same, without a remedy.

Of findings about the same replies the one with the most direct evidence stays: what holds for the machine or
a bus stands for its servos.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from dxlrun.tooling.output import choose_remedy, counted, free_machine, microseconds
from dxlrun.tooling.records import EventCode
from dxlrun_analysis.finding import HURTS, Finding, Rank
from dxlrun_analysis.lost import invalid_joints, severe_of
from dxlrun_analysis.rules import RULES, Needs
from dxlrun_analysis.servos.other_host import SPOILS
from dxlrun_analysis.tally import RealTime, RunTotals

_REPLIES = (
    *("power_lost", "another_host", "late_replies", "broken_replies", "slow_servo", "noise", "lossy_servo"),
    "lossy_line",
)
"""Codes of what is wrong with replies, the most direct evidence first."""
_WEAK = ("noise", "lossy_line")
"""Those that only say that bytes belong to no packet, or that replies are missing."""
_SPOILT = frozenset(("power_lost", "noise", "broken_replies", "lossy_line", "bus_lost"))
"""Codes after which goals wait, and joints follow worse that are not at fault; another host does the same
whose goals or replies are among those of this run."""
_UNANSWERED = frozenset(("servo_lost", "silent"))
"""Codes of what failed by replies that did not come, which may be a busy machine's."""
_FAILED = _UNANSWERED | {"servo_rebooted", "torque_lost"}
_SHARED = "Check what these buses share: the USB hub, its driver, the supply."
_MARGIN = 0.1
"""A busy machine makes no greater a share of the replies late than so much above its share of the run."""
_LATE_SHARE = 0.01
"""Wake-ups more than 1 ms late from which replies wait for the loop as often as for the line."""
_LEAST_CYCLES = 3  # One stall of a machine is not a busy one
_PART = 5  # Of the excess of long cycles: what has less than a fifth is not worth its words


def busy_machine(totals: RunTotals) -> list[str]:
    """Return what shows that the machine was too busy, in words; nothing: it was not.

    Its samples, waits for simulated servos, wake-ups that were late, and what woke the loop late where that
    has most of what long cycles took. The wake-ups of a sequential loop wait for nothing.
    """
    load, causes = totals.causes.load, totals.causes.causes
    parts = [load.text] if load.share else []
    parts += [totals.wait.text] if totals.wait.times >= _LEAST_CYCLES else []
    if totals.plan.loop.schedule == "sequential":
        return parts
    late = totals.latency.share_over_1_ms if totals.latency else 0.0
    if late > _LATE_SHARE:
        parts.append(f"{late:.1%} of the wake-ups were more than 1 ms late")
    total_ns = sum(one.long_ns for one in causes)
    mine = [one for one in causes if one.kind in ("machine", "late wake-up") and one.cycles >= _LEAST_CYCLES]
    if parts or sum(one.long_ns for one in mine) >= total_ns / 2 > 0:
        parts += [
            f"{one.subject or one.kind} took {microseconds(one.long_ns / 1e3)} of "
            f"{microseconds(total_ns / 1e3)} in long cycles"
            for one in mine
            if one.long_ns >= total_ns / _PART > 0
        ]
    if parts and totals.causes.throttled:
        hot = counted(totals.causes.throttled, "second", "seconds")
        parts.append(f"the processor was hot and slow for {hot}")
    return parts


def complete(totals: RunTotals) -> Needs:
    """Return which evidence of a run is complete; states and replies are asked joint by joint."""
    found = Needs.STATES | Needs.INTACT
    if not busy_machine(totals):
        found |= Needs.MACHINE
    if totals.kept_rate:
        found |= Needs.LOOP
    if not totals.gaps and totals.periods.agree:
        found |= Needs.LOG
    return found


def accused(totals: RunTotals, found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which the evidence is complete, with their rank and what helps."""
    found = tuple(found)
    there, load = complete(totals), totals.causes.load
    spoilt = {one.subject for one in found if one.code in _SPOILT}
    spoilt |= {one.subject for one in found if one.code == "another_host" and one.share >= SPOILS}
    doubtful = invalid_joints(totals).keys()
    kept: list[Finding] = []
    for one in found:
        needs = RULES[one.code].needs
        missing = needs & ~there
        if (
            missing == Needs.MACHINE
            and Needs.LOOP not in needs
            and one.subject != "machine"
            and one.share > load.share + _MARGIN
        ):
            missing = Needs.NOTHING  # it is more than the machine explains
        parts = {"machine", one.subject, totals.bus_of(one.subject)}
        missing |= needs & (Needs.STATES if parts & doubtful else Needs.NOTHING)
        missing |= needs & (Needs.INTACT if parts & spoilt else Needs.NOTHING)
        if not missing:
            kept.append(one)
    ranked = _explaining(totals, _one_accused(totals, kept))
    busy = Needs.MACHINE not in there
    return tuple(
        replace(one, remedy="")
        if (busy and one.code in _UNANSWERED) or (one.code in _FAILED and _is_explained(totals, one, ranked))
        else replace(one, remedy=remedy(one, totals))
        for one in ranked
    )


def _is_explained(totals: RunTotals, failed: Finding, found: Iterable[Finding]) -> bool:
    """Return whether another finding accuses the bus of what failed, or what all buses share."""
    return any(
        one is not failed
        and RULES[one.code].accuses
        and totals.bus_of(one.subject) == one.subject
        and one.subject in ("machine", totals.bus_of(failed.subject))
        for one in found
    )


def _one_accused(totals: RunTotals, found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Leave one finding for what is wrong with the replies of a part, see the module."""
    found = tuple(found)
    named = sorted((one for one in found if one.code in _REPLIES), key=lambda one: _REPLIES.index(one.code))
    # servos of several buses that were lost at once stand for the late and missing replies of each
    kept = [one for one in found if (one.code, one.subject) == ("servo_lost", "machine")]
    for one in named:
        bus = totals.bus_of(one.subject)
        same_bus = any(totals.bus_of(other.subject) == bus for other in kept)
        if not any(other.subject in ("machine", bus, one.subject) for other in kept) and not (
            one.code in _WEAK and same_bus
        ):
            kept.append(one)
    return tuple(one for one in found if one.code not in _REPLIES or one in kept)


def _explaining(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Put each cause before what it explains: a servo that failed, or states, periods and replies."""
    failed = {group.source for group in severe_of(totals.events, *HURTS, EventCode.DEVICE_LOST)}
    failed |= {finding.subject for finding in found if finding.rank == Rank.SERVO}
    failed |= {servo.bus for servo in totals.servos if servo.joint in failed}
    worse = any(finding.rank in (Rank.SHARE, Rank.ERROR) for finding in found)
    return tuple(
        finding
        if finding.rank != Rank.CAUSE
        else replace(finding, rank=Rank.SERVO_CAUSE)
        if finding.subject in failed or (failed and finding.subject == "machine")
        else replace(finding, rank=Rank.SHARE_CAUSE)
        if worse
        else finding
        for finding in found
    )


def remedy(finding: Finding, totals: RunTotals) -> str:
    """Return what to do about a finding: the one place that knows whether what it accuses is simulated.

    Of a simulated part there is nothing to check or to exchange, whatever the table proposes for a real one.
    """
    rule = RULES[finding.code]
    if finding.code == "busy_machine":
        buses = () if totals.virtual else totals.plan.buses  # on virtual time it runs already
        ends = _sentence(free_machine("sim" if bus.simulated else bus.port for bus in buses))
        return ends if totals.real_time.granted else f"{ends} {wake_up_remedy(totals.real_time)}"
    text = finding.remedy or (_SHARED if finding.subject == "machine" else rule.remedy)
    part = rule.accuses and not rule.accuses.startswith(("loop", "machine"))
    if text and part and totals.plan.is_simulated(finding.subject):
        return _sentence(choose_remedy("sim", text))
    return finding.remedy or text.format(**_names(finding.subject, totals))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _names(subject: str, totals: RunTotals) -> dict[str, str]:
    """Return what remedies call the bus, its port and the servo that a finding accuses."""
    for bus in totals.plan.buses:
        ids = [str(servo_id) for servo_id, name in bus.names.items() if name == subject]
        if ids or subject in (bus.name, *(servo.joint for servo in bus.servos)):
            ids = ids or [str(one.servo_id) for one in bus.servos if one.joint == subject]
            servo_id = ids[0] if ids else "ID"
            return {"name": subject, "bus": bus.name, "port": bus.port or "PORT", "servo_id": servo_id}
    return {"name": subject, "bus": subject, "port": "PORT", "servo_id": "ID"}


def wake_up_remedy(real_time: RealTime) -> str:
    """Return what makes wake-ups punctual: the next of scheduler, kernel and machine."""
    if not real_time.requested:
        return "`loop: {scheduler: {policy: round_robin}}` in the robot file helps."
    if not real_time.granted:
        return "The real-time scheduler that the robot file asks for was not granted, and would help."
    if not real_time.kernel:
        return "The real-time scheduler was granted; a real-time kernel helps."
    return "Scheduler and kernel are real-time ones, so it is the machine: see `dxlrun doctor`."
