"""Findings: what programs of the start, of a return and of tools find on the servos of one bus."""

from __future__ import annotations

import msgspec

from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlwire.control_table import FoundDeviation

_MOST_NAMED = 6  # Settings of one servo that an event names


class Findings(msgspec.Struct):
    """Problems and events, in the order in which they were found."""

    problems: list[str] = []  # Why a servo, and with it the robot, must not start, one sentence each
    events: list[tuple[EventCode, Severity, str, str]] = []
    """What a log has of it: code, severity, joint or device, text."""
    deviations: list[tuple[str, str, FoundDeviation]] = []
    """Settings that are not the factory's: joint, `ID 4 on bus main`, what was found there."""

    def note(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        """Add what a log shall have."""
        self.events.append((code, severity, source, text))

    def texts(self, code: EventCode) -> list[tuple[str, str]]:
        """Return the events of a code, each as its source and text."""
        return [(source, text) for each, _, source, text in self.events if each is code]

    def describe_deviations(self) -> list[tuple[str, str]]:
        """Return a sentence about each servo with settings that are not the factory's, with its joint."""
        sentences: list[tuple[str, str]] = []
        for joint, place in dict.fromkeys((joint, place) for joint, place, _ in self.deviations):
            own = [each for _, where, each in self.deviations if where == place]
            named = "; ".join(f"{each.text}, which {each.effect}" for each in own[:_MOST_NAMED])
            if len(own) > _MOST_NAMED:
                named += f"; {len(own) - _MOST_NAMED} more, see `dxlrun check ROBOT.yaml --online`"
            remedies: dict[str, list[str]] = {}
            for each in own[:_MOST_NAMED]:
                remedies.setdefault(each.remedy, []).append(each.item.title)
            how = "; ".join(
                remedy if len(remedies) == 1 else f"{remedy} ({', '.join(titles)})"
                for remedy, titles in remedies.items()
            )
            sentences.append((joint, f"{place} differs from the factory's settings: {named}; {how}"))
        return sentences

    def log(self, events: EventSink) -> None:
        """Log the events, and one for all settings of a servo that are not the factory's."""
        for event in self.events:
            events.emit(*event)
        for joint, text in self.describe_deviations():
            events.emit(EventCode.REGISTER_DIFFERS, Severity.WARNING, joint, text)
