"""Record types for late and long cycles: causes summed over a run, and the worst cycles with their packets.

`dxlrun_analysis.causes` creates the records; tables, plots and JSON show them.
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
"""Kind of cause of unplanned time in a late or long cycle; analyze.md explains each."""


@dataclass(frozen=True, slots=True)
class Cause:
    """One cause of late and long cycles: the time attributed to it, summed over the worst cycles of a run."""

    kind: CauseKind
    subject: str  # Servo with its joint, bus, controller or activity of the machine; empty for none
    cycles: int  # Cycles with a share of this cause
    total_ns: int
    worst_ns: int  # Greatest share in one cycle
    long_ns: int
    """Part of `total_ns` in long cycles; the rest is in cycles that only woke late."""
    servo: str = ""  # Joint of the servo, or its bus and ID; empty if the cause is not a servo


@dataclass(frozen=True, slots=True)
class CauseShare:
    """Time of one cycle's excess that is attributed to one cause, us."""

    kind: CauseKind
    subject: str  # As in Cause
    us: float

    @property
    def label(self) -> str:
        """Cause as text: `late reply of bus main`; for kind `machine`, only its activity."""
        if self.kind == "machine":
            return self.subject
        return f"{self.kind} of {self.subject}" if self.subject else self.kind


TimelineKind = Literal["instruction", "status", "noise", "late", "other host", "echo"]


@dataclass(frozen=True, slots=True)
class TimelinePacket:
    """One packet of a cycle; times in us since the cycle's deadline, negative before it."""

    bus: str
    kind: TimelineKind
    servo_id: int  # 254: all servos
    # Joint of the servo that is asked or answers; empty for several servos, or if the plan does not name it.
    joint: str
    begin_us: float  # Instruction: before its write(); else after the read() that returned the first byte
    end_us: float  # After the write(), or after the read() that returned the last byte
    planned_us: float | None
    """Planned time at which its last byte is sent or read, counted from the actual begin of its exchange;
    None for noise, late, foreign and echoed packets, and if the baud rate is unknown."""
    size: int  # Bytes


@dataclass(frozen=True, slots=True)
class WorstCycle:
    """One late or long cycle with the causes of its excess and its packets. Times are in us since its
    deadline (`scheduled_ns`)."""

    cycle: int
    seconds: float  # Deadline, since the first deadline
    scheduled_ns: int  # Deadline on the run's clock, which is the time base of all plots
    period_us: float
    woken_us: float  # Equals the lateness of the wake-up
    read_us: float
    updated_us: float
    written_us: float  # End of the cycle
    skipped: int  # Periods skipped after this cycle
    excess_us: float  # Lateness and time beyond the planned exchanges: the sum of the causes
    causes: tuple[CauseShare, ...]  # Largest first
    packets: tuple[TimelinePacket, ...]  # In order of time, including those of the preceding idle time
