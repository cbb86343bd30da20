"""The verdict: whether a run was good, and what a person wants to know first, in sentences.

The one set of rules of `analyze`, its page and its JSON; the exit code is 1 where a run was not good. A run
itself ends with what its loop counted (`dxlrun.run.run_summary`). The most severe finding comes first. A run
was not good when

- a line or a servo was lost, a servo rebooted or lost its torque, the loop never ran a cycle, or another
  process of the run failed;
- a joint's state was invalid in more than 1 % of the cycles, and in three at least; those of a reboot that a
  client requested do not count;
- more periods were skipped than the robot file tolerates (`loop: {tolerated_skips: ...}`), of two seconds at
  least;
- a played motion did not reach its goal: it was missed or aborted, or the run ended before, see
  `dxlrun.plan.played_goals`;
- an error was logged, a servo reported one, or the log is not whole.

All else is reported and tolerated: a lost packet is data. Wake-ups are *rough* when more than 1 % are later
than 150 us (M. A. Araujo, UFU 2017, measured 1.74 % at 1 kHz under stress on a stock kernel, none on a
real-time kernel). Replies are *late* when the adapter adds 2 ms more than the plan expects.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import msgspec

from dxlrun.channels.events import EventCode, Severity
from dxlrun.errors import counted
from dxlrun.output.table import microseconds
from dxlrun_analysis.accused import accused, wake_up_remedy
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.rules import cause_findings
from dxlrun_analysis.conduct.steering import Act, Pause
from dxlrun_analysis.finding import HURTS, Finding, Rank
from dxlrun_analysis.lost import (
    implausible,
    invalid_states,
    lost_devices,
    lost_lines,
    lost_servos,
    missing_replies,
    sentence_of,
    servo_errors,
    severe_of,
    whole_buses,
)
from dxlrun_analysis.robot_line import robot_line
from dxlrun_analysis.tally import RunTotals

_SHORT_RUN_S = 2.0
"""A shorter run may skip as much as one of this: a machine that stalls once is not overloaded."""
ROUGH_SHARE = 0.01
_OFTEN = 0.01  # Of the cycles: a goal beyond a limit now and then is what limits are for
_OF_LOOP = [
    "switch",
    "rate",
    "halt",
    "pause",
    "load",
    "unload",
    "register",
    "get",
    "torque",
    "reboot",
    "stop",
]
"""Kinds of commands that the loop does itself."""


class Verdict(msgspec.Struct, frozen=True):
    """What the robot did, then findings, the most severe first."""

    good: bool  # Nothing was found that a run may not have
    word: str  # The verdict in words: good; good, with fallbacks; good, with missed goals; not good
    sentences: tuple[str, ...]  # Of the findings, with their remedies
    findings: tuple[Finding, ...]


def judge(totals: RunTotals) -> Verdict:
    """Return whether a run was good, and what was and what was not."""
    found = (
        *(
            Finding("run_failed", "", f"The run failed: {failed}.", rank=Rank.NEVER_RAN)
            for failed in totals.failures
        ),
        *totals.findings,
        *_robot(totals),
        *_beyond(totals),
        *_loop(totals),
        *lost_lines(totals),
        *whole_buses(totals),
        *lost_servos(totals),
        *lost_devices(totals),
        *invalid_states(totals),
        *implausible(totals),
        *_causes(totals),
        *_slow(totals),
        *_rough(totals),
        *_steered(totals.acts, totals.pauses),
        *missing_replies(totals),
        *servo_errors(totals),
        *_events(totals),
        *_log(totals),
    )
    judged = accused(totals, found)
    ordered = sorted(judged, key=lambda finding: finding.order)
    good = all(finding.rank >= Rank.CAUSE for finding in ordered)
    word = "good" if good else "not good"
    if good and totals.conduct.takeovers:
        word = "good, with fallbacks"
    elif good and any(report.failed for report in totals.conduct.goals.failed):
        word = "good, with missed goals"
    findings = (robot_line(totals, word, ordered), *ordered)
    return Verdict(good, word, tuple(finding.line for finding in findings), findings)


def _robot(totals: RunTotals) -> Iterable[Finding]:
    """Report a robot that ended lying, and goals of played motions that were not reached."""
    if totals.conduct.lies:
        turned = totals.conduct.turned_rad
        how = "its fall_reflex had others take over" if turned is None else "gravity is "
        how += "" if turned is None else f"{math.degrees(turned):.0f} deg from where it was at the start"
        yield Finding("fell", "", f"The robot fell, and lies: {how}.", rank=Rank.SERVO, share=1.0)
    for goal in totals.unreached_goals:
        subject = (goal.report and goal.report.joint) or goal.controller
        code = "goal_missed" if goal.failed else "motion_cut"
        remedy = f"{goal.remedy[:1].upper()}{goal.remedy[1:]}." if goal.remedy else ""
        yield Finding(code, subject, f"{goal.sentence}.", remedy, rank=Rank.ERROR)


def _beyond(totals: RunTotals) -> Iterable[Finding]:
    """Report commands beyond position limits, which the last gate changed."""
    clamped = {one.name: one.clamped for one in totals.tracking}
    for group in totals.events:
        joint, _, what = group.text.partition(", ")
        count = clamped.get(joint, 0)
        if (
            group.code == EventCode.GATE
            and group.severity >= Severity.WARNING
            and "position limit" in what
            and count > _OFTEN * totals.periods.records
        ):
            by, _, done = what.removeprefix("controller ").partition(": ")
            cycles = counted(count, "cycle", "cycles")
            sentence = f"Commands of {by} for {joint} were beyond its limits in {cycles}: {done}."
            yield Finding("beyond_limits", by, sentence, share=0.5)


def _loop(totals: RunTotals) -> Iterable[Finding]:
    account, wake_ups = totals.periods, totals.latency
    if not account.records:
        none = "The log has no cycle of the loop" if totals.damage else "The loop never ran a cycle"
        refused = severe_of(totals.events, EventCode.SETUP)
        why = f": {sentence_of(refused[0])}" if refused else ""
        yield Finding("never_ran", "loop", f"{none}{why}.", rank=Rank.NEVER_RAN)
        return
    share = account.skipped / account.elapsed
    judged = max(account.elapsed, _SHORT_RUN_S * account.rate_hz)
    tolerable = account.skipped <= totals.plan.loop.tolerated_skips * judged
    kept = "kept" if tolerable else "did not keep"
    wake_up = f", worst wake-up {microseconds(wake_ups.max_us)} late" if wake_ups is not None else ""
    wake_up = ", on virtual time" if totals.virtual else wake_up
    elapsed = counted(account.elapsed, "period", "periods")
    if totals.plan.loop.schedule == "sequential":
        took = f"{elapsed} of {account.rates} took {account.seconds:.3f} s"
        yield Finding("sequential", "", f"Cycles followed each other, not the clock: {took}{wake_up}.")
        return
    tolerated = f"{totals.plan.loop.tolerated_skips * 100:.4g}% tolerated"
    if judged > account.elapsed:
        tolerated = f"{totals.plan.loop.tolerated_skips * judged:.0f} tolerated in a short run"
    shares = f" ({share:.2%}; {tolerated})" if account.skipped else ""
    sentence = f"The loop {kept} {account.rates}: {account.skipped} of {elapsed} skipped{shares}{wake_up}."
    if tolerable:
        yield Finding("rate_kept", "", sentence)
    else:
        yield Finding("skipped_periods", "loop", sentence, rank=Rank.SHARE, share=share)


def _causes(totals: RunTotals) -> Iterable[Finding]:
    """Report what made cycles too long; of a bus only where nothing else explains its late replies."""
    if totals.plan.loop.schedule == "sequential":
        return
    explained = {finding.subject for finding in totals.findings if finding.rank == Rank.CAUSE}
    explained |= {servo.bus for servo in totals.servos if servo.subject in explained}
    for finding in cause_findings(totals.causes, wake_up_remedy(totals.real_time)):
        if totals.bus_of(finding.subject) not in explained:
            yield finding


def _slow(totals: RunTotals) -> Iterable[Finding]:
    """Report the longest step of the cycle that exceeds its period most."""
    slowest = totals.slowest
    if slowest is None:
        return
    steps = ((slowest.read_ns, "read"), (slowest.update_ns, "update"), (slowest.write_ns, "write"))
    longest_ns, name = max(steps)
    yield Finding(
        "long_cycle",
        "loop",
        f"A cycle took up to {microseconds(slowest.lasted_ns / 1e3)}, longer than its period of "
        f"{microseconds(slowest.period_ns / 1e3)}; its {name} took {microseconds(longest_ns / 1e3)}"
        f"{_why(totals.causes)}.",
    )


def _why(causes: Causes) -> str:
    """Return the main cause of the cycle that took longest, as the end of a sentence."""
    longest = max(causes.worst, key=lambda one: one.written_us - one.woken_us, default=None)
    if longest is None or longest.written_us - longest.woken_us <= longest.period_us or not longest.causes:
        return ""
    share = longest.causes[0]
    return f": {share.name} {microseconds(share.us)}"


def _rough(totals: RunTotals) -> Iterable[Finding]:
    wake_ups = totals.latency
    if wake_ups is None or wake_ups.share_over_150_us <= ROUGH_SHARE:
        return
    late = f"{wake_ups.share_over_150_us:.1%} came later than 150 us"
    helps = wake_up_remedy(totals.real_time)
    yield Finding("rough_wake_ups", "machine", f"Wake-ups are rough: {late}.", helps)


def _steered(acts: Sequence[Act], pauses: Sequence[Pause]) -> Iterable[Finding]:
    """Report the commands from outside."""
    asked = [act for act in acts if act.origin != "loop"]
    if not asked:
        return
    done = Counter(
        f"{act.kind} request" if act.kind in _OF_LOOP else "command"
        for act in asked
        if not (act.refusal or act.set_points or act.kind == "resume")  # a pause has an end
    )
    parts = [counted(count, what, f"{what}s") for what, count in done.items()]
    streams = [act for act in asked if act.set_points and not act.refusal]
    if streams:
        points = counted(sum(act.set_points for act in streams), "set-point", "set-points")
        parts.append(f"{counted(len(streams), 'stream', 'streams')} of {points}")
    refused = sum(bool(act.refusal) for act in asked)
    parts += [f"{refused} refused"] if refused else []
    still = sum(pause.end_s - pause.begin_s for pause in pauses)
    paused = f"; it was paused for {microseconds(still * 1e6)}" if pauses else ""
    ends = "".join(
        f"; the stream for {stream.controller} ended by its lease at {stream.ended_s:.1f} s"
        f"{', and its joints were held since' if stream.held else ''}"
        for stream in streams
        if stream.ended_s is not None
    )
    share = 0.5 if any(stream.held for stream in streams) else 0.0
    yield Finding(
        "steered", "", f"It was steered from outside: {', '.join(parts)}{paused}{ends}.", share=share
    )


_OTHER_RULES = frozenset((*HURTS, EventCode.DEVICE_LOST, EventCode.PORT_LOST, EventCode.RECORDER_GAP))
"""Events that other rules report."""


def _events(totals: RunTotals) -> Iterable[Finding]:
    """Report errors that were logged, but for those of controllers whose fallbacks took over."""
    taken_over = {one.controller for one in totals.conduct.takeovers} - set(totals.conduct.unanswered)
    severe = [
        group
        for group in totals.events
        if group.severity >= Severity.ERROR
        and group.code not in _OTHER_RULES
        and not (group.code == EventCode.CONTROLLER_FAULT and group.source in taken_over)
    ]
    if severe:
        count = sum(group.count for group in severe)
        first = min(severe, key=lambda group: group.t_ns)
        number = "One error was" if count == 1 else f"{count} errors were"
        sentence = f"{number} logged; the first, of {first.source}: {sentence_of(first)}"
        yield Finding("errors_logged", first.source, sentence, rank=Rank.ERROR)


def _log(totals: RunTotals) -> Iterable[Finding]:
    faults = list(totals.damage)
    if totals.gaps:
        lost = counted(totals.gaps, "record was", "records were")
        faults.append(f"{lost} lost on the way to the recorder")
    if not totals.periods.agree:
        missing = counted(totals.periods.missing, "period is", "periods are")
        faults.append(f"{missing} neither recorded nor declared skipped")
    if faults:
        sentence = f"The log is not whole: {'; '.join(faults)}."
        yield Finding("log_not_whole", "log", sentence, rank=Rank.LOG)
