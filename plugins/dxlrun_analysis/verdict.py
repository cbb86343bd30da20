"""Verdict: whether a run was good, in sentences with the most important one first.

The one set of rules for `analyze`, its page and its JSON; the exit code is 1 if a run was not good. The end
of a run itself uses the counts of the loop (`dxlrun.run.run_summary`). The most severe finding comes first. A
run was not good if

- a line or a servo was lost, a servo rebooted or lost its torque, the loop never ran a cycle, or another
  process of the run failed;
- a joint's state was invalid in more than 1 % of the cycles, and in three at least, without those of a
  reboot that a client requested;
- more periods were skipped than the robot file tolerates (`loop: {tolerated_skips: ...}`), of two seconds
  at least;
- a played motion did not reach its goal: the goal was missed or aborted, or the run ended before, see
  `dxlrun.plan.played_goals`;
- an error was logged, a servo reported one, or the log is incomplete.

All else is reported and tolerated: a lost packet is data. The signal of each rule is in rules.py, the
evidence that it requires in evidence.py.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import msgspec

from dxlrun.tooling.output import counted, microseconds
from dxlrun.tooling.records import EventCode, Severity
from dxlrun_analysis.causes.loop_rules import own_work
from dxlrun_analysis.conduct.steering_history import Act, Pause
from dxlrun_analysis.evidence import accused, busy_machine
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

_LEAST_CYCLES = 3
_LARGE_PART = 5  # Causes below a fifth of the excess of long cycles are not reported
_ROUGH_SHARE = 0.01
"""Share of wake-ups beyond 150 us that is reported. M. A. Araujo (UFU, 2017) measured 1.74 % at 1 kHz under
stress on a stock kernel, and none on a real-time kernel."""
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
"""Kinds of client commands that the loop executes itself, not a controller."""


class Verdict(msgspec.Struct, frozen=True):
    """Verdict on a run: whether it was good, and its findings, the summary of the robot's behaviour first,
    then the most severe."""

    good: bool  # No finding that makes a run not good
    word: str  # The verdict in words: good; good, with fallbacks; good, with missed goals; not good
    sentences: tuple[str, ...]  # Sentences of the findings, with their remedies
    findings: tuple[Finding, ...]


def judge_run(totals: RunTotals) -> Verdict:
    """Judge a run: combine the findings of all rules, sort them and decide whether the run was good."""
    judged = accused(
        totals,
        (
            *_never_ran(totals),
            *totals.findings,
            *_robot(totals),
            *_loop(totals),
            *lost_lines(totals),
            *whole_buses(totals),
            *lost_servos(totals),
            *lost_devices(totals),
            *invalid_states(totals),
            *implausible(totals),
            *own_work(totals.causes),
            *_machine(totals),
            *_steered(totals.acts, totals.pauses),
            *missing_replies(totals),
            *servo_errors(totals),
            *_events(totals),
            *_log(totals),
        ),
    )
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
    """Report a robot that was down at the end of the run, and each missed goal of a played motion."""
    if totals.conduct.lies:
        turned = totals.conduct.turned_rad
        how = "its fall_reflex switched controllers" if turned is None else "gravity is "
        how += "" if turned is None else f"{math.degrees(turned):.0f} deg from its direction at the start"
        yield Finding("fell", "", f"The robot fell and did not get up: {how}.", rank=Rank.SERVO, share=1.0)
    for goal in totals.unreached_goals:
        subject = (goal.report and goal.report.joint) or goal.controller
        remedy = f"{goal.remedy[:1].upper()}{goal.remedy[1:]}." if goal.remedy else ""
        yield Finding("goal_missed", subject, f"{goal.sentence}.", remedy, rank=Rank.ERROR)


def _never_ran(totals: RunTotals) -> Iterable[Finding]:
    """Report processes of the run that failed, and a log without any cycle of the loop."""
    for failed in totals.failures:
        yield Finding("run_failed", "", f"The run failed: {failed}.", rank=Rank.NEVER_RAN)
    if not totals.periods.records:
        none = "The log has no cycle of the loop" if totals.damage else "The loop never ran a cycle"
        refused = severe_of(totals.events, EventCode.SETUP)
        why = f": {sentence_of(refused[0])}" if refused else ""
        yield Finding("run_failed", "loop", f"{none}{why}.", rank=Rank.NEVER_RAN)


def _loop(totals: RunTotals) -> Iterable[Finding]:
    """Report whether the loop kept its rate, how late it woke at most, and its longest cycle."""
    account = totals.periods
    if not account.records:
        return
    wake_ups = ", on virtual time" if totals.virtual else ""
    if totals.latency is not None and not totals.virtual:
        late, worst = totals.latency.share_over_150_us, microseconds(totals.latency.max_us)
        often = f", {late:.1%} later than 150 us" if late > _ROUGH_SHARE else ""
        wake_ups = f", worst wake-up {worst} late{often}"
    elapsed = counted(account.elapsed, "period", "periods")
    if totals.plan.loop.schedule == "sequential":
        took = f"{elapsed} of {account.rates} took {account.seconds:.3f} s"
        yield Finding("kept_rate", "", f"The loop ran sequentially, not by the clock: {took}{wake_ups}.")
        return
    share = account.skipped / account.elapsed
    tolerated = f"{totals.plan.loop.tolerated_skips * 100:.4g}% tolerated"
    if totals.tolerated_skips > totals.plan.loop.tolerated_skips * account.elapsed:
        tolerated = f"{totals.tolerated_skips:.0f} tolerated in a short run"
    shares = f" ({share:.2%}; {tolerated})" if account.skipped else ""
    kept = "kept" if totals.kept_rate else "did not keep"
    sentence = f"The loop {kept} {account.rates}: {account.skipped} of {elapsed} skipped{shares}{wake_ups}"
    sentence += f"{_longest(totals)}."
    if totals.kept_rate:
        yield Finding("kept_rate", "", sentence)
    else:
        yield Finding("skipped", "loop", sentence, rank=Rank.SHARE, share=share)


def _longest(totals: RunTotals) -> str:
    """Return length and main cause of the longest cycle as the end of a sentence, or an empty string if no
    cycle exceeded its period."""
    slowest = totals.slowest
    if slowest is None:
        return ""
    steps = ((slowest.read_ns, "read"), (slowest.update_ns, "update"), (slowest.write_ns, "write"))
    longest_ns, name = max(steps)
    worst = max(totals.causes.worst, key=lambda one: one.written_us - one.woken_us, default=None)
    why = f": {worst.causes[0].label}" if worst is not None and worst.causes else ""
    took = f"a cycle took up to {microseconds(slowest.lasted_ns / 1e3)}, its {name}"
    return f"; {took} {microseconds(longest_ns / 1e3)}{why}"


def _machine(totals: RunTotals) -> Iterable[Finding]:
    if parts := busy_machine(totals):
        sentence = f"The machine was too busy: {', '.join(parts)}."
        yield Finding("busy_machine", "machine", sentence, rank=Rank.CAUSE, share=10.0)


def _steered(acts: Sequence[Act], pauses: Sequence[Pause]) -> Iterable[Finding]:
    """Report how many commands and streams clients sent, and how many were refused."""
    asked = [act for act in acts if act.origin != "loop"]
    if not asked:
        return
    done = Counter(
        f"{act.kind} request" if act.kind in _OF_LOOP else "command"
        for act in asked
        if not (act.refusal or act.set_points or act.kind == "resume")  # A resume is part of its pause
    )
    parts = [counted(count, what, f"{what}s") for what, count in done.items()]
    streams = [act for act in asked if act.set_points and not act.refusal]
    if streams:
        points = counted(sum(act.set_points for act in streams), "set-point", "set-points")
        parts.append(f"{counted(len(streams), 'stream', 'streams')} of {points}")
    refused = sum(bool(act.refusal) for act in asked)
    parts += [f"{refused} refused"] if refused else []
    still = sum(pause.end_s - pause.begin_s for pause in pauses)
    paused = f"; the loop was paused for {microseconds(still * 1e6)}" if pauses else ""
    ends = "".join(
        f"; the lease of the stream for {stream.controller} expired at {stream.ended_s:.1f} s"
        f"{', and its joints were held' if stream.held else ''}"
        for stream in streams
        if stream.ended_s is not None
    )
    share = 0.5 if any(stream.held for stream in streams) else 0.0
    yield Finding("steered", "", f"Requests of clients: {', '.join(parts)}{paused}{ends}.", share=share)


_OTHER_RULES = frozenset((*HURTS, EventCode.DEVICE_LOST, EventCode.PORT_LOST, EventCode.RECORDER_GAP))
"""Event codes that rules in other modules report."""


def _events(totals: RunTotals) -> Iterable[Finding]:
    """Report logged errors that no other rule reports, without controllers whose fallbacks took over."""
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
        sentence = f"The log is incomplete: {'; '.join(faults)}."
        yield Finding("log_not_whole", "log", sentence, rank=Rank.LOG)
