"""Cases as text: what happens to a robot, and what a person would expect to read about it.

    weak_driver: mx_bulk x_sync x_three
      about: The line driver of one servo is dying: a bit of its replies is wrong now and then.
      from 1 s on 15 % of the replies of right_elbow have a wrong bit
      => not good
      => right_elbow: BROKEN

The texts have the form of `tests/kit/cases.py`. A case has its name and its robots, then indented lines:
`about:` describes what happens, each other line does something (`injections.py` reads it; `[mx_bulk]` before
it: on that robot), and `=>` has what is expected:

    => good, => not good             without one, either way
    => left_elbow, right_knee: LATE  a sentence names them and says LATE (`WORDS`), or `: delay|slow`;
                                     `bus:JOINT` needs no name where it is the only bus
    => a first line with body: FAIL  that sentence is the first of all; `one of two with`: the first or second
                                     that blames something, or one of the first two of all
    => spares left_knee              nothing blames it; or `all joints`, `all but left_knee`, `hardware` (and
                                     no advice to check any); else all joints that no sentence is to name
    => finds lossy_line main; ...    these are all findings on the traffic of the buses, before the verdict
    => unnamed on x_fast: why        known not to be named

Nothing is to be blamed where no sentence is expected. The cases were written without a look at the analysis.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.analysis.verdicts.injections import inject
from tests.analysis.verdicts.rig import JOINTS, ROBOTS, Robot, Story
from tests.kit.cases import read_cases as read_texts
from tests.kit.totals import totals_of

from dxlrun.log.log_reader import read_log
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.servos.traffic import Traffic
from dxlrun_analysis.verdict import judge_run

HARDWARE = (*JOINTS, "bus:left_knee", "bus:right_knee", "bus:head_yaw", "hardware")
"""All joints, all buses, and whatever a remedy could have a person check or exchange."""
WORDS = {
    "BROKEN": r"duplicate|second servo|two servos|same ID|driver|transceiver|corrupt|broken|garbl|damaged"
    r"|checksum|CRC",
    "LATE": r"\blate|slow|delay|after its",
    "HOST": r"(another|second|other) (host|program|master|computer|controller)|foreign",
    "STUCK": r"froz|stuck|stands? still|stood still|not? (once )?mov|not follow|same (tick|position|value)"
    r"|block|jam",
    "SOFT": r"gain|follow|error|lag|behind|weak|soft|compliant|\boff\b|away from|from its goal|deviat|track",
    "MACHINE": r"machine|processor|\bcores?\b|\bCPU|busy|scheduler|other (program|process)|starved"
    r"|waited for",
    "SILENT": r"silent|not answer|no repl|lost|miss|did not repl|stopped",
    "SHARED": r"together|same (time|moment|cycle)|at once|shared?|common|behind",
    "REACHES": r"reach|short of|sag|sink|sank|fell|fall|droop|distance|differ|apart|out of place",
    "LOAD": r"load|effort|torque|current|weight|heav|force|press|push|strain",
    "VOLTS": r"volt|batter|suppl|power|brown|\bV\b",
    "HEAT": r"\bhot\b|heat|warm|temperature|thermal|°\s?C|deg(rees)? ?C|cool",
    "GONE": r"contact|answer|repl(y|ies)|gone|absent|vanish|drop",
    "CABLE": r"cable|plug|contact|connect|wire|wiring|loose|chain|intermittent",
    "REBOOTS": r"re-?boot|re-?start|start(ed|s)? again|power|brown|reset|lost its (power|torque)|limp",
    "WAKES": r"wak|woke|\blate\b|sched|deadline|jitter|overrun|skipp|stall|oversle",
    "IMU": r"imu|gyro|sensor|acceler|orientation",
    "LOG": r"\b(logs?|record\w*|files?)\b",
    "ADAPTERS": r"hub|USB|adapter|port|bus",
}
"""Words with which a sentence may name such a cause."""
_ADVICE = re.compile(
    r"(check|exchange|replace|swap|unplug|raise|shorten|shorter|stronger|thicker)[^.;]*"
    r"\b(servos?|cables?|adapter|supply|plugs?|connectors?|wiring|hub|latency|ground|shield|termination)\b",
    re.IGNORECASE,
)
"""Advice on what is not a program."""


@dataclass
class Case:
    """A fault, or something that only looks like one, and what a person would expect to read about it."""

    name: str
    robots: tuple[str, ...]
    place: str = ""
    happens: str = ""
    lines: list[tuple[str, str, str]] = field(default_factory=list)  # place, robots or nothing, what is done
    subject: tuple[str, ...] = ()
    causes: list[str] = field(default_factory=list)  # all of these patterns match one sentence
    first: int = 1  # among so many first findings with blame; 0: the very first sentence
    good: bool | None = None
    spared: tuple[str, ...] | None = None
    finds: list[tuple[str, str]] | None = None
    unnamed: dict[str, str] = field(default_factory=dict)

    def expect(self, text: str) -> None:
        """Read a line of what is expected."""
        if text in ("good", "not good"):
            self.good = text == "good"
        elif text.startswith("spares "):
            self.spared = _joints(text.removeprefix("spares "))
        elif text.startswith("finds "):
            self.finds = [(code, of) for code, of in map(str.split, text.removeprefix("finds ").split("; "))]
        elif text.startswith("unnamed on "):
            robot, _, why = text.removeprefix("unnamed on ").partition(": ")
            self.unnamed[robot] = why
        else:
            who, _, cause = text.rpartition(": ")
            for words, first in (("a first line with", 0), ("one of two with", 2)):
                if who.startswith(words):
                    self.first, who = first, who.removeprefix(words).strip()
            self.subject = tuple(who.split(", ")) if who else ()
            self.causes = [_pattern(one) for one in cause.split(" and ")]

    def prepare(self, robot: str, directory: Path) -> Story:
        """Return the run of the case on a robot, before it begins."""
        story = Story(ROBOTS[robot], f"{self.name} 1", directory)
        for place, of, text in self.lines:
            if (robot in of.split() or not of) and not inject(story, text):
                raise ValueError(f"{place}: {text!r} is no line of a case")
        return story

    def judge(self, robot: str, directory: Path) -> Judged:
        """Run it on a robot. Raises AssertionError when the fault did not happen."""
        story = self.prepare(robot, directory)
        log = story.run()
        assert story.evidence, f"{self.place}: nothing was injected"
        missing = [kind for kind, count in story.evidence.items() if not count]
        assert not missing, f"{self.place}: did not happen: {missing}"
        return self.compare(ROBOTS[robot], log)

    def compare(self, robot: Robot, log: Path) -> Judged:
        """Compare the verdict on a log with what is expected."""
        if self.finds is not None:
            traffic = Traffic()
            traffic.add_slice(read_log(log))
            traffic.summarize_traffic()
            found = sorted((one.code, one.subject, one.sentence) for one in traffic.findings)
            as_expected = [one[:2] for one in found] == self.finds and all(
                re.search(cause, found[0][2]) for cause in self.causes
            )
            return Judged(None, [], [] if as_expected else [f"FOUND {found}"])
        totals = totals_of(log)
        for bus in totals.plan.buses:
            bus.noted = False  # as the log of real servos, as which the story names its ports
        verdict = judge_run(totals)
        blamed = [finding for finding in verdict.findings if finding.rank < max(type(finding.rank))]
        candidates = verdict.findings[: 2 if self.first else 1]
        if self.first:
            candidates = (*candidates, *blamed[: self.first])
        of_bus = {f"bus:{joint}": bus for bus, joints in robot.buses.items() for joint in joints}
        subject = [of_bus.get(name, name) for name in self.subject]
        needed = [name for name in subject if name not in robot.buses or len(robot.buses) > 1]
        named = not blamed
        if self.causes:
            named = any(
                all(re.search(cause, one.sentence, re.IGNORECASE | re.DOTALL) for cause in self.causes)
                and all(_names(name, f"{one.subject} {one.sentence}") for name in needed)
                for one in candidates
            )
        spared = [name for name in JOINTS if name not in subject] if self.spared is None else self.spared
        accused = [
            name
            for name in dict.fromkeys(of_bus.get(name, name) for name in spared)
            if any(_accuses(finding, name, subject, is_first=finding is blamed[0]) for finding in blamed)
        ]
        wrong = [] if named else ["THE CAUSE IS NOT NAMED"]
        wrong += ["THE WORD IS WRONG"] if self.good not in (None, verdict.good) else []
        return Judged(verdict, accused, wrong)


@dataclass(frozen=True)
class Judged:
    """A verdict, the innocents that it accuses, and what else is wrong with it."""

    verdict: Any
    accused: list[str]
    wrong: list[str]

    def __str__(self) -> str:
        if self.verdict is None:
            return " ".join(self.wrong)
        findings = (
            f"{one.rank!r} {one.subject}: {one.sentence} -> {one.remedy}" for one in self.verdict.findings
        )
        accused = f"ACCUSED: {', '.join(self.accused)}" * bool(self.accused)
        return "\n    ".join((f"{self.verdict.word} {' '.join(self.wrong)} {accused}", *findings))


def read_cases(*paths: Path) -> Iterator[Case]:
    """Yield the cases of texts. Raises ValueError with file and line."""
    for name, robots, text in ((*one.name.partition(": ")[::2], one) for one in read_texts(*paths)):
        case = Case(name, tuple(robots.split()), text.place)
        if not case.robots or set(case.robots) - set(ROBOTS):
            raise ValueError(f"{text.place}: write NAME: ROBOTS, of {', '.join(ROBOTS)}")
        for place, line, _ in text.lines:
            if line.startswith("about: "):
                case.happens += line.removeprefix("about:")
            elif line.startswith("=> "):
                case.expect(line[3:])
            else:
                of = re.match(r"\[([\w ]+)\] ", line)
                case.lines.append((place, of[1], line[of.end() :]) if of else (place, "", line))
        yield case


def _joints(text: str) -> tuple[str, ...]:
    if text.startswith("all but "):
        return tuple(joint for joint in JOINTS if joint not in text.removeprefix("all but ").split(", "))
    return {"all joints": JOINTS, "hardware": HARDWARE}.get(text, tuple(text.split(", ")))


def _pattern(text: str) -> str:
    return "|".join(WORDS.get(part, part) for part in text.split("|"))


def _accuses(finding: Finding, name: str, subject: list[str], *, is_first: bool) -> bool:
    """Check whether a finding blames something.

    That is its subject or in its remedy, or its sentence has it and nothing else that is to blame. A finding
    without a remedy reports what was seen: it blames where it is the first, which is read as the cause.
    """
    if name == "hardware":
        return bool(_ADVICE.search(finding.remedy))
    if not (finding.remedy or is_first):
        return False
    if _names(name, finding.subject) or _names(name, finding.remedy):
        return True
    to_blame = any(_names(one, f"{finding.subject} {finding.sentence}") for one in subject)
    return _names(name, finding.sentence) and not to_blame


def _names(name: str, text: str) -> bool:
    return re.search(rf"(?<![A-Za-z0-9_]){re.escape(name)}(?![A-Za-z0-9_])", text) is not None
