"""Reports of dxlwire as events of a run."""

from __future__ import annotations

from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlwire.exchange.reports import Reason

_EVENTS = {
    Reason.IMPLAUSIBLE: (EventCode.IMPLAUSIBLE, Severity.WARNING),
    Reason.NO_IDLE_TIME: (EventCode.OVERRUN, Severity.WARNING),
}
"""Code and severity of each reason."""


class WireReports:
    """Emits reports of dxlwire as events; a `ReportSink`."""

    def __init__(self, events: EventSink) -> None:
        self._events = events

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Emit a report as the event of its reason."""
        self._events.emit(*_EVENTS[reason], source, text)
