"""A finding: one thing that a run shows, as data for programs and as a sentence for a person."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, unique

from dxlrun.tooling.records import EventCode

ROBOT = "robot"
"""The code of the first line: what the robot did. It accuses nothing, and stands before all others."""


HURTS = {
    EventCode.SERVO_REBOOTED: "rebooted",
    EventCode.SERVO_LOST: "was lost",
    EventCode.SERVO_LIMP: "lost its torque",
}
"""What happens to servos, and what is said of them."""


@unique
class Rank(IntEnum):
    """Severity of a finding; the first is the worst."""

    NEVER_RAN = 0  # Nor to its end, where a process of the run failed
    LINE = 1
    SERVO_CAUSE = 2  # Explains why a servo failed
    SERVO = 3
    SHARE_CAUSE = 4  # Explains invalid states, skipped periods or errors
    SHARE = 5  # Of the time: joints and periods, the largest share first
    ERROR = 6
    LOG = 7
    CAUSE = 8  # Leads to any of these, but has not yet: the run may be good
    REMARK = 9


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. Rules of every room of the analysis make them; `judge` sorts them, the worst first."""

    code: str
    """A word for programs, of `dxlrun_analysis.rules.RULES`, or ROBOT."""
    subject: str  # The bus, servo, joint, controller or process that it accuses; empty: none
    sentence: str  # What was found, for a person
    remedy: str = ""
    """What to do about it, a sentence or a command: rules leave it empty unless they measured what helps, and
    `judge` takes that of the table."""
    rank: Rank = Rank.REMARK
    share: float = 0.0
    """Findings of one rank are sorted by it, the greatest first; those of one share keep their order."""

    @property
    def order(self) -> tuple[int, float]:
        """By it findings are sorted."""
        return self.rank, -self.share

    @property
    def line(self) -> str:
        """The sentence, and the remedy behind it."""
        return f"{self.sentence} {self.remedy}".rstrip()


def listed(names: Iterable[str], most: int = 3) -> str:
    """Return the first of some names, each once, and how many more there are."""
    shown = list(dict.fromkeys(names))
    more = len(shown) - most
    return ", ".join(shown[:most]) + (f" and {more} more" if more > 0 else "")


def cause(code: str, subject: str, sentence: str, remedy: str = "", share: float = 1.0) -> Finding:
    """Return a finding that leads to what makes a run not good, see Rank.CAUSE."""
    return Finding(code, subject, sentence, remedy, Rank.CAUSE, share)
