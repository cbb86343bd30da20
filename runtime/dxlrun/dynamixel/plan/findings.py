"""Findings: what programs of the start, of a return and of tools find on the servos of one bus."""

from __future__ import annotations

import msgspec

from dxlrun.channels.events import EventCode, EventSink, Severity


class Findings(msgspec.Struct):
    """Problems and events, in the order in which they were found."""

    problems: list[str] = []  # Why a servo, and with it the robot, must not start, one sentence each
    events: list[tuple[EventCode, Severity, str, str]] = []
    """What a log has of it: code, severity, joint or device, text."""

    def note(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        """Add what a log shall have."""
        self.events.append((code, severity, source, text))

    def texts(self, code: EventCode) -> list[tuple[str, str]]:
        """Return the events of a code, each as its source and text."""
        return [(source, text) for each, _, source, text in self.events if each is code]

    def log(self, events: EventSink) -> None:
        """Log the events."""
        for event in self.events:
            events.emit(*event)
