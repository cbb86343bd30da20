"""Fault cases: what happens, what a person would expect to read about it, and what the verdict says.

They were written without a look at the analysis, whose totals and verdict are all that is used of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.analysis.stranger.kit import JOINTS, ROBOTS, Spec, Story
from tests.kit.totals import totals_of

from dxlrun_analysis.verdict import judge_run

BUSES = ("bus:left_knee", "bus:right_knee", "bus:head_yaw")
HARDWARE = (*JOINTS, *BUSES, "hardware")
"""All joints, all buses, and whatever a remedy could have a person check or exchange."""

BROKEN = (
    r"duplicate|second servo|two servos|same ID|driver|transceiver|corrupt|broken|garbl|damaged|checksum|CRC"
)
LATE = r"\blate|slow|delay|after its"
HOST = r"(another|second|other) (host|program|master|computer|controller)|foreign"
STUCK = (
    r"froz|stuck|stands? still|stood still|not? (once )?mov|not follow|same (tick|position|value)|block|jam"
)
SOFT = r"gain|follow|error|lag|behind|weak|soft|compliant|\boff\b|away from|from its goal|deviat|track"
MACHINE = r"machine|processor|\bcores?\b|\bCPU|busy|scheduler|other (program|process)|starved|waited for"
SILENT = r"silent|not answer|no repl|lost|miss|did not repl|stopped"
SHARED = r"together|same (time|moment|cycle)|at once|shared?|common|behind"
FOLLOWS = SOFT + r"|reach|short of|sag|sink|sank|fell|fall|droop|distance|differ|apart|out of place"
LOAD = r"load|effort|torque|current|weight|heav|force|press|push|strain"
VOLTS = r"volt|batter|suppl|power|brown|\bV\b"
HEAT = r"\bhot\b|heat|warm|temperature|thermal|°\s?C|deg(rees)? ?C|cool"
LOST = SILENT + r"|contact|answer|repl(y|ies)|gone|absent|vanish|drop"
CABLE = r"cable|plug|contact|connect|wire|wiring|loose|chain|intermittent"
REBOOTS = r"re-?boot|re-?start|start(ed|s)? again|power|brown|reset|lost its (power|torque)|limp"
WAKES = MACHINE + r"|wak|woke|\blate\b|sched|deadline|jitter|overrun|skipp|stall|oversle"
"""Words with which a sentence may name such a cause."""


def others(*joints: str) -> tuple[str, ...]:
    """Return all joints but some."""
    return tuple(name for name in JOINTS if name not in joints)


def together(names: tuple[str, ...], what: str) -> str:
    """Return a pattern for a sentence that has one of some names, and one of some words."""
    return rf"(?=.*({'|'.join(names)}))(?=.*({what}))"


@dataclass(frozen=True)
class Case:
    """A fault, or something that only looks like one, and what a person would expect to read about it."""

    name: str
    kind: str
    happens: str
    robots: tuple[str, ...]
    inject: Callable[[Story], None]
    subject: tuple[str, ...] = ()
    """Joints, buses or controllers that are to blame; the first finding names them. Empty: nothing to name.
    `bus:JOINT` is the bus of a joint, which needs no name where it is the only one."""
    cause: str = ""
    """Regular expression that matches the sentence, whatever its case; empty: nothing is wrong."""
    good: bool | None = None  # Whether the run may, or must, be called good; None: either way
    word: str = ""  # Regular expression that matches the verdict's word
    innocents: tuple[str, ...] | None = None
    """What no finding with blame may accuse; None: all joints but the subject."""
    first: int = 1
    """Among so many first findings with blame the cause is to be, or among the first two of all; 0: it is the
    very first sentence."""
    seed: int = 1
    live: bool = False  # True: it runs in real time, some seconds, by the command line


def collector(cases: list[Case]) -> Callable[..., Callable[[Callable[[Story], None]], None]]:
    """Return a decorator that makes a case of a function for some robots: its docstring is what happens."""

    def case(kind: str, robots: str, **expected: Any) -> Callable[[Callable[[Story], None]], None]:
        def add(inject: Callable[[Story], None]) -> None:
            happens = " ".join((inject.__doc__ or "").split())
            cases.append(Case(inject.__name__, kind, happens, tuple(robots.split()), inject, **expected))

        return add

    return case


@dataclass(frozen=True)
class Judged:
    """What a verdict was worth."""

    case: str
    kind: str
    robot: str
    verdict: Any
    named: bool
    good_right: bool
    accused: tuple[str, ...]

    @property
    def right(self) -> bool:
        """True when the cause is named, no innocent accused, and good is what may be called so."""
        return self.named and self.good_right and not self.accused

    @property
    def row(self) -> str:
        """A row of the table."""
        marks = [
            "named" if self.named else "NOT NAMED",
            self.verdict.word + ("" if self.good_right else " (WRONG)"),
            f"ACCUSED: {', '.join(self.accused)}" if self.accused else "",
        ]
        sentence = self.verdict.findings[0].sentence if self.verdict.findings else ""
        return f"{self.kind:9} {self.case:34} {self.robot:10} {' | '.join(marks)}\n    {sentence}"


_HARDWARE = re.compile(
    r"(check|exchange|replace|swap|unplug|raise|shorten|shorter|stronger|thicker)[^.;]*"
    r"\b(servos?|cables?|adapter|supply|plugs?|connectors?|wiring|hub|latency|ground|shield|termination)\b",
    re.I,
)
"""Advice on what is not a program."""


def judged(case: Case, robot: str, directory: Path) -> Judged:
    """Run a case on a robot, and compare the verdict on its log with what is expected.

    Raises AssertionError when the fault did not happen.
    """
    story = Story(ROBOTS[robot], f"{case.name} {case.seed}", directory)
    case.inject(story)
    log = story.run()
    assert story.evidence, f"{case.name}: nothing was injected"
    missing = [kind for kind, count in story.evidence.items() if not count]
    assert not missing, f"{case.name}: did not happen: {missing}"
    return compared(case, robot, log)


def compared(case: Case, robot: str, log: Path) -> Judged:
    """Compare the verdict on a log with what a case expects."""
    totals = totals_of(log)
    for bus in totals.plan.buses:
        bus.noted = False  # It is judged as the log of real servos, as which the kit names its ports
    verdict = judge_run(totals)
    spec = ROBOTS[robot].spec
    blamed = [finding for finding in verdict.findings if finding.rank < max(type(finding.rank))]
    candidates = [*verdict.findings[:2], *blamed[: case.first]] if case.first else verdict.findings[:1]
    subject = tuple(_resolved(name, spec) for name in case.subject)
    needed = [name for name in subject if name not in spec["buses"] or len(spec["buses"]) > 1]
    if case.cause:
        named = any(
            re.search(case.cause, one.sentence, re.I | re.S)
            and all(_names(name, f"{one.subject} {one.sentence}") for name in needed)
            for one in candidates
        )
    else:
        named = not blamed
    good_right = case.good in (None, verdict.good) and bool(re.search(case.word, verdict.word))
    innocents = case.innocents
    if innocents is None:
        innocents = tuple(joint for joint in JOINTS if joint not in subject)
    accused = dict.fromkeys(
        name
        for name in (_resolved(innocent, spec) for innocent in innocents)
        for finding in blamed
        if _accuses(finding, name, subject, first=finding is blamed[0])
    )
    return Judged(case.name, case.kind, robot, verdict, named, good_right, tuple(accused))


def _resolved(name: str, spec: Spec) -> str:
    bus: str = spec["joints"][name.removeprefix("bus:")]["bus"] if name.startswith("bus:") else name
    return bus


def _accuses(finding: Any, name: str, subject: tuple[str, ...], *, first: bool) -> bool:
    """Return whether a finding blames something.

    That is its subject or in its remedy, or its sentence has it and nothing else that is to blame. A finding
    without a remedy reports what was seen: it blames where it is the first, which is read as the cause.
    """
    if name == "hardware":
        return bool(_HARDWARE.search(finding.remedy))
    if not (finding.remedy or first):
        return False
    if _names(name, finding.subject) or _names(name, finding.remedy):
        return True
    return _names(name, finding.sentence) and not any(
        _names(one, f"{finding.subject} {finding.sentence}") for one in subject
    )


def _names(name: str, text: str) -> bool:
    return re.search(rf"(?<![A-Za-z0-9_]){re.escape(name)}(?![A-Za-z0-9_])", text) is not None
