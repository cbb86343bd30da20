"""The report on one log: numbers from every part of the analysis, and the verdict in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dxlrun.analysis.bus import BusTraffic, Servo
from dxlrun.analysis.latency import (
    Duration,
    Latency,
    Periods,
    controller_durations,
    durations,
)
from dxlrun.analysis.steering import Act, Pause
from dxlrun.analysis.tally import Tally
from dxlrun.analysis.tracking import Joint, tracking
from dxlrun.analysis.verdict import Verdict, judge
from dxlrun.log.reader import Log, read_log
from dxlrun.run.channels.events import EventGroup


@dataclass(frozen=True, slots=True)
class EventCount:
    """How often one kind of event is in the log."""

    name: str
    severity: int
    count: int
    first: str
    """Source and text of the first one."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that `dxlrun analyze` says about a log."""

    log: str
    robot: str
    verdict: Verdict
    periods: Periods
    latency: Latency | None
    """None where the loop never ran a cycle."""
    steps: tuple[Duration, ...]
    controllers: tuple[Duration, ...]
    servos: tuple[Servo, ...]
    buses: tuple[BusTraffic, ...]
    joints: tuple[Joint, ...]
    events: tuple[EventCount, ...]
    steering: tuple[Act, ...]
    """What was asked from outside, a stream as one."""
    pauses: tuple[Pause, ...]
    gaps: int
    """Records that the recorder did not get."""
    complete: bool
    damage: tuple[str, ...]


def analyze_log(path: str | Path) -> Report:
    """Analyze one log. Raises LogError with one sentence when it cannot be read."""
    return analyze(read_log(path))


def analyze(log: Log) -> Report:
    """Analyze a log that was read. Raises LogError when a packet in it cannot be read."""
    tally = Tally()
    tally.take(log)
    figures = tally.figures(log)
    return Report(
        log=str(log.path),
        robot=log.header.robot,
        verdict=judge(figures),
        periods=figures.periods,
        latency=figures.latency,
        steps=durations(log),
        controllers=controller_durations(log),
        servos=figures.servos,
        buses=figures.buses,
        joints=tracking(log),
        events=_events(figures.events),
        steering=figures.acts,
        pauses=figures.pauses,
        gaps=figures.gaps,
        complete=log.complete,
        damage=log.damage,
    )


def to_json(report: Report) -> bytes:
    """Return a report as JSON, indented; what is not known is null."""
    return msgspec.json.format(msgspec.json.encode(report), indent=2)


def _events(events: Iterable[EventGroup]) -> tuple[EventCount, ...]:
    """Return the events by kind, the grave ones first."""
    counts: Counter[tuple[str, int]] = Counter()
    first: dict[tuple[str, int], EventGroup] = {}
    for said in events:
        key = (said.name, said.severity)
        counts[key] += said.count
        first[key] = min(first.get(key, said), said, key=lambda one: one.t_ns)
    ordered = sorted(counts, key=lambda key: (-key[1], key[0]))
    return tuple(EventCount(*key, counts[key], f"{first[key].source}: {first[key].text}") for key in ordered)
