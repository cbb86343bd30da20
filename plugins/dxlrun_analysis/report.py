"""Report of `dxlrun analyze` on one log: its parts, the verdict in words, and their tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dxlrun import Log, LogReader, open_log
from dxlrun.tooling.output import Cell, Part, Sentence, Table, Tone, Value, counted
from dxlrun.tooling.plans import ScheduleName
from dxlrun.tooling.records import EventCode
from dxlrun_analysis.cycles.punctuality import on_virtual_time
from dxlrun_analysis.parts.cycles import CAUSES, CONTROLLERS, LATENCY, PERIODS, STEPS
from dxlrun_analysis.parts.history import EVENTS, PAUSES, STEERING, TOPICS, tone_of
from dxlrun_analysis.parts.part import Report, ReportPart
from dxlrun_analysis.parts.servo_parts import BUSES, EXTREMES, JOINTS, SERVOS
from dxlrun_analysis.parts.source_values import SOURCES
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.tally import Tally
from dxlrun_analysis.verdict import judge_run

PARTS: tuple[ReportPart[Any], ...] = (
    ReportPart("log", lambda report: str(report.about.path)),
    ReportPart("robot", lambda report: report.robot),
    ReportPart("verdict", lambda report: report.verdict),
    PERIODS,
    LATENCY,
    STEPS,
    CONTROLLERS,
    CAUSES,
    SERVOS,
    BUSES,
    JOINTS,
    EXTREMES,
    EVENTS,
    STEERING,
    PAUSES,
    TOPICS,
    # Records that the recorder did not receive.
    ReportPart("gaps", lambda report: report.totals.gaps),
    ReportPart("complete", lambda report: report.about.complete),
    ReportPart("damage", lambda report: report.about.damage),
    # True while a run writes the log: the report covers the run so far.
    ReportPart("being_written", lambda report: report.about.being_written),
    SOURCES,
)
"""Parts of the report, in the order of `--json` and of the tables."""


def analyze_log(path: str | Path) -> Report:
    """Analyze the log at a path.

    Raises:
        LogError: The log cannot be read; the message is one sentence.
    """
    return analyze(open_log(path))


def analyze(
    reader: LogReader | Log,
    *watching: Callable[[Log], None],
    exchanges: Callable[[Exchanges], None] = lambda _: None,
) -> Report:
    """Analyze a log slice by slice, and return the report with numbers and verdict.

    The log is decompressed once, and each packet is paired once.

    Args:
        reader: The log, whole or as a reader.
        watching: Functions that also receive each slice.
        exchanges: Function that receives the paired packets of each slice.

    Raises:
        LogError: The log, or a packet in it, cannot be read.
    """
    tally = Tally(exchanges, (part.collector for part in PARTS if part.collector is not None))
    for log in reader.slices():
        for take in (tally.add_slice, *watching):
            take(log)
    totals = tally.totals(reader.about)
    report = Report(reader.about, tally, totals, judge_run(totals), {})
    report.numbers.update((part.name, part.numbers(report)) for part in PARTS)
    return report


# The report as tables


def parts(report: Report) -> tuple[Part, ...]:
    """Return the terminal output of `dxlrun analyze`: the verdict, then the tables."""
    tone: Tone = "good" if report.verdict.good else "warning"
    return (
        *(Sentence(sentence, tone) for sentence in report.verdict.sentences),
        *tables(report).values(),
    )


def tables(report: Report, section: str = "") -> dict[str, Table]:
    """Return the tables of the report that have rows, by name: those of one section of the page, or all."""
    chosen = sorted(
        (part for part in PARTS if part.section == section or not section),
        key=lambda part: not part.first if section else part.late,
    )
    found = ((part.name, part.table_of(report)) for part in chosen)
    return {name: table for name, table in found if table is not None}


# What the log records about the run itself


def began(log: Log, report: Report) -> str:
    """Return the wall-clock time of the first deadline, in UTC, or an empty string if it is unknown."""
    offset_ns = log.header.epoch_offset_ns
    if not offset_ns:
        return ""
    begin_ns = report.totals.periods.begin_ns + offset_ns
    return f"{datetime.fromtimestamp(begin_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def facts(log: Log, report: Report) -> tuple[Table, ...]:
    """Return the tables about the run itself that have rows: robot, buses, real time, software."""
    planned = plan_of(log).by_name
    buses = ((f"bus {name}", _bus(planned.get(name))) for name in log.buses)
    found = (
        Table.facts("Run", _run(log, report)),
        Table.facts("Buses of the plan", buses),
        Table.facts("Real time", _real_time(log)),
        Table.facts("Software", _software(log)),
    )
    return tuple(table for table in found if table.rows)


_SCHEDULES: dict[ScheduleName, str] = {
    "absolute": "",
    "sequential": "sequential: each cycle is due one period after the start of the last, so delays add up",
}


def _run(log: Log, report: Report) -> Iterator[tuple[str, Value]]:
    periods, run = report.totals.periods, log.metadata.get("run", {})
    yield "robot", report.robot
    yield "robot file", run.get("robot_file", "")
    for name, value in run.items():
        if name.startswith("argument "):
            yield name, value
    yield "began", began(log, report)
    yield "lasted", f"{periods.seconds:.1f} s"
    yield "rate", f"{periods.rate_hz:g} Hz, period {log.period_ns / 1e6:g} ms"
    if len(periods.rates_hz) > 1:
        yield "rates", periods.rates
    yield "schedule", _SCHEDULES[plan_of(log).loop.schedule]
    virtual = "virtual: times are computed, not measured"
    yield "clock", virtual if on_virtual_time(log) else run.get("clock", "")
    yield "joints", len(log.joints)
    yield "controllers", ", ".join(controller.name for controller in log.controllers)
    yield "log", log.path.name
    for damage in report.about.damage:
        yield "damage", Cell(damage, "warning")


def _bus(bus: LoggedBus | None) -> str:
    if bus is None or not bus.protocol:
        return "no details in the log"
    models = sorted({servo.model or "?" for servo in bus.servos})
    return (
        f"port {bus.port or '?'}, Protocol {bus.protocol:.1f}, {bus.baud_rate / 1e6:g} Mbit/s, "
        f"{counted(len(bus.servos), 'servo', 'servos')} ({', '.join(models)})"
        + (f", devices {', '.join(device.name for device in bus.devices)}" if bus.devices else "")
    )


def _real_time(log: Log) -> Iterator[tuple[str, Value]]:
    """Yield table rows with the requested real-time settings, and the result of each request."""
    requested = log.metadata.get("scheduler", {})
    if requested:
        locked = ", memory locked" if requested.get("lock_memory") == "true" else ""
        policy = requested.get("policy", "?")
        priority = f", priority {requested.get('priority', '?')}" if policy != "other" else ""
        cores = f", cores {requested['cores']}" if requested.get("cores") else ""
        awake = ", cores kept awake" if requested.get("idle_latency") == "true" else ""
        yield "requested", f"scheduler {policy}{priority}{locked}{cores}{awake}"
    for event in log.events:
        if event.code == EventCode.SCHEDULER:
            tone = tone_of(event.severity)
            process = " to the guardian" if event.source == "guardian" else ""
            yield f"{'granted' if tone == 'plain' else 'not granted'}{process}", Cell(event.text, tone)


def _software(log: Log) -> Iterator[tuple[str, Value]]:
    kernel, versions = log.metadata.get("kernel", {}), dict(log.metadata.get("versions", {}))
    system = " ".join(kernel.get(key, "") for key in ("system", "release", "version", "machine"))
    yield "kernel", system.strip()
    for name in ("dxlrun", "python"):
        yield name, versions.pop(name, "")
    yield "libraries", ", ".join(f"{name} {version}" for name, version in versions.items())
    yield from log.metadata.get("plugins", {}).items()
