"""A report for the terminal: the verdict first, then tables."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dxlrun.analysis.latency import Duration
from dxlrun.analysis.report import Report
from dxlrun.analysis.verdict import microseconds
from dxlrun.events import Severity


def render(report: Report) -> RenderableType:
    """Return what a terminal shows of a report: sentences, then one table a subject that has something."""
    style = "green" if report.verdict.good else "yellow"
    parts: list[RenderableType] = [Text(sentence, style=style) for sentence in report.verdict.sentences]
    parts.append(Text(""))
    parts.append(_loop(report))
    if report.steps:
        parts.append(_durations("Steps of a cycle", "step", report.steps))
    if report.controllers:
        parts.append(_durations("Controllers", "update of", report.controllers))
    if report.servos:
        parts.append(_servos(report))
    if report.buses:
        parts.append(_buses(report))
    if report.joints:
        parts.append(_joints(report))
    if report.events:
        parts.append(_events(report))
    return Group(*parts)


def _table(title: str, columns: Iterable[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", header_style="")
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    return table


def _loop(report: Report) -> Table:
    account, late = report.periods, report.latency
    table = _table(f"{report.robot}, {account.rate_hz:g} Hz, {account.seconds:.1f} s", ["loop", ""])
    agree = "yes" if account.agree else f"no, {account.missing} missing"
    rows = [
        ("periods elapsed", str(account.elapsed)),
        ("cycles recorded", str(account.records)),
        ("periods skipped", str(account.skipped)),
        ("recorded + skipped = elapsed", agree),
    ]
    if late is not None:
        rows += [
            ("wake-up latency, maximum", microseconds(late.max_us)),
            ("mean", f"{late.mean_us:.2f} us"),
            ("standard deviation", f"{late.deviation_us:.2f} us"),
            ("mode", f"{late.mode_us} us"),
            ("later than 150 us", f"{late.share_over_150_us:.3%}"),
            ("later than 1 ms", f"{late.share_over_1_ms:.3%}"),
            ("later than one period", f"{late.share_over_period:.3%}"),
        ]
    rows += [("records lost", str(report.gaps)), ("log complete", "yes" if report.complete else "no")]
    for row in rows:
        table.add_row(*row)
    return table


def _durations(title: str, what: str, durations: Iterable[Duration]) -> Table:
    table = _table(title, [what, "cycles", "median", "99 %", "maximum"])
    for item in durations:
        times = (microseconds(value) for value in (item.median_us, item.p99_us, item.max_us))
        table.add_row(item.name, str(item.cycles), *times)
    return table


def _servos(report: Report) -> Table:
    columns = ["servo", "joint", "instructions", "asked", "lost", "replies", "errors", "reply", "slowest"]
    table = _table("Servos", columns)
    for servo in report.servos:
        errors = f"{servo.errors} {', '.join(servo.error_names)}".strip()
        table.add_row(
            f"{servo.bus} {servo.servo_id}",
            servo.joint,
            str(servo.instructions),
            str(servo.asked),
            Text(str(servo.lost), style="yellow" if servo.lost else ""),
            str(servo.replies),
            Text(errors, style="yellow" if servo.errors else ""),
            microseconds(servo.reply_median_us),
            microseconds(servo.reply_max_us),
        )
    return table


def _buses(report: Report) -> Table:
    table = _table("Buses", ["bus", "instructions", "broadcasts", "replies", "noise", "out", "in"])
    for bus in report.buses:
        numbers = (bus.instructions, bus.broadcasts, bus.replies)
        sizes = (f"{size} B" for size in (bus.noise_bytes, bus.bytes_out, bus.bytes_in))
        table.add_row(bus.name, *(str(number) for number in numbers), *sizes)
    return table


def _joints(report: Report) -> Table:
    columns = ["joint", "invalid", "oldest", "clamped", "rms error", "worst error"]
    table = _table("Joints (position minus the goal of the cycle before)", columns)
    for joint in report.joints:
        table.add_row(
            joint.name,
            str(joint.invalid),
            f"{joint.oldest_ms:.1f} ms",
            str(joint.clamped),
            _radians(joint.rms_rad),
            _radians(joint.worst_rad),
        )
    return table


def _radians(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f} rad"


def _events(report: Report) -> Table:
    table = Table(title="Events", title_justify="left", title_style="bold", header_style="")
    table.add_column("event")
    table.add_column("count", justify="right")
    table.add_column("first", overflow="fold")
    for event in report.events:
        style = (
            "red"
            if event.severity >= Severity.ERROR
            else "yellow"
            if event.severity >= Severity.WARNING
            else ""
        )
        table.add_row(Text(event.name, style=style), str(event.count), Text(event.first))
    return table
