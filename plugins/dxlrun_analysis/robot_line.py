"""First line of a verdict: the robot's behaviour as an onlooker would describe it.

The line has the motions played with the largest tracking error, goals reached or missed, falls, limp and lost
joints, takeovers and fallbacks. If none of these explains why a run was not good, the line has the first
reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from textwrap import shorten

from dxlrun import JointUnit
from dxlrun.tooling.output import counted
from dxlrun.tooling.plans import motion_name, played_name
from dxlrun.tooling.records import EventCode, EventGroup, GoalReport, Severity
from dxlrun_analysis.finding import ROBOT, Finding, Rank, listed
from dxlrun_analysis.tally import RunTotals

_MOST_NAMED = 3
_AT_ONCE_NS = 500_000_000  # Events of several joints within 0.5 s are reported with one time
_NOTICED_RAD = math.radians(0.05)  # Smaller errors are not worth mentioning
_FAILED = {
    EventCode.SERVO_LIMP: "went limp",
    EventCode.SERVO_LOST: "was lost",
    EventCode.SERVO_REBOOTED: "rebooted",
}
_REASONS = {
    "run_failed": "{sentence}",
    "goal_missed": "",
    "another_host": "another host sent on bus {subject}",
    "noise": "noise on bus {subject}",
    "frozen": "{subject} was frozen",
    "silent": "{subject} was lost",
    "bus_lost": "bus {subject} was lost",
    "skipped": "the loop did not keep its rate",
    "servo_error": "{subject} reported errors",
    "errors_logged": "{text}",
    "invalid_states": "states of {subject} were often invalid",
    "log_not_whole": "the log is incomplete",
}
"""Reason in the first line by the code of a finding; for all others the code itself (`stood still`).
Missed goals have a clause of their own."""
_RELEASED = "torque off: "
_FACTS = (Rank.NEVER_RAN, Rank.LINE, Rank.SERVO, Rank.SHARE, Rank.ERROR, Rank.LOG)
_shortened = partial(shorten, width=100, placeholder=" ...")
"""Returns a reason that is cut after a word."""


def robot_line(totals: RunTotals, word: str, found: Sequence[Finding]) -> Finding:
    """Return the first line of the verdict, as a finding.

    Args:
        totals: Totals of the run.
        word: Verdict in words.
        found: Findings behind the verdict, the worst first.
    """
    parts = [*_failures(totals), *_takeovers(totals)]
    facts = (one for one in found if one.rank in _FACTS)
    worst = next(facts, next((one for one in found if one.rank == Rank.SERVO_CAUSE), None))
    if worst is not None and not parts:
        parts.append(_reason(worst))
    parts += _goals_not_reached(totals)
    parts.append(_played(totals))
    if totals.plan.omitted:
        parts.append(f"without {', '.join(totals.plan.omitted)}")
    goals = totals.conduct.goals
    if goals.asked:
        parts.append(f"{goals.reached} of {counted(goals.asked, 'goal', 'goals')} reached")
    if cancelled := goals.counts.get("cancelled"):
        parts.append(f"{counted(cancelled, 'goal', 'goals')} cancelled")
    return Finding(ROBOT, "", f"{word.capitalize()}: {'; '.join(filter(None, parts))}.")


def _reason(worst: Finding) -> str:
    text = worst.sentence.partition(f"of {worst.subject}: ")[2] or worst.subject
    if worst.subject == "loop":  # The end of the loop has its reason after the time that it ran
        text = text.partition(": ")[2] or text
    words = f"{worst.subject}: {worst.code.replace('_', ' ')}"
    sentence = f"{worst.sentence[:1].lower()}{worst.sentence[1:-1]}"
    reason = _REASONS.get(worst.code, words)
    return reason.format(subject=worst.subject, text=_shortened(text), sentence=sentence)


def _failures(totals: RunTotals) -> Iterator[str]:
    """Yield clauses about a fall, lost buses, and joints that went limp, were lost or rebooted.

    Events are in order of time; those of the same joints are combined.
    """
    conduct = totals.conduct
    fallen = next((one for one in conduct.takeovers if one.fell), None)
    if conduct.lies or fallen:
        at = f" at {fallen.time_s:.1f} s" if fallen else ""
        yield f"the robot fell{at} and {'did not get up' if conduct.lies else 'got up'}"
    severe = [group for group in totals.events if group.severity >= Severity.ERROR]
    gone = {group.source: group for group in severe if group.code == EventCode.PORT_LOST}
    for bus, group in gone.items():
        yield f"bus {bus} was lost{_at(group.t_ns, conduct.begin_ns)}"
    theirs = {servo.joint for servo in totals.servos if servo.bus in gone}
    told: dict[frozenset[str], list[list[EventGroup]]] = {}
    for code in _FAILED:
        groups = [group for group in severe if group.code == code and group.source not in theirs]
        if groups:
            groups.sort(key=lambda group: group.t_ns)
            told.setdefault(frozenset(group.source for group in groups), []).append(groups)
    for same in told.values():
        same.sort(key=lambda groups: groups[0].t_ns)
    for same in sorted(told.values(), key=lambda same: same[0][0].t_ns):
        happened = [f"{_what(groups)}{_when(groups, conduct.begin_ns)}" for groups in same]
        yield f"{listed(group.source for group in same[0])} {', '.join(happened)}"


def _what(groups: Sequence[EventGroup]) -> str:
    what = _FAILED[EventCode(groups[0].code)]
    return what if len(groups) == 1 else what.replace("was ", "were ")


def _when(groups: Sequence[EventGroup], begin_ns: int) -> str:
    """Return the time of events as text: ` at 2.0 s`, or ` from 2.0 s on` if they were not simultaneous."""
    first = _at(groups[0].t_ns, begin_ns)
    later = first and groups[-1].t_ns - groups[0].t_ns > _AT_ONCE_NS
    return f"{first.replace(' at ', ' from ')} on" if later else first


def _at(t_ns: int, begin_ns: int) -> str:
    """Return the time of an event as text, in s since the first deadline (`begin_ns`); empty if that is 0."""
    return f" at {max((t_ns - begin_ns) / 1e9, 0.0):.1f} s" if begin_ns else ""


def _goals_not_reached(totals: RunTotals) -> Iterator[str]:
    for report in totals.conduct.goals.failed[:_MOST_NAMED]:
        if report.cut:
            yield f"the run ended before the end of {_goal(report)}"
        else:
            status = "missed its goal" if report.status == "missed" else report.status
            joint = totals.plan.joint(report.joint)
            yield f"{_goal(report)} {status}{_off(report, joint.unit)}"
    unbegun = [goal for goal in totals.unreached_goals if goal.report is None]
    yield from (f"{goal.name} never began" for goal in unbegun[:_MOST_NAMED])


def _goal(report: GoalReport) -> str:
    if motion_name(report.origin):
        return played_name(report.origin, report.controller)
    return f"{report.kind} of {report.controller}"


def _off(report: GoalReport, unit: JointUnit) -> str:
    if not report.joint:
        return ""
    if report.error is None:
        return f" ({report.joint})"
    return f" ({report.joint} {unit.text(abs(report.error), digits=1)} off)"


def _takeovers(totals: RunTotals) -> Iterator[str]:
    """Yield clauses about controllers that failed, with their fallbacks, takeovers that controllers
    requested, and torque that clients switched off."""
    yield from (f"{name} failed" for name in totals.conduct.unanswered[:_MOST_NAMED])
    for one in [one for one in totals.conduct.takeovers if not one.fell][:_MOST_NAMED]:
        if one.by:
            why = _shortened(one.text.partition("\n")[0].removeprefix(f"controller {one.controller} "))
            yield f"{one.controller} failed ({why}) and fell back to {one.by} at {one.time_s:.1f} s"
        else:
            yield f"at {one.time_s:.1f} s {one.text}"
    released = [act for act in totals.acts if act.what.startswith(_RELEASED) and not act.refusal]
    if released:
        names = listed(joint for act in released for joint in act.what.removeprefix(_RELEASED).split(", "))
        yield f"torque of {names} off by request at {released[0].time_s:.1f} s"


def _played(totals: RunTotals) -> str:
    """Return a clause about the motions played, or other movement, with the largest tracking error."""
    until_ns = totals.periods.seconds * 1e9
    begun = [one for one in totals.plan.loop.commands if one.at_ns <= until_ns and totals.periods.records]
    motions = sum(one.goal is not None for one in begun) or len({one.controller for one in begun})
    files = [motion for motion in dict.fromkeys(motion_name(one.origin) for one in begun) if motion]
    within = _within(totals)
    if files:
        return f"played {listed(files)} ({counted(motions, 'motion', 'motions')}){within}"
    sent = [act for act in totals.acts if act.origin != "loop" and not act.refusal and act.what]
    if any(act.set_points for act in sent) or (totals.conduct.goals.counts and sent):
        return f"moved by clients{within}"
    if totals.conduct.goals.counts:
        return f"moved by its controllers{within}"
    ran = "the log has" if totals.damage else "ran for"
    return f"{ran} {totals.periods.seconds:.1f} s without a motion" if totals.periods.records else ""


def _within(totals: RunTotals) -> str:
    """Return the largest tracking error as text, without joints that failed; empty if negligible."""
    failed = {group.source for group in totals.events if group.code in _FAILED}
    worst = max(
        (one for one in totals.tracking if one.worst_rad is not None and one.name not in failed),
        key=lambda one: one.worst_rad or 0.0,
        default=None,
    )
    if worst is None or worst.worst_rad is None or worst.worst_rad < _NOTICED_RAD:
        return ""
    return f" within {worst.unit.text(worst.worst_rad, digits=1)} ({worst.name})"
