"""Reports of the exchange to its caller: observations with a typed reason."""

from __future__ import annotations

from enum import Enum, unique
from typing import Protocol


@unique
class Reason(Enum):
    """Reason of a report."""

    IMPLAUSIBLE = "implausible"
    """Implausible values of a servo or device, which were not used."""
    NO_IDLE_TIME = "no_idle_time"
    """A program waits for more idle time than the cycle has; later cycles may be late."""


class ReportSink(Protocol):
    """Receiver of reports; never blocks, never raises."""

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Receive a report.

        Args:
            reason: Type of the report.
            source: Name of a joint, device or bus.
            text: A sentence.
        """
        ...
