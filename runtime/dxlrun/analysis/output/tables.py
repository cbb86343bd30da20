"""The tables of a report, as text: a terminal and a page show the same numbers, each in its own way."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from dxlrun.analysis.latency import Duration
from dxlrun.analysis.report import EventCount, Report
from dxlrun.analysis.steering import Act
from dxlrun.analysis.verdict import microseconds
from dxlrun.run.channels.events import Severity

_MOST_ACTS = 100

Tone = Literal["plain", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Column:
    """One column; `detail` is left out where there is no room for it."""

    name: str
    kind: Literal["name", "number", "text"] = "number"
    detail: bool = False


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell; its tone draws the eye to what is not as it should be."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells under columns."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]


def tables(report: Report) -> tuple[Table, ...]:
    """Return every table that has something to say, in the order of the report."""
    found = (
        loop_table(report),
        steps_table(report),
        controllers_table(report),
        servos_table(report),
        buses_table(report),
        joints_table(report),
        steering_table(report.steering),
        events_table(report.events),
    )
    return tuple(table for table in found if table.rows)


def loop_table(report: Report) -> Table:
    """Return the account of the periods and the statistics of the wake-ups."""
    account, late = report.periods, report.latency
    rows: list[tuple[str | Cell, ...]] = [
        ("periods elapsed", str(account.elapsed)),
        ("cycles recorded", str(account.records)),
        ("periods skipped", Cell(str(account.skipped), "warning" if account.skipped else "plain")),
        *(("periods paused", str(count)) for count in [sum(p.periods for p in report.pauses)] if count),
        ("recorded + skipped = elapsed", "yes" if account.agree else f"no, {account.missing} missing"),
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
    rows += [("records lost", str(report.gaps)), ("log complete", "yes" if report.complete else "no")]
    title = f"{report.robot}, {account.rates}, {account.seconds:.1f} s"
    return _table(title, [Column("loop", "name"), Column("")], rows)


def steps_table(report: Report) -> Table:
    """Return how long each step of a cycle took."""
    return _durations("Steps of a cycle", "step", report.steps)


def controllers_table(report: Report) -> Table:
    """Return how long each controller's update took; empty where none took any time, as on virtual time."""
    measured = any(item.cycles for item in report.controllers)
    return _durations("Controllers", "update of", report.controllers if measured else ())


def _durations(title: str, what: str, durations: Iterable[Duration]) -> Table:
    columns = [Column(what, "name"), *(Column(name) for name in ("cycles", "median", "99 %", "maximum"))]
    rows = []
    for item in durations:
        values = (item.median_us, item.p99_us, item.max_us)
        times = (microseconds(value) if item.cycles else "-" for value in values)
        rows.append((item.name, str(item.cycles), *times))
    return _table(title, columns, rows)


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
            str(servo.instructions),
            str(servo.asked),
            Cell(str(servo.lost), "warning" if servo.lost else "plain"),
            str(servo.replies),
            Cell(
                f"{servo.errors} {', '.join(servo.error_names)}".strip(),
                "warning" if servo.errors else "plain",
            ),
            microseconds(servo.reply_median_us),
            microseconds(servo.reply_max_us),
        )
        for servo in report.servos
    ]
    return _table("Servos", columns, rows)


def buses_table(report: Report) -> Table:
    """Return packets and bytes of each bus."""
    names = ("instructions", "broadcasts", "replies", "noise", "out", "in")
    rows: list[tuple[str | Cell, ...]] = []
    for bus in report.buses:
        numbers = (bus.instructions, bus.broadcasts, bus.replies)
        noise = Cell(f"{bus.noise_bytes} B", "warning" if bus.noise_bytes else "plain")
        counts = (str(number) for number in numbers)
        rows.append((bus.name, *counts, noise, f"{bus.bytes_out} B", f"{bus.bytes_in} B"))
    return _table("Buses", [Column("bus", "name"), *(Column(name) for name in names)], rows)


def joints_table(report: Report) -> Table:
    """Return how fresh each joint's states were, and how it followed its reachable trajectory."""
    columns = [
        Column("joint", "name"),
        Column("invalid"),
        Column("oldest", detail=True),
        Column("clamped", detail=True),
        Column("rms"),
        Column("worst"),
        Column("lag"),
        Column("settling"),
        Column("at rest"),
    ]
    rows = [
        (
            joint.name,
            Cell(str(joint.invalid), "warning" if joint.invalid else "plain"),
            f"{joint.oldest_ms:.1f} ms",
            Cell(str(joint.clamped), "warning" if joint.clamped else "plain"),
            _radians(joint.rms_rad),
            _radians(joint.worst_rad),
            _milliseconds(joint.lag_ms),
            _milliseconds(joint.settling_ms),
            _radians(joint.rest_rad),
        )
        for joint in report.joints
    ]
    title = "Joints (errors in rad, of position minus what was reachable)"
    return _table(title, columns, rows)


def _radians(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _milliseconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} ms"


def steering_table(acts: Sequence[Act]) -> Table:
    """Return what was asked of the loop while it ran, and by whom; of very much the first."""
    columns = [
        Column("s"),
        Column("cycle"),
        Column("asked", "text"),
        Column("by", "name"),
        Column("", "text"),
    ]
    rows = [
        (
            f"{act.time_s:.3f}",
            str(act.cycle),
            act.what,
            act.origin,
            Cell(f"refused: {act.refusal}", "warning") if act.refusal else "done",
        )
        for act in acts[:_MOST_ACTS]
    ]
    more = f" (the first {_MOST_ACTS} of {len(acts)})" if len(acts) > _MOST_ACTS else ""
    return _table(f"Steered{more}", columns, rows)


def events_table(events: Iterable[EventCount]) -> Table:
    """Return the kinds of events, the grave ones first."""
    columns = [Column("event", "name"), Column("count"), Column("the first", "text")]
    rows = [
        (Cell(event.name, tone_of(event.severity)), str(event.count), once(event.first)) for event in events
    ]
    return _table("Events", columns, rows)


def tone_of(severity: int) -> Tone:
    """Return the tone in which an event of this severity is shown."""
    if severity >= Severity.ERROR:
        return "error"
    return "warning" if severity >= Severity.WARNING else "plain"


def once(text: str) -> str:
    """Return `source: text` for a cell, without a source that its text repeats; of a traceback the end."""
    source, _, said = text.partition(": ")
    line = said.strip().splitlines()[-1].strip() if said.strip() else ""
    return line if line.startswith(source) else f"{source}: {line}"


def _table(title: str, columns: Iterable[Column], rows: Iterable[Iterable[str | Cell]]) -> Table:
    cells = (tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in row) for row in rows)
    return Table(title, tuple(columns), tuple(cells))
