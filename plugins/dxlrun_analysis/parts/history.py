"""Parts of the report about the course of a run: events, client requests, pauses, messages of controllers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import msgspec

from dxlrun import Log
from dxlrun.tooling.output import Cell, Column, Columns, Table, Tone
from dxlrun.tooling.records import EventGroup, Severity
from dxlrun_analysis.conduct.steering_history import Act
from dxlrun_analysis.parts.part import Report, ReportPart, listing

_MOST_ACTS = 100


class EventCount(msgspec.Struct, frozen=True):
    """Number of events with one name and severity in the log, and the first of them."""

    name: str
    severity: int
    count: int
    first: str  # Source and text of the first event


class TopicCount(msgspec.Struct, frozen=True):
    """Number and rate of the messages that a controller published on one topic in the log."""

    name: str
    type: str
    messages: int
    rate: float | None  # Hz; None for fewer than two messages


class TopicCounts:
    """Counter of the messages on each topic of controllers, fed with the log slice by slice."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[str, int, int, int]] = {}
        """Type, number of messages, times of the first and the last (ns), by topic."""

    def add_slice(self, log: Log) -> None:
        """Count the messages in the next slice of the log."""
        for one in log.topics.values():
            if one.data:
                _, count, first_ns, _ = self._found.get(one.name, ("", 0, int(one.t_ns[0]), 0))
                self._found[one.name] = one.type.name, count + len(one.data), first_ns, int(one.t_ns[-1])

    def count_topics(self) -> tuple[TopicCount, ...]:
        """Return the counted topics, in the order of their first messages."""
        return tuple(
            TopicCount(name, kind, count, (count - 1) * 1e9 / (last - first) if last > first else None)
            for name, (kind, count, first, last) in self._found.items()
        )


def _count_events(events: Sequence[EventGroup]) -> tuple[EventCount, ...]:
    """Count events by name and severity, the most severe first."""
    counts: Counter[tuple[str, int]] = Counter()
    first: dict[tuple[str, int], EventGroup] = {}
    for group in events:
        key = (group.name, group.severity)
        counts[key] += group.count
        first[key] = min(first.get(key, group), group, key=lambda one: one.t_ns)
    ordered = sorted(counts, key=lambda key: (-key[1], key[0]))
    return tuple(EventCount(*key, counts[key], f"{first[key].source}: {first[key].text}") for key in ordered)


def _steering(_: Report, acts: Sequence[Act]) -> Table:
    more = f" (the first {_MOST_ACTS} of {len(acts)})" if len(acts) > _MOST_ACTS else ""
    return Table.listing(f"Steered{more}", _ACT, acts[:_MOST_ACTS])


def tone_of(severity: int) -> Tone:
    """Return the tone in which an event of this severity is shown."""
    if severity >= Severity.ERROR:
        return "error"
    return "warning" if severity >= Severity.WARNING else "plain"


def _once(text: str) -> str:
    """Return the text `source: text` of an event for a table cell, without a repeated source; of several
    lines, only the last."""
    source, _, rest = text.partition(": ")
    line = rest.strip().splitlines()[-1].strip() if rest.strip() else ""
    return line if line.startswith(source) else f"{source}: {line}"


_TOPIC: Columns[TopicCount] = (
    (Column("topic", "name"), "name"),
    (Column("type", "text"), "type"),
    (Column("messages"), "messages"),
    (Column("rate", form="{:.4g} Hz", missing="-"), "rate"),
)
_ACT: Columns[Act] = (
    (Column("s", form="{:.3f}"), "time_s"),
    (Column("cycle"), "cycle"),
    (Column("asked", "text"), "what"),
    (Column("by", "name"), "origin"),
    (
        Column("", "text"),
        lambda act: Cell(f"refused: {act.refusal}", "warning") if act.refusal else "done",
    ),
)
_EVENT: Columns[EventCount] = (
    (Column("event", "name"), lambda event: Cell(event.name, tone_of(event.severity))),
    (Column("count"), "count"),
    (Column("the first", "text"), lambda event: _once(event.first)),
)

EVENTS = ReportPart(
    "events",
    lambda report: _count_events(report.totals.events),
    listing("Events", _EVENT),
    section="events",
    late=3,
)
STEERING = ReportPart("steering", lambda report: report.totals.acts, _steering, section="steering", late=2)
PAUSES = ReportPart("pauses", lambda report: report.totals.pauses)
TOPICS = ReportPart(
    "topics",
    lambda report: report.tally.find_collector(TopicCounts).count_topics(),
    listing("Topics", _TOPIC),
    TopicCounts,
    late=1,
)
