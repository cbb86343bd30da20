"""What a person wants to know first about late and long cycles, with what helps; rules of the verdict.

A cause is a finding when it has at least half of what long cycles took beyond their planned exchanges, and a
part of three cycles at least: one stall of a machine accuses nothing. Missing replies are left to the rules
about servos, which know whether the others of the bus answered.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from dxlrun.errors import counted
from dxlrun.output.table import microseconds
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.machine import INTERRUPTS, OTHERS, STEAL
from dxlrun_analysis.cycles.worst import Cause, CauseKind
from dxlrun_analysis.finding import Finding, cause

LEAST_CYCLES = 3
MOST_OF_IT = 0.5


class _Rule(NamedTuple):
    code: str
    sentence: str  # With `subject`, and with `took`: how much of how much, in how many cycles
    remedy: str = ""  # Empty: what makes wake-ups punctual


_RULES: dict[CauseKind, _Rule] = {
    "controller": _Rule(
        "slow_controller",
        "Controller {subject} made cycles too long: its update took {took}.",
        "Make its update faster, give it a lower rate (`{subject}: {{rate: ...}}`), or lower the loop's.",
    ),
    "machine": _Rule("busy_machine", "The machine kept the loop waiting: {subject}, {took}."),
    "late wake-up": _Rule("late_wake_ups", "The loop woke too late: {took}."),
    "own work": _Rule("own_work", "The loop's own work, or what interrupted it, took {took}."),
    "late reply": _Rule(
        "late_exchanges",
        "{subject} made cycles too long: replies were later than planned by {took}; servo or adapter.",
        "Check return_delay_time of the servos, cable, and adapter (latency timer, driver, USB hub).",
    ),
    "write call": _Rule(
        "slow_writes",
        "{subject} made cycles too long: write() calls took {took}.",
        "Check the adapter (driver, USB hub).",
    ),
    "plan": _Rule(
        "rate_too_high",
        "The planned exchange alone is longer than the period: by {took}.",
        "Lower `rate`, raise `baud_rate`, or spread the servos over more buses.",
    ),
}
_REMEDIES = {
    STEAL: "Give the virtual machine cores of its own, or run on a real one.",
    OTHERS: "Give the loop a core of its own: `loop: {scheduler: {policy: round_robin, cores: [...]}}`.",
    INTERRUPTS: "Keep interrupts off the loop's core (irqbalance, /proc/irq/*/smp_affinity).",
}


def cause_findings(causes: Causes, wake_up_remedy: str) -> Iterable[Finding]:
    """Yield what made cycles too long, the largest first."""
    total_ns = sum(one.long_ns for one in causes.causes)
    for one in causes.causes:
        rule = _RULES.get(one.kind)
        enough = min(one.cycles, causes.long) >= LEAST_CYCLES and one.long_ns >= MOST_OF_IT * total_ns > 0
        if rule is None or not enough:
            continue
        cycles = counted(min(one.cycles, causes.long), "cycle", "cycles")
        took = f"{microseconds(one.long_ns / 1e3)} of {microseconds(total_ns / 1e3)} in {cycles}"
        yield cause(
            rule.code,
            _accused(one),
            _capital(rule.sentence.format(subject=one.subject, took=took)),
            _REMEDIES.get(one.subject) or rule.remedy.format(subject=one.subject) or wake_up_remedy,
            one.long_ns / total_ns,
        )
    if causes.throttled and causes.late + causes.long >= LEAST_CYCLES:
        samples = counted(causes.throttled, "second", "seconds")
        yield cause(
            "throttled_processor",
            "machine",
            f"The processor was hot and slow for {samples}, and cycles were late.",
            "Check fan and heat sink, or lower the load beside the loop.",
            share=0.0,
        )


def _accused(one: Cause) -> str:
    """Return what a cause accuses, as findings call it."""
    if one.kind in ("machine", "late wake-up"):
        return "machine"
    if one.kind in ("own work", "plan"):
        return "loop"
    return one.servo or one.subject.removeprefix("bus ")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
