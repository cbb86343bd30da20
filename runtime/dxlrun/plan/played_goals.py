"""Played goals: find those that a run did not reach, for the run summary, the exit code and the analysis."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dxlrun.channels.event_records import GoalReport, GoalTotals
from dxlrun.plan.loop_plan import LoopPlan, ScheduledCommand


class UnreachedGoal(NamedTuple):
    """A goal of a played motion file that a run did not reach, with the reason."""

    controller: str
    name: str
    """Name for messages, of motion and controller: `wave of arm`."""
    sentence: str
    """Reason as a sentence, without its full stop."""
    remedy: str = ""
    report: GoalReport | None = None
    """Event data with its outcome; None: the goal never began."""

    @property
    def failed(self) -> bool:
        """True if the goal was missed, or aborted for another reason than the end of the run."""
        return self.report is not None and self.report.failed


def find_unreached_goals(loop: LoopPlan, goals: GoalTotals, ran_ns: int) -> Iterator[UnreachedGoal]:
    """Yield the goals of played motions that a run did not reach.

    A goal that a client cancelled or replaced does not count, and neither does one that runs until a cancel
    and ended with the run.

    Args:
        loop: Plan of the loop.
        goals: Totals of the run.
        ran_ns: Duration of the run.
    """
    starts = [command for command in loop.commands if command.goal is not None]
    origins, by_origin = loop.origins, {command.origin: command for command in starts}
    planned = [report for report in goals.failed if report.origin in origins]
    for report in sorted(planned, key=lambda report: report.cut):
        name, sentence, remedy = played_name(report.origin, report.controller), report.sentence, ""
        command = by_origin.get(report.origin)
        if report.cut:
            if command is not None and command.goal is not None and command.goal.end_ns is None:
                continue
            sentence, remedy = _describe_end(loop, name, command, ran_ns)
        yield UnreachedGoal(report.controller, name, sentence, remedy, report)
    missing = Counter(command.origin for command in starts)
    missing.subtract(goals.begun)
    for command in starts:
        if missing[command.origin] > 0:
            missing[command.origin] -= 1
            name, sentence, remedy = played_name(command.origin, command.controller), "", ""
            sentence = f"{name} never began"
            if command.at_ns >= ran_ns:
                sentence, remedy = _describe_end(loop, name, command, ran_ns)
            yield UnreachedGoal(command.controller, name, sentence, remedy)


def _describe_end(
    loop: LoopPlan, name: str, command: ScheduledCommand | None, ran_ns: int
) -> tuple[str, str]:
    """Return a sentence about a run that ended before a motion, and the remedy."""
    end_ns = None if command is None or command.goal is None else command.goal.end_ns
    end = "" if end_ns is None else f" at {end_ns / 1e9:.4g} s"
    duration_ns = loop.end_ns
    if duration_ns is None or not duration_ns <= ran_ns + loop.period_ns or duration_ns >= (end_ns or 0):
        return f"The run ended at {ran_ns / 1e9:.4g} s, before {name} ended{end}", ""
    ended = f"The run ended by its duration at {duration_ns / 1e9:.4g} s"
    return f"{ended}, before {name} ended{end}", "omit --duration"


def played_name(origin: str, controller: str) -> str:
    """Return the name of a goal: `wave of arm` for a played one, else the name of the controller."""
    return f"{motion} of {controller}" if (motion := motion_name(origin)) else controller


def motion_name(origin: str) -> str:
    """Return the name of the motion file, or of a controller's own motion, in an origin; empty for other
    origins.
    """
    path, *place = origin.rsplit(":", 2)
    return Path(path).stem if len(place) == 2 and all(part.isdigit() for part in place) else ""
