"""Findings: problems and events that start-up, servo recovery and tools found on one bus."""

from __future__ import annotations

import msgspec

from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlwire.control_table import FoundDeviation

_MOST_NAMED = 6  # settings of one servo that an event lists, to keep it readable


class Findings(msgspec.Struct):
    """Problems and events, in the order in which they were found."""

    problems: list[str] = []  # reasons to refuse the start, one sentence each
    events: list[tuple[EventCode, Severity, str, str]] = []
    """Events for the log: code, severity, joint or device, text."""
    deviations: list[tuple[str, str, FoundDeviation]] = []
    """Settings that differ from the factory's: joint, `ID 4 on bus main`, and the deviation."""

    def note(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        """Add an event for the log."""
        self.events.append((code, severity, source, text))

    def texts(self, code: EventCode) -> list[tuple[str, str]]:
        """Return the events with a code, each as its source and text."""
        return [(source, text) for each, _, source, text in self.events if each is code]

    def describe_deviations(self) -> list[tuple[str, str]]:
        """Return a sentence for each servo whose settings differ from the factory's, with its joint."""
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
        """Log the events, and one event per servo for its settings that differ from the factory's."""
        for event in self.events:
            events.emit(*event)
        for joint, text in self.describe_deviations():
            events.emit(EventCode.REGISTER_DIFFERS, Severity.WARNING, joint, text)
