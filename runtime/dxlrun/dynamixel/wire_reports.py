"""Reports of dxlwire as events of a run."""

from __future__ import annotations

from dxlrun.channels.events import EventSink
from dxlrun.dynamixel import texts
from dxlwire.exchange.reports import Reason

_EVENTS = {Reason.IMPLAUSIBLE: texts.values_implausible, Reason.NO_IDLE_TIME: texts.idle_time_short}
"""Event of each reason."""


class WireReports:
    """Emits reports of dxlwire as events; a `ReportSink`."""

    def __init__(self, events: EventSink) -> None:
        self._events = events

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Emit a report as the event of its reason."""
        self._events.emit(source, _EVENTS[reason](text))
