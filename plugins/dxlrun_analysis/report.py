"""The report on one log: numbers from every part of the analysis, the verdict in words, and their tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import msgspec

from dxlrun import Log, LogReader, open_log
from dxlrun.tooling.output import (
    Cell,
    Column,
    Columns,
    Part,
    Sentence,
    Table,
    Tone,
    Value,
    counted,
    flagged,
    microseconds,
)
from dxlrun.tooling.plans import ScheduleName
from dxlrun.tooling.records import EventCode, EventGroup, Severity
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.tables import causes_table
from dxlrun_analysis.conduct.source_values import SourceHistory, SourceValues, sources_table
from dxlrun_analysis.conduct.steering import Act, Pause
from dxlrun_analysis.cycles.latency import (
    Duration,
    Durations,
    Latency,
    Periods,
    on_virtual_time,
)
from dxlrun_analysis.joints.health import Extremes
from dxlrun_analysis.joints.tracking import JointTracking
from dxlrun_analysis.plan import LoggedBus, plan_of
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.traffic import BusTraffic, ServoTraffic
from dxlrun_analysis.tally import Tally
from dxlrun_analysis.verdict import Verdict, judge

T = TypeVar("T")
_MOST_ACTS = 100


class EventCount(msgspec.Struct, frozen=True):
    """How often one kind of event is in the log."""

    name: str
    severity: int
    count: int
    first: str  # Source and text of the first one


class TopicCount(msgspec.Struct, frozen=True):
    """How many messages of one topic of a controller are in the log."""

    name: str
    type: str
    messages: int
    rate: float | None  # Hz; None for fewer than two


class Report(msgspec.Struct, frozen=True):
    """All results of `dxlrun analyze` on a log."""

    log: str
    robot: str
    verdict: Verdict
    periods: Periods
    latency: Latency | None  # None where the loop never ran a cycle
    steps: tuple[Duration, ...]
    controllers: tuple[Duration, ...]
    causes: Causes  # Why cycles were late or too long, and the worst ones
    servos: tuple[ServoTraffic, ...]
    buses: tuple[BusTraffic, ...]
    joints: tuple[JointTracking, ...]
    extremes: tuple[Extremes, ...]  # Highest temperature and lowest voltage of each joint
    events: tuple[EventCount, ...]
    steering: tuple[Act, ...]  # Commands from outside, a stream as one
    pauses: tuple[Pause, ...]
    topics: tuple[TopicCount, ...]
    gaps: int  # Records that the recorder did not get
    complete: bool
    damage: tuple[str, ...]
    being_written: bool = False  # By a run that goes on: the report is about the run so far
    sources: tuple[SourceValues, ...] = ()  # States of devices, sensors and controllers


def analyze_log(path: str | Path) -> Report:
    """Analyze one log. Raises LogError with one sentence when it cannot be read."""
    return analyze(open_log(path))


def analyze(
    reader: LogReader | Log,
    *watching: Callable[[Log], None],
    exchanges: Callable[[Exchanges], None] = lambda _: None,
) -> Report:
    """Analyze a log slice by slice. Raises LogError when it, or a packet in it, cannot be read.

    Each of `watching` gets the slices too, and `exchanges` those of their packets: a log is decompressed
    once, and each packet is paired once.
    """
    tally, durations, topics, sources = Tally(exchanges), Durations(), _Topics(), SourceHistory()
    for part in reader.slices():
        tally.take(part)
        durations.take(part)
        topics.take(part)
        sources.count_cycles(part)
        for take in watching:
            take(part)
    about = reader.about
    totals = tally.totals(about)
    steps, controllers = durations.finish()
    return Report(
        log=str(about.path),
        robot=about.header.robot,
        verdict=judge(totals),
        periods=totals.periods,
        latency=totals.latency,
        steps=steps,
        controllers=controllers,
        causes=totals.causes,
        servos=totals.servos,
        buses=totals.buses,
        joints=totals.tracking,
        extremes=totals.extremes,
        events=_events(totals.events),
        steering=totals.acts,
        pauses=totals.pauses,
        topics=topics.finish(),
        gaps=totals.gaps,
        complete=about.complete,
        damage=about.damage,
        being_written=about.being_written,
        sources=sources.finish(),
    )


class _Topics:
    """Counts the messages of each topic, slice by slice."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[str, int, int, int]] = {}
        """Type, number of messages, when the first and the last was published; in the order of the first."""

    def take(self, log: Log) -> None:
        for one in log.topics.values():
            if one.data:
                _, count, first_ns, _ = self._found.get(one.name, ("", 0, int(one.t_ns[0]), 0))
                self._found[one.name] = one.type.name, count + len(one.data), first_ns, int(one.t_ns[-1])

    def finish(self) -> tuple[TopicCount, ...]:
        return tuple(
            TopicCount(name, kind, count, (count - 1) * 1e9 / (last - first) if last > first else None)
            for name, (kind, count, first, last) in self._found.items()
        )


def _events(events: Iterable[EventGroup]) -> tuple[EventCount, ...]:
    """Return the events by kind, the most severe first."""
    counts: Counter[tuple[str, int]] = Counter()
    first: dict[tuple[str, int], EventGroup] = {}
    for group in events:
        key = (group.name, group.severity)
        counts[key] += group.count
        first[key] = min(first.get(key, group), group, key=lambda one: one.t_ns)
    ordered = sorted(counts, key=lambda key: (-key[1], key[0]))
    return tuple(EventCount(*key, counts[key], f"{first[key].source}: {first[key].text}") for key in ordered)


# The report as tables


def parts(report: Report) -> tuple[Part, ...]:
    """Return what a terminal shows: the verdict first, then the tables."""
    tone: Tone = "good" if report.verdict.good else "warning"
    return (
        *(Sentence(sentence, tone) for sentence in report.verdict.sentences),
        *tables(report).values(),
    )


def tables(report: Report) -> dict[str, Table]:
    """Return every table that has rows by its name, in the order of the report."""
    mm = ", of linear joints in mm" if any(joint.unit.suffix for joint in report.joints) else ""
    acts = report.steering
    more = f" (the first {_MOST_ACTS} of {len(acts)})" if len(acts) > _MOST_ACTS else ""
    errors = f"Joints (errors in deg{mm}, of position minus what was reachable)"
    # on virtual time no update takes any
    controllers = report.controllers if any(item.cycles for item in report.controllers) else ()
    found = {
        "loop": _loop(report),
        "steps": Table.listing(
            "Steps of a cycle", [(Column("step", "name"), "name"), *_DURATION], report.steps
        ),
        "controllers": Table.listing(
            "Controllers", [(Column("update of", "name"), "name"), *_DURATION], controllers
        ),
        "causes": causes_table(report.causes),
        "servos": Table.listing("Servos", _SERVO, report.servos),
        "buses": Table.listing("Buses", _BUS, report.buses),
        "joints": Table.listing(errors, _JOINT, report.joints),
        "sources": sources_table(report.sources),
        "topics": Table.listing("Topics", _TOPIC, report.topics),
        "steering": Table.listing(f"Steered{more}", _ACT, acts[:_MOST_ACTS]),
        "events": Table.listing("Events", _EVENT, report.events),
    }
    return {name: table for name, table in found.items() if table.rows}


def _loop(report: Report) -> Table:
    """Return the account of the periods and the statistics of the wake-ups."""
    periods, late = report.periods, report.latency
    paused = sum(pause.periods for pause in report.pauses)
    rows: list[tuple[str, Value]] = [
        ("periods elapsed", periods.elapsed),
        ("cycles recorded", periods.records),
        ("periods skipped", flagged(periods.skipped)),
        *([("periods paused", paused)] if paused else []),
        ("recorded + skipped = elapsed", "yes" if periods.agree else f"no, {periods.missing} missing"),
    ]
    if late is not None:
        rows += [
            ("wake-up latency, maximum", microseconds(late.max_us)),
            ("  99.9 %", microseconds(late.p999_us)),
            ("  99 %", microseconds(late.p99_us)),
            ("  median", f"{late.median_us:.1f} us"),
            ("  mean", f"{late.mean_us:.2f} us"),
            ("  standard deviation", f"{late.deviation_us:.2f} us"),
            ("  mode", f"{late.mode_us} us"),
            ("  later than 150 us", f"{late.share_over_150_us:.3%}"),
            ("  later than 1 ms", f"{late.share_over_1_ms:.3%}"),
            ("  later than one period", f"{late.share_over_period:.3%}"),
        ]
    unfinished = "no, a run is writing it" if report.being_written else "no"
    rows += [("records lost", report.gaps), ("log complete", "yes" if report.complete else unfinished)]
    title = f"{report.robot}, {periods.rates}, {periods.seconds:.1f} s"
    return Table.of(title, [Column("loop", "name"), Column("")], rows)


def _time(name: str) -> Callable[[Duration], Value]:
    return lambda item: microseconds(getattr(item, name)) if item.cycles else "-"


def _error(name: str) -> Callable[[JointTracking], Value]:
    """Return an error in deg, or with its unit that of a linear joint."""

    def error(joint: JointTracking) -> Value:
        value = getattr(joint, name)
        if value is None or not joint.unit.suffix:
            return value and math.degrees(value)
        return Cell(joint.unit.text(value))

    return error


_DURATION: Columns[Duration] = (
    (Column("cycles"), "cycles"),
    (Column("median"), _time("median_us")),
    (Column("99 %"), _time("p99_us")),
    (Column("maximum"), _time("max_us")),
)
_SERVO: Columns[ServoTraffic] = (
    (Column("servo", "name"), lambda servo: f"{servo.bus} {servo.servo_id}"),
    (Column("joint", "name"), lambda servo: servo.joint or "-"),
    (Column("instructions", detail=True), "instructions"),
    (Column("asked"), "asked"),
    (Column("lost"), lambda servo: flagged(servo.lost)),
    (Column("replies", detail=True), "replies"),
    (
        Column("errors"),
        lambda servo: flagged(servo.errors, f"{servo.errors} {', '.join(servo.error_names)}".strip()),
    ),
    (Column("reply"), lambda servo: microseconds(servo.reply_median_us)),
    (Column("slowest"), lambda servo: microseconds(servo.reply_max_us)),
)
_BUS: Columns[BusTraffic] = (
    (Column("bus", "name"), "name"),
    (Column("instructions"), "instructions"),
    (Column("broadcasts"), "broadcasts"),
    (Column("replies"), "replies"),
    (Column("noise"), lambda bus: flagged(bus.noise_bytes, f"{bus.noise_bytes} B")),
    (Column("out", form="{} B"), "bytes_out"),
    (Column("in", form="{} B"), "bytes_in"),
)
_JOINT: Columns[JointTracking] = (
    (Column("joint", "name"), "name"),
    (Column("invalid"), lambda joint: flagged(joint.invalid)),
    (Column("oldest", form="{:.1f} ms", detail=True), "oldest_ms"),
    (Column("clamped", detail=True), lambda joint: flagged(joint.clamped)),
    (Column("rms", form="{:.2f}", missing="-"), _error("rms_rad")),
    (Column("worst", form="{:.2f}", missing="-"), _error("worst_rad")),
    (Column("lag", form="{:.0f} ms", missing="-"), "lag_ms"),
    (Column("delay", form="{:.0f} ms", missing="-", detail=True), "delay_ms"),
    (Column("settling", form="{:.0f} ms", missing="-"), "settling_ms"),
    (Column("at rest", form="{:.2f}", missing="-"), _error("rest_rad")),
)
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


def tone_of(severity: int) -> Tone:
    """Return the tone in which an event of this severity is shown."""
    if severity >= Severity.ERROR:
        return "error"
    return "warning" if severity >= Severity.WARNING else "plain"


def _once(text: str) -> str:
    """Return `source: text` for a cell, without a source that its text repeats; of a traceback the end."""
    source, _, rest = text.partition(": ")
    line = rest.strip().splitlines()[-1].strip() if rest.strip() else ""
    return line if line.startswith(source) else f"{source}: {line}"


# What the log records about the run itself


def began(log: Log, report: Report) -> str:
    """Return the wall time of the first deadline, in UTC; empty where none is known."""
    offset_ns = log.header.epoch_offset_ns
    if not offset_ns:
        return ""
    return f"{datetime.fromtimestamp((report.periods.begin_ns + offset_ns) / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def facts(log: Log, report: Report) -> tuple[Table, ...]:
    """Return the tables of the run that have rows: robot, buses, real time, software."""
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
    "sequential": "sequential: a cycle is due one period after the one before began, so delays add up",
}


def _run(log: Log, report: Report) -> Iterator[tuple[str, Value]]:
    periods, run = report.periods, log.metadata.get("run", {})
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
    for damage in report.damage:
        yield "damage", Cell(damage, "warning")


def _bus(bus: LoggedBus | None) -> str:
    if bus is None or not bus.protocol:
        return "nothing more is known"
    models = sorted({servo.model or "?" for servo in bus.servos})
    return (
        f"port {bus.port or '?'}, Protocol {bus.protocol:.1f}, {bus.baud_rate / 1e6:g} Mbit/s, "
        f"{counted(len(bus.servos), 'servo', 'servos')} ({', '.join(models)})"
        + (f", devices {', '.join(device.name for device in bus.devices)}" if bus.devices else "")
    )


def _real_time(log: Log) -> Iterator[tuple[str, Value]]:
    """Yield the real-time settings that the robot file requests, and which of them were granted."""
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
