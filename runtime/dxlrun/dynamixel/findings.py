"""Findings: problems and events collected on one bus at start-up, when a servo returns, and by tools."""

from __future__ import annotations

import msgspec

from dxlrun.channels.event_records import EventBody, EventCode, EventSink
from dxlrun.dynamixel import texts
from dxlwire.control_table import FoundDeviation

_MOST_NAMED = 6  # settings of one servo that an event lists, to keep it readable


class Findings(msgspec.Struct):
    """Collects problems, events for the log and unusual settings, each in the order in which they were
    found."""

    problems: list[str] = []  # reasons to refuse the start, one sentence each
    events: list[tuple[str, EventBody]] = []
    """Events for the log, each with the name of its joint or device."""
    deviations: list[tuple[str, str, FoundDeviation]] = []
    """Settings that differ from the factory's: joint, place such as `ID 4 on bus main`, and the deviation."""

    def add_event(self, source: str, event: EventBody) -> None:
        """Add an event for the log; `source` is the name of a joint or a device."""
        self.events.append((source, event))

    def texts(self, code: EventCode) -> list[tuple[str, str]]:
        """Return source and text of each event that has this code."""
        return [(source, event.text) for source, event in self.events if event.code is code]

    def describe_deviations(self) -> list[tuple[str, str]]:
        """Return (joint, sentence) for each servo with settings that differ from the factory's; the sentence
        names settings and remedy.
        """
        return [(joint, event.text) for joint, event in self._deviation_events()]

    def _deviation_events(self) -> list[tuple[str, EventBody]]:
        events: list[tuple[str, EventBody]] = []
        for joint, place in dict.fromkeys((joint, place) for joint, place, _ in self.deviations):
            own = [each for _, where, each in self.deviations if where == place]
            named = "; ".join(f"{each.text} ({each.effect})" for each in own[:_MOST_NAMED])
            if len(own) > _MOST_NAMED:
                named += f"; {len(own) - _MOST_NAMED} more, see `dxlrun check ROBOT.yaml --online`"
            remedies: dict[str, list[str]] = {}
            for each in own[:_MOST_NAMED]:
                remedies.setdefault(each.remedy, []).append(each.item.title)
            how = "; ".join(
                remedy if len(remedies) == 1 else f"{remedy} ({', '.join(titles)})"
                for remedy, titles in remedies.items()
            )
            events.append((joint, texts.settings_differ(place, named, how)))
        return events

    def log(self, events: EventSink) -> None:
        """Send the events to the log, and one event per servo for its settings that differ from the
        factory's.
        """
        for source, event in (*self.events, *self._deviation_events()):
            events.emit_event(source, event)
