"""Wire reports: turns reports of the library `dxlwire` into events of a run."""

from __future__ import annotations

from dxlrun.channels.event_records import EventSink
from dxlrun.dynamixel import texts
from dxlwire.exchange.reports import Reason

_EVENTS = {Reason.IMPLAUSIBLE: texts.values_implausible, Reason.NO_IDLE_TIME: texts.idle_time_short}
"""Function that makes the event of each reason of a report."""


class WireReports:
    """`ReportSink` of dxlwire that sends each report to the log of the run as an event."""

    def __init__(self, events: EventSink) -> None:
        self._events = events

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Send a report to the log as the event of its reason."""
        self._events.emit_event(source, _EVENTS[reason](text))
