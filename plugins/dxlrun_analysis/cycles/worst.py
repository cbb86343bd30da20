"""What is found about late and long cycles: causes over a run, and the worst cycles as packet timelines.

The forms only, for tables, plots and JSON; `dxlrun_analysis.causes` fills them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

CauseKind = Literal[
    "late wake-up",
    "machine",
    "late reply",
    "missing reply",
    "retry",
    "write call",
    "controller",
    "own work",
    "plan",
    "unexplained",
]
"""Where time went that a cycle was not planned to take; analyze.md has what each means."""


@dataclass(frozen=True, slots=True)
class Cause:
    """One cause over a whole run."""

    kind: CauseKind
    subject: str  # The servo with its joint, the bus, the controller, or what the machine did; empty: none
    cycles: int  # In which it had a part
    total_ns: int
    worst_ns: int  # The most in one cycle
    long_ns: int
    """Of the total, what it has of cycles that were too long; the rest is of such as only woke late."""
    servo: str = ""  # The joint of the servo, or its bus and ID; empty: the cause is no servo


@dataclass(frozen=True, slots=True)
class CauseShare:
    """What one cause has of a cycle's excess, us."""

    kind: CauseKind
    subject: str  # As in Cause
    us: float

    @property
    def name(self) -> str:
        """The cause with its subject, as in a sentence; what the machine did is its own name."""
        if self.kind == "machine":
            return self.subject
        return f"{self.kind} of {self.subject}" if self.subject else self.kind


TimelineKind = Literal["instruction", "status", "noise", "late", "other host", "echo"]


@dataclass(frozen=True, slots=True)
class TimelinePacket:
    """One packet of a cycle; times in us since the cycle was due, below 0 in the idle time before."""

    bus: str
    kind: TimelineKind
    servo_id: int  # 254: all servos
    joint: str  # Of the servo that is asked or answers; empty: several, or the plan does not name it
    begin_us: float  # Of an instruction before its write(), else after the read() that brought the first byte
    end_us: float  # After the write(), or after the read() that brought the last byte
    planned_us: float | None
    """When the plan expects its last byte, the exchange having begun when it did; None where it has none."""
    size: int  # Bytes


@dataclass(frozen=True, slots=True)
class WorstCycle:
    """One cycle with its packets; times in us since it was due (`scheduled_ns`)."""

    cycle: int
    seconds: float  # When it was due, since the first deadline
    scheduled_ns: int  # The same by the run's clock, which is the time base of all plots
    period_us: float
    woken_us: float  # Also how late the wake-up was
    read_us: float
    updated_us: float
    written_us: float  # When it ended
    skipped: int  # Periods that were left out behind it
    excess_us: float  # Lateness, and what the cycle took beyond its planned exchanges: the sum of its causes
    causes: tuple[CauseShare, ...]  # The largest first
    packets: tuple[TimelinePacket, ...]  # In the order of time, those of the idle time before it too
