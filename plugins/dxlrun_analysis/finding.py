"""Finding: one observation about a run that the verdict reports, as data and as a sentence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, unique

from dxlrun.tooling.records import EventCode

ROBOT = "robot"
"""Code of the verdict's first line, the summary of the robot's behaviour, which accuses nothing."""


HURTS = {
    EventCode.SERVO_REBOOTED: "rebooted",
    EventCode.SERVO_LOST: "was lost",
    EventCode.SERVO_LIMP: "lost its torque",
}
"""Events of severe failures of servos, with the verb phrase that reports each."""


@unique
class Rank(IntEnum):
    """Severity of a finding, the worst first. A run is good if no finding is worse than CAUSE."""

    NEVER_RAN = 0  # The run did not start, or one of its processes failed
    LINE = 1
    SERVO_CAUSE = 2  # Explains why a servo failed
    SERVO = 3
    SHARE_CAUSE = 4  # Explains invalid states, skipped periods or errors
    SHARE = 5  # Share of time: joints and periods, the largest share first
    ERROR = 6
    LOG = 7
    CAUSE = 8  # Can lead to any of the ranks above, but has not; the run may be good
    REMARK = 9


@dataclass(frozen=True, slots=True)
class Finding:
    """One observation about a run, which may accuse a part of the robot.

    Rules of all rooms of the analysis create findings; `judge` in verdict.py sorts them, the worst first.
    """

    code: str
    """Code for programs: a key of `dxlrun_analysis.rules.RULES`, or ROBOT."""
    subject: str  # Accused bus, servo, joint, controller or process, or empty
    sentence: str  # Observation, for a person
    remedy: str = ""
    """Recommended action, a sentence or a command. Rules leave it empty unless they measured a remedy;
    `judge` then uses that of the rule in `RULES`."""
    rank: Rank = Rank.REMARK
    share: float = 0.0
    """Sort key within a rank, the greatest first. Findings with equal shares keep their order."""

    @property
    def order(self) -> tuple[int, float]:
        """Sort key of the finding: rank, then descending share."""
        return self.rank, -self.share

    @property
    def line(self) -> str:
        """Sentence of the finding, followed by its remedy."""
        return f"{self.sentence} {self.remedy}".rstrip()


def listed(names: Iterable[str], most: int = 3) -> str:
    """Return the first `most` distinct names and the number of further ones: `a, b, c and 2 more`."""
    shown = list(dict.fromkeys(names))
    more = len(shown) - most
    return ", ".join(shown[:most]) + (f" and {more} more" if more > 0 else "")


def cause(code: str, subject: str, sentence: str, remedy: str = "", share: float = 1.0) -> Finding:
    """Return a finding of rank CAUSE: one that can explain a failure, but alone does not make a run bad."""
    return Finding(code, subject, sentence, remedy, Rank.CAUSE, share)
