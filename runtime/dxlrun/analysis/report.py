"""The report on one log: numbers from every part of the analysis, and the verdict in words."""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dxlrun.analysis.bus import BusTraffic, Servo, traffic
from dxlrun.analysis.latency import (
    Duration,
    Latency,
    Periods,
    controller_durations,
    durations,
    latency,
    periods,
)
from dxlrun.analysis.steering import Act, Pause, acts, pauses
from dxlrun.analysis.tracking import Joint, tracking
from dxlrun.analysis.verdict import Timing, Verdict, verdict
from dxlrun.events import EventCode
from dxlrun.recording.reader import Log, read_log
from dxlrun.recording.schemas import SUMMARY_NAME


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
    servos, buses = traffic(log)
    timing = Timing(periods(log), latency(log), durations(log), acts(log), pauses(log))
    lost = _gaps(log)
    return Report(
        log=str(log.path),
        robot=log.header.robot,
        verdict=verdict(timing, servos, log, lost),
        periods=timing.periods,
        latency=timing.latency,
        steps=tuple(timing.steps),
        controllers=controller_durations(log),
        servos=servos,
        buses=buses,
        joints=tracking(log),
        events=_events(log),
        steering=tuple(timing.acts),
        pauses=tuple(timing.pauses),
        gaps=lost,
        complete=log.complete,
        damage=log.damage,
    )


def to_json(report: Report) -> bytes:
    """Return a report as JSON, indented; what is not known is null."""
    return msgspec.json.format(msgspec.json.encode(report), indent=2)


def _gaps(log: Log) -> int:
    """Return the records that were lost before the recorder; from the events where the log has no end."""
    with suppress(KeyError, ValueError):
        return int(log.metadata[SUMMARY_NAME]["gaps"])
    texts = (event.text for event in log.events if event.code == EventCode.RECORDER_GAP)
    return sum(int(match[0]) for match in (re.match(r"\d+", text) for text in texts) if match)


def _events(log: Log) -> tuple[EventCount, ...]:
    counts = Counter((event.name, int(event.severity)) for event in log.events)
    first: dict[tuple[str, int], str] = {}
    for event in log.events:
        first.setdefault((event.name, int(event.severity)), f"{event.source}: {event.text}")
    ordered = sorted(counts, key=lambda key: (-key[1], key[0]))
    return tuple(
        EventCount(name, severity, counts[name, severity], first[name, severity])
        for name, severity in ordered
    )
