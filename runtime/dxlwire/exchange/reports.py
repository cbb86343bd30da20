"""Reports: observations during the exchange that the caller should log, each with a typed reason."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, unique
from typing import Protocol


@unique
class Reason(Enum):
    """Reason of a report, by which the caller chooses the event in its log."""

    IMPLAUSIBLE = "implausible"
    """A servo or device sent values that are not plausible; they were not used."""
    NO_IDLE_TIME = "no_idle_time"
    """A program waits for more idle time than the cycle has; later cycles may be late."""


# Texts


def jumped(joint: str, jump: str, elapsed_ns: int) -> str:
    """Return the text for a position that its servo cannot have reached; `jump` is the distance with unit."""
    time = f"{elapsed_ns * 1e-6:.0f} ms"
    return f"{joint} jumped by {jump} in {time}, faster than it can turn: value discarded"


def not_finite(device: str, states: Sequence[str]) -> str:
    """Return the text for values of a device that are NaN or infinite; `states` are their names."""
    return f"{device} sent non-finite values ({', '.join(states)}): values discarded"


def idle_time_short(program: str, needed_ns: int, left_ns: int) -> str:
    """Return the text for a program that needs more idle time than a cycle has."""
    return (
        f"{program} needs up to {needed_ns * 1e-6:.1f} ms of idle time, but a cycle leaves only "
        f"{left_ns * 1e-6:.1f} ms; periods may be skipped"
    )


class ReportSink(Protocol):
    """Receiver of reports, implemented by the caller; never blocks, never raises."""

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Receive a report.

        Args:
            reason: Type of the report.
            source: Name of a joint, device or bus.
            text: A sentence.
        """
        ...
