"""What findings accuse: one cause for one symptom, a busy machine before what it explains, and remedies."""

from __future__ import annotations

from dataclasses import replace

from dxlrun_analysis.finding import HURTS, Finding, Rank
from dxlrun_analysis.joints.kinds import COMMANDED, MOVES_WORSE
from dxlrun_analysis.lost import CODES, SPOILT, severe_of, waited_in_vain
from dxlrun_analysis.tally import RealTime, RunTotals

_REPLIES = (
    *("late_replies_everywhere", "power_lost", "latency_timer", "late_replies", "another_host", "echo"),
    *("broken_replies", "return_delay", "slow_servo", "noise", "loose_cable", "lossy_servo", "shared_cable"),
    *("lossy_line", "late_now_and_then", "late_exchanges", "silent_bus"),
)
"""Codes of what is wrong with replies, the most direct evidence first."""
_WEAK = ("noise", "lossy_line", "silent_bus")
"""Those that only say that bytes belong to no packet, or that replies are missing."""
_OF_TIME = frozenset(
    (
        *(code for code in _REPLIES if code not in SPOILT),
        *("missing_replies", "servo_lost", "device_lost", "slow_writes"),
        *("late_wake_ups", "rough_wake_ups", "busy_machine", "own_work", "long_cycle"),
        "stream_ran_out",
    )
)
"""Codes of what a machine that is too busy does too; also to the replies of a real servo, which wait for the
host in its driver."""
_FACTS = (Rank.SERVO, Rank.SHARE, Rank.ERROR)
_FEW_LATE_WAKE_UPS = 10
"""A machine on which the loop wakes late, too, a tenth as often as replies are, may have them."""
_MARGIN = 0.1
"""A busy machine makes no greater a share of the replies late than so much above its share of the run."""


def accused(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return the findings that stay, with their rank and what helps."""
    rough = totals.latency.share_over_1_ms if totals.latency else 0.0
    found = tuple(
        one for one in found if one.code != "late_now_and_then" or rough < one.share / _FEW_LATE_WAKE_UPS
    )
    ranked = _explaining(totals, _one_accused(totals, _busy(totals, found)))
    return tuple(replace(finding, remedy=_remedy(finding, totals)) for finding in ranked)


def _busy(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Put a machine that was too busy (see `MachineLoad`) in place of what it explains.

    It explains late and missing replies and wake-ups, but not more late ones than it had busy seconds, and
    simulated servos and devices that were lost. What makes a run not good is told all the same, without a
    remedy.
    """
    load = totals.causes.load
    explained = [finding for finding in found if _is_explained(finding, totals)]
    if not load.share or not explained:
        return found
    kept = tuple(
        replace(finding, remedy="") if finding in explained else finding
        for finding in found
        if finding not in explained or finding.rank in _FACTS
    )
    failed = any(finding.rank == Rank.SERVO for finding in explained)
    simulated = any(bus.simulated for bus in totals.plan.buses)
    ends = "End other programs" + (
        ", or use --virtual: simulated servos answer late too." if simulated else "."
    )
    helps = ends if totals.real_time.granted else f"{ends} {wake_up_remedy(totals.real_time)}"
    sentence = f"The machine was too busy: {load.text}."
    rank = Rank.SERVO_CAUSE if failed else Rank.CAUSE
    return (Finding("busy_machine", "machine", sentence, helps, rank, 3.0), *kept)


def _is_explained(finding: Finding, totals: RunTotals) -> bool:
    if finding.code in ("servo_lost", "device_lost", "silent_bus") and not totals.plan.is_simulated(
        finding.subject
    ):
        return False
    late = finding.code in ("latency_timer", "late_replies", "slow_servo", "return_delay")
    return finding.code in _OF_TIME and not (late and finding.share > totals.causes.load.share + _MARGIN)


def _one_accused(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Leave one finding for what is wrong with the replies of a part: the one with the most direct evidence.

    What holds for the machine or a whole bus stands for all its servos, and what only says that replies are
    missing goes where anything else is known of its bus. Servos that failed, or followed worse, are then not
    accused besides; nor those that followed worse while replies before theirs were missing.
    """
    named = sorted((one for one in found if one.code in _REPLIES), key=lambda one: _REPLIES.index(one.code))
    kept: list[Finding] = []
    for one in named:
        bus = totals.bus_of(one.subject)
        whole = {"machine", bus, one.subject}
        same_bus = {other.subject for other in kept if totals.bus_of(other.subject) == bus}
        if not any(other.subject in whole for other in kept) and not (one.code in _WEAK and same_bus):
            kept.append(one)
    whole = {one.subject for one in kept if totals.bus_of(one.subject) == one.subject}
    whole |= {one.subject for one in found if one.code in ("busy_machine", "bus_lost")}
    waited = waited_in_vain(totals)
    return tuple(
        replace(one, remedy="")
        if (one.code in (*CODES.values(), *MOVES_WORSE) and {"machine", totals.bus_of(one.subject)} & whole)
        or (one.code in MOVES_WORSE and one.subject in waited)
        else one
        for one in found
        if one.code not in _REPLIES or one in kept
    )


def _remedy(finding: Finding, totals: RunTotals) -> str:
    """Return what to do about a finding: the one place that knows whether what it accuses is simulated.

    Of a simulated part there is nothing to check or to exchange, whatever its rule proposes for a real one.
    """
    part = finding.code in _REPLIES or finding.subject not in _NO_PARTS
    part &= finding.code not in _OF_CONTROLLERS
    if not finding.remedy or not part or not totals.plan.is_simulated(finding.subject):
        return finding.remedy
    if finding.code in _OF_TIME and not totals.virtual:
        return (
            "Its servos are simulated: a fault was injected, or the machine was too busy for them; end other "
            "programs, or use --virtual."
        )
    return "It is simulated: look at the faults that were injected, and at what the motion asks of it."


_NO_PARTS = ("", "loop", "machine", "log")
_OF_CONTROLLERS = ("slow_controller", "stream_ran_out", "controllers_flap", *COMMANDED)
"""Codes that accuse a controller, or its commands, whose name may be that of a bus."""


def _explaining(totals: RunTotals, found: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Put each cause before what it explains: a servo that failed, or states, periods and replies."""
    failed = {group.source for group in severe_of(totals.events, *HURTS)}
    failed |= {finding.subject for finding in found if finding.rank == Rank.SERVO}
    failed |= {servo.bus for servo in totals.servos if servo.joint in failed}
    worse = any(finding.rank in (Rank.SHARE, Rank.ERROR) for finding in found)
    # where replies are spoilt, goals wait for a torque that is known again, and other joints follow worse
    behind = {totals.bus_of(one.subject) for one in found if one.code in MOVES_WORSE}
    return tuple(
        finding
        if finding.rank != Rank.CAUSE
        else replace(finding, rank=Rank.SERVO_CAUSE)
        if finding.subject in failed
        or (failed and finding.code == "late_replies_everywhere")
        or (finding.code in SPOILT and totals.bus_of(finding.subject) in behind)
        else replace(finding, rank=Rank.SHARE_CAUSE)
        if worse
        else finding
        for finding in found
    )


def wake_up_remedy(real_time: RealTime) -> str:
    """Return what makes wake-ups punctual: the next of scheduler, kernel and machine."""
    if not real_time.requested:
        return "`loop: {scheduler: {policy: round_robin}}` in the robot file helps."
    if not real_time.granted:
        return "The real-time scheduler that the robot file asks for was not granted, and would help."
    if not real_time.kernel:
        return "The real-time scheduler was granted; a real-time kernel helps."
    return "Scheduler and kernel are real-time ones, so it is the machine: see `dxlrun doctor`."
