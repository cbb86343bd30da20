"""Reports of the exchange to its caller: what it noticed by itself, with a typed reason."""

from __future__ import annotations

from enum import Enum, unique
from typing import Protocol


@unique
class Reason(Enum):
    """Reason of a report."""

    IMPLAUSIBLE = "implausible"
    """Values of a servo or device that cannot be true; they were not used."""
    NO_IDLE_TIME = "no_idle_time"
    """A program waits for idle time that the cycle does not leave; later cycles may be late."""


class ReportSink(Protocol):
    """Takes reports; never blocks, never raises."""

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Take a report about `source`, the name of a joint, device or bus; `text` is a sentence."""
        ...
