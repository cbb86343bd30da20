"""Evidence gate of the verdict: drop findings whose evidence is incomplete or that another finding explains.

A rule applies only if the evidence that it needs (`Needs` in rules.py) is complete, start-up included. A busy
machine is always reported. It explains late and missing replies, also those of real servos, because replies
wait in the driver. It also explains everything derived from goals and states that were late. Failures are
still reported, but without a remedy.

Of several findings about the same replies, the one with the most direct evidence is kept. A finding about the
machine or a bus replaces those about its servos.
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
"""Codes of findings about replies, those with the most direct evidence first."""
_WEAK = ("noise", "lossy_line")
"""Codes of findings with indirect evidence: bytes that belong to no packet, or missing replies."""
_SPOILT = frozenset(("power_lost", "noise", "broken_replies", "lossy_line", "bus_lost"))
"""Codes of faults of a bus that delay goals and make healthy joints follow worse. Another host has the
same effect if its goals or replies are mixed into those of this run."""
_UNANSWERED = frozenset(("servo_lost", "silent"))
"""Codes of failures inferred from missing replies, which a busy machine can also cause."""
_FAILED = _UNANSWERED | {"servo_rebooted", "torque_lost"}
_SHARED = "Check the USB hub, driver and supply that these buses share."
_MARGIN = 0.1
"""A finding is kept on a busy machine if its share of late replies exceeds the busy share of the run by
this: it then has another cause."""
_LATE_SHARE = 0.01
"""Share of wake-ups more than 1 ms late from which the loop itself accounts for late replies."""
_LEAST_CYCLES = 3  # One stall does not make a machine busy
_PART = 5  # Causes below a fifth of the excess of long cycles are not reported


def busy_machine(totals: RunTotals) -> list[str]:
    """Return the evidence that the machine was too busy for the loop, as phrases; empty if it was not.

    The evidence consists of machine samples, waits for simulated servos, late wake-ups, and the causes of
    late wake-ups if they account for most of the time of long cycles. Wake-ups of a sequential loop have no
    deadline and are not used.
    """
    load, causes = totals.causes.load, totals.causes.causes
    parts = [load.clause] if load.share else []
    parts += [totals.wait.clause] if totals.wait.times >= _LEAST_CYCLES else []
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
        parts.append(f"heat throttled the processor for {hot}")
    return parts


def complete(totals: RunTotals) -> Needs:
    """Return the conditions of rules that a run meets as a whole. STATES and INTACT are included;
    `accused` checks them joint by joint."""
    found = Needs.STATES | Needs.INTACT
    if not busy_machine(totals):
        found |= Needs.MACHINE
    if totals.kept_rate:
        found |= Needs.LOOP
    if not totals.gaps and totals.periods.agree:
        found |= Needs.LOG
    return found


def accused(totals: RunTotals, found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Drop findings with incomplete evidence or that others explain; return the rest with final rank."""
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
            missing = Needs.NOTHING  # The share exceeds the part that the busy machine explains
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
    """Return whether another finding accuses the bus of a failed servo, or the machine."""
    return any(
        one is not failed
        and RULES[one.code].accuses
        and totals.bus_of(one.subject) == one.subject
        and one.subject in ("machine", totals.bus_of(failed.subject))
        for one in found
    )


def _one_accused(totals: RunTotals, found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Keep one finding about the replies of each part; the module docstring has the priorities."""
    found = tuple(found)
    named = sorted((one for one in found if one.code in _REPLIES), key=lambda one: _REPLIES.index(one.code))
    # A simultaneous loss on several buses explains the late and missing replies of each bus.
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
    """Raise the rank of each finding that explains a servo failure, or invalid states, skipped periods or
    errors, so that it precedes them."""
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
    """Return the recommended action of a finding, adapted to whether the accused part is simulated.

    A simulated part has nothing to check or to exchange, so the remedy for a real part does not apply. No
    other function depends on simulation.
    """
    rule = RULES[finding.code]
    if finding.code == "busy_machine":
        # On virtual time the remedy is already in effect.
        buses = () if totals.virtual else totals.plan.buses
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
    """Return the values of the placeholders in a remedy: name, bus, port and ID of the accused servo."""
    for bus in totals.plan.buses:
        ids = [str(servo_id) for servo_id, name in bus.names.items() if name == subject]
        if ids or subject in (bus.name, *(servo.joint for servo in bus.servos)):
            ids = ids or [str(one.servo_id) for one in bus.servos if one.joint == subject]
            servo_id = ids[0] if ids else "ID"
            return {"name": subject, "bus": bus.name, "port": bus.port or "PORT", "servo_id": servo_id}
    return {"name": subject, "bus": subject, "port": "PORT", "servo_id": "ID"}


def wake_up_remedy(real_time: RealTime) -> str:
    """Return a sentence with the next step towards punctual wake-ups: scheduler, kernel or machine."""
    if not real_time.requested:
        return "Write `loop: {scheduler: {policy: round_robin}}` into the robot file."
    if not real_time.granted:
        return "The requested real-time scheduler was not granted: run `dxlrun doctor`."
    if not real_time.kernel:
        return "The scheduler is real-time, but the kernel is not: install a real-time kernel."
    return "Scheduler and kernel are real-time: check the machine with `dxlrun doctor`."
