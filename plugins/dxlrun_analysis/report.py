"""The report on one log: numbers from every part of the analysis, the verdict in words, and their tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from dxlrun.channels.events import EventCode, EventGroup, Severity
from dxlrun.errors import counted
from dxlrun.log.reader import Log, LogReader, open_log
from dxlrun.output.table import (
    Cell,
    Column,
    Part,
    Sentence,
    Table,
    Tone,
    Value,
    flagged,
    microseconds,
    numbers,
)
from dxlrun.plan.loop_plan import ScheduleName
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.causes.tables import causes_table
from dxlrun_analysis.conduct.steering import Act, Pause
from dxlrun_analysis.cycles.latency import (
    Duration,
    Durations,
    Latency,
    Periods,
    on_virtual_time,
)
from dxlrun_analysis.joints.tracking import JointTracking
from dxlrun_analysis.joints.trends import Trend
from dxlrun_analysis.plan import LoggedBus, plan_of
from dxlrun_analysis.servos.traffic import BusTraffic, ServoTraffic
from dxlrun_analysis.tally import Tally
from dxlrun_analysis.verdict import Verdict, judge

_MOST_ACTS = 100


@dataclass(frozen=True, slots=True)
class EventCount:
    """How often one kind of event is in the log."""

    name: str
    severity: int
    count: int
    first: str
    """Source and text of the first one."""


@dataclass(frozen=True, slots=True)
class TopicCount:
    """How many messages of one topic of a controller are in the log."""

    name: str
    type: str
    messages: int
    rate: float | None
    """Hz; None for fewer than two."""


@dataclass(frozen=True, slots=True)
class Report:
    """All results of `dxlrun analyze` on a log."""

    log: str
    robot: str
    verdict: Verdict
    periods: Periods
    latency: Latency | None
    """None where the loop never ran a cycle."""
    steps: tuple[Duration, ...]
    controllers: tuple[Duration, ...]
    causes: Causes
    """Why cycles were late or too long, and the worst ones."""
    servos: tuple[ServoTraffic, ...]
    buses: tuple[BusTraffic, ...]
    joints: tuple[JointTracking, ...]
    trends: tuple[Trend, ...]
    """Temperature, voltage and load of each joint over the run."""
    events: tuple[EventCount, ...]
    steering: tuple[Act, ...]
    """Commands from outside, a stream as one."""
    pauses: tuple[Pause, ...]
    topics: tuple[TopicCount, ...]
    gaps: int
    """Records that the recorder did not get."""
    complete: bool
    damage: tuple[str, ...]


def analyze_log(path: str | Path) -> Report:
    """Analyze one log. Raises LogError with one sentence when it cannot be read."""
    return analyze(open_log(path))


def analyze(reader: LogReader | Log, *watching: Callable[[Log], None]) -> Report:
    """Analyze a log slice by slice. Raises LogError when it, or a packet in it, cannot be read.

    Each of `watching` gets the slices too: a log is decompressed once.
    """
    tally, durations, topics = Tally(), Durations(), TopicCounts()
    for part in reader.slices():
        tally.take(part)
        durations.take(part)
        topics.take(part)
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
        trends=totals.trends,
        events=_events(totals.events),
        steering=totals.acts,
        pauses=totals.pauses,
        topics=topics.finish(),
        gaps=totals.gaps,
        complete=about.complete,
        damage=about.damage,
    )


class TopicCounts:
    """Counts the messages of each topic, slice by slice."""

    __slots__ = ("_counts", "_spans_ns", "_types")

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._types: dict[str, str] = {}
        self._spans_ns: dict[str, tuple[int, int]] = {}
        """When the first and the last message was published."""

    def take(self, log: Log) -> None:
        """Count the messages of the next slice."""
        for one in log.topics.values():
            if one.data:
                self._counts[one.name] += len(one.data)
                self._types[one.name] = one.type.name
                first, _ = self._spans_ns.get(one.name, (int(one.t_ns[0]), 0))
                self._spans_ns[one.name] = first, int(one.t_ns[-1])

    def finish(self) -> tuple[TopicCount, ...]:
        """Return the topics that had messages, in the order of the first of each."""
        return tuple(
            TopicCount(name, self._types[name], count, self._rate(name))
            for name, count in self._counts.items()
        )

    def _rate(self, name: str) -> float | None:
        first, last = self._spans_ns[name]
        return (self._counts[name] - 1) * 1e9 / (last - first) if last > first else None


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
    return (*(Sentence(sentence, tone) for sentence in report.verdict.sentences), *tables(report))


def tables(report: Report) -> tuple[Table, ...]:
    """Return every table that has rows, in the order of the report."""
    found = (
        loop_table(report),
        steps_table(report),
        controllers_table(report),
        causes_table(report.causes),
        servos_table(report),
        buses_table(report),
        joints_table(report),
        topics_table(report.topics),
        steering_table(report.steering),
        events_table(report.events),
    )
    return tuple(table for table in found if table.rows)


def loop_table(report: Report) -> Table:
    """Return the account of the periods and the statistics of the wake-ups."""
    periods, late = report.periods, report.latency
    rows: list[tuple[str, Value]] = [
        ("periods elapsed", periods.elapsed),
        ("cycles recorded", periods.records),
        ("periods skipped", flagged(periods.skipped)),
        *(("periods paused", count) for count in [sum(p.periods for p in report.pauses)] if count),
        ("recorded + skipped = elapsed", "yes" if periods.agree else f"no, {periods.missing} missing"),
    ]
    if late is not None:
        rows += [
            ("wake-up latency, maximum", microseconds(late.max_us)),
            ("  mean", f"{late.mean_us:.2f} us"),
            ("  standard deviation", f"{late.deviation_us:.2f} us"),
            ("  mode", f"{late.mode_us} us"),
            ("  later than 150 us", f"{late.share_over_150_us:.3%}"),
            ("  later than 1 ms", f"{late.share_over_1_ms:.3%}"),
            ("  later than one period", f"{late.share_over_period:.3%}"),
        ]
    rows += [("records lost", report.gaps), ("log complete", "yes" if report.complete else "no")]
    title = f"{report.robot}, {periods.rates}, {periods.seconds:.1f} s"
    return Table.of(title, [Column("loop", "name"), Column("")], rows)


def steps_table(report: Report) -> Table:
    """Return how long each step of a cycle took."""
    return _durations("Steps of a cycle", "step", report.steps)


def controllers_table(report: Report) -> Table:
    """Return how long each controller's update took; empty where none took any time, as on virtual time."""
    measured = any(item.cycles for item in report.controllers)
    return _durations("Controllers", "update of", report.controllers if measured else ())


def _durations(title: str, what: str, durations: Iterable[Duration]) -> Table:
    columns = [Column(what, "name"), *numbers("cycles", "median", "99 %", "maximum")]
    rows: list[tuple[Value, ...]] = []
    for item in durations:
        values = (item.median_us, item.p99_us, item.max_us)
        times = (microseconds(value) if item.cycles else "-" for value in values)
        rows.append((item.name, item.cycles, *times))
    return Table.of(title, columns, rows)


def servos_table(report: Report) -> Table:
    """Return packets and errors of each servo."""
    columns = [
        Column("servo", "name"),
        Column("joint", "name"),
        Column("instructions", detail=True),
        Column("asked"),
        Column("lost"),
        Column("replies", detail=True),
        Column("errors"),
        Column("reply"),
        Column("slowest"),
    ]
    rows = [
        (
            f"{servo.bus} {servo.servo_id}",
            servo.joint or "-",
            servo.instructions,
            servo.asked,
            flagged(servo.lost),
            servo.replies,
            flagged(servo.errors, f"{servo.errors} {', '.join(servo.error_names)}".strip()),
            microseconds(servo.reply_median_us),
            microseconds(servo.reply_max_us),
        )
        for servo in report.servos
    ]
    return Table.of("Servos", columns, rows)


def buses_table(report: Report) -> Table:
    """Return packets and bytes of each bus."""
    columns = [
        Column("bus", "name"),
        *numbers("instructions", "broadcasts", "replies", "noise"),
        Column("out", form="{} B"),
        Column("in", form="{} B"),
    ]
    rows = [
        (
            bus.name,
            bus.instructions,
            bus.broadcasts,
            bus.replies,
            flagged(bus.noise_bytes, f"{bus.noise_bytes} B"),
            bus.bytes_out,
            bus.bytes_in,
        )
        for bus in report.buses
    ]
    return Table.of("Buses", columns, rows)


def joints_table(report: Report) -> Table:
    """Return how fresh each joint's states were, and how it followed its reachable trajectory."""
    columns = [
        Column("joint", "name"),
        Column("invalid"),
        Column("oldest", form="{:.1f} ms", detail=True),
        Column("clamped", detail=True),
        Column("rms", form="{:.2f}", missing="-"),
        Column("worst", form="{:.2f}", missing="-"),
        Column("lag", form="{:.0f} ms", missing="-"),
        Column("delay", form="{:.0f} ms", missing="-", detail=True),
        Column("settling", form="{:.0f} ms", missing="-"),
        Column("at rest", form="{:.2f}", missing="-"),
    ]
    rows = [
        (
            joint.name,
            flagged(joint.invalid),
            joint.oldest_ms,
            flagged(joint.clamped),
            _error(joint, joint.rms_rad),
            _error(joint, joint.worst_rad),
            joint.lag_ms,
            joint.delay_ms,
            joint.settling_ms,
            _error(joint, joint.rest_rad),
        )
        for joint in report.joints
    ]
    mm = ", of linear joints in mm" if any(joint.unit == "m" for joint in report.joints) else ""
    return Table.of(f"Joints (errors in deg{mm}, of position minus what was reachable)", columns, rows)


def _error(joint: JointTracking, error: float | None) -> Cell | float | None:
    """Return an error in deg, or with its unit that of a linear joint."""
    if error is None or joint.unit == "rad":
        return error and math.degrees(error)
    return Cell(f"{error * 1e3:.2f} mm")


def topics_table(topics: Sequence[TopicCount]) -> Table:
    """Return the topics of the controllers and of the runtime, with what is in the log of them."""
    columns = [
        Column("topic", "name"),
        Column("type", "text"),
        Column("messages"),
        Column("rate", form="{:.4g} Hz", missing="-"),
    ]
    rows = [(one.name, one.type, one.messages, one.rate) for one in topics]
    return Table.of("Topics", columns, rows)


def steering_table(acts: Sequence[Act]) -> Table:
    """Return the commands from outside with their origin; of very many the first."""
    columns = [
        Column("s", form="{:.3f}"),
        Column("cycle"),
        Column("asked", "text"),
        Column("by", "name"),
        Column("", "text"),
    ]
    rows = [
        (
            act.time_s,
            act.cycle,
            act.what,
            act.origin,
            Cell(f"refused: {act.refusal}", "warning") if act.refusal else "done",
        )
        for act in acts[:_MOST_ACTS]
    ]
    more = f" (the first {_MOST_ACTS} of {len(acts)})" if len(acts) > _MOST_ACTS else ""
    return Table.of(f"Steered{more}", columns, rows)


def events_table(events: Iterable[EventCount]) -> Table:
    """Return the kinds of events, the most severe first."""
    columns = [Column("event", "name"), Column("count"), Column("the first", "text")]
    rows = [(Cell(event.name, tone_of(event.severity)), event.count, once(event.first)) for event in events]
    return Table.of("Events", columns, rows)


def tone_of(severity: int) -> Tone:
    """Return the tone in which an event of this severity is shown."""
    if severity >= Severity.ERROR:
        return "error"
    return "warning" if severity >= Severity.WARNING else "plain"


def once(text: str) -> str:
    """Return `source: text` for a cell, without a source that its text repeats; of a traceback the end."""
    source, _, rest = text.partition(": ")
    line = rest.strip().splitlines()[-1].strip() if rest.strip() else ""
    return line if line.startswith(source) else f"{source}: {line}"


# What the log records about the run itself


def began(log: Log) -> str:
    """Return the wall time of the first cycle, or of the first event, in UTC; empty where none is known."""
    times = log.cycles["scheduled_ns"][:1].tolist() or [event.t_ns for event in log.events[:1]]
    if not times or not log.header.epoch_offset_ns:
        return ""
    moment = datetime.fromtimestamp((times[0] + log.header.epoch_offset_ns) / 1e9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def facts(log: Log, report: Report) -> tuple[Table, ...]:
    """Return the tables of the run that have rows: robot, buses, real time, software."""
    found = (_run(log, report), _buses(log), _real_time(log), _software(log))
    return tuple(table for table in found if table.rows)


_SCHEDULES: dict[ScheduleName, str] = {
    "absolute": "",
    "sequential": "sequential: a cycle is due one period after the one before began, so delays add up",
}


def _run(log: Log, report: Report) -> Table:
    periods, run = report.periods, log.metadata.get("run", {})
    clock = "virtual: times are computed, not measured" if on_virtual_time(log) else run.get("clock", "")
    rows: list[tuple[str, Value]] = [
        ("robot", report.robot),
        ("robot file", run.get("robot_file", "")),
        *((f"argument {name[9:]}", value) for name, value in run.items() if name.startswith("argument ")),
        ("began", began(log)),
        ("lasted", f"{periods.seconds:.1f} s"),
        ("rate", f"{periods.rate_hz:g} Hz, period {log.period_ns / 1e6:g} ms"),
        *(("rates", periods.rates) for _ in periods.rates_hz[1:2]),
        ("schedule", _SCHEDULES[plan_of(log).loop.schedule]),
        ("clock", clock),
        ("joints", len(log.joints)),
        ("controllers", ", ".join(controller.name for controller in log.controllers)),
        ("log", log.path.name),
        *(("damage", Cell(damage, "warning")) for damage in report.damage),
    ]
    return Table.facts("Run", rows)


def _buses(log: Log) -> Table:
    planned = plan_of(log).by_name
    return Table.facts("Buses of the plan", ((f"bus {name}", _bus(planned.get(name))) for name in log.buses))


def _bus(bus: LoggedBus | None) -> str:
    if bus is None or not bus.protocol:
        return "nothing more is known"
    models = sorted({servo.model or "?" for servo in bus.servos})
    return (
        f"port {bus.port or '?'}, Protocol {bus.protocol:.1f}, {bus.baud_rate / 1e6:g} Mbit/s, "
        f"{counted(len(bus.servos), 'servo', 'servos')} ({', '.join(models)})"
        + (f", devices {', '.join(device.name for device in bus.devices)}" if bus.devices else "")
    )


def _real_time(log: Log) -> Table:
    """Return the real-time settings that the robot file requests, and which of them were granted."""
    requested = log.metadata.get("scheduler", {})
    rows: list[tuple[str, Value]] = []
    if requested:
        locked = ", memory locked" if requested.get("lock_memory") == "true" else ""
        policy = requested.get("policy", "?")
        priority = f", priority {requested.get('priority', '?')}" if policy != "other" else ""
        cores = f", cores {requested['cores']}" if requested.get("cores") else ""
        awake = ", cores kept awake" if requested.get("idle_latency") == "true" else ""
        rows.append(("requested", f"scheduler {policy}{priority}{locked}{cores}{awake}"))
    for event in log.events:
        if event.code == EventCode.SCHEDULER:
            tone = tone_of(event.severity)
            process = " to the guardian" if event.source == "guardian" else ""
            rows.append(
                (f"{'granted' if tone == 'plain' else 'not granted'}{process}", Cell(event.text, tone))
            )
    return Table.facts("Real time", rows)


def _software(log: Log) -> Table:
    kernel = log.metadata.get("kernel", {})
    system = " ".join(kernel.get(key, "") for key in ("system", "release", "version", "machine"))
    versions = log.metadata.get("versions", {})
    first = [name for name in ("dxlrun", "python") if name in versions]
    others = [name for name in versions if name not in first]
    rows = [
        ("kernel", system.strip()),
        *((name, versions[name]) for name in first),
        ("libraries", ", ".join(f"{name} {versions[name]}" for name in others)),
        *log.metadata.get("plugins", {}).items(),
    ]
    return Table.facts("Software", rows)
