"""The tables of `dxlrun check`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich import box
from rich.table import Table

from dxlrun.compile import Compiled
from dxlrun.compile.reach import degrees
from dxlrun.compile.report import BusRow, CheckReport, ControllerRow, JointRow, MotionRow


def verdict(result: Compiled) -> str:
    """Say in one line how it stands."""
    report = result.report
    active = sum(controller.active for controller in report.controllers)
    warnings = len(result.warnings)
    return (
        f"{report.robot}: good. {len(report.joints)} joints, {active} of {len(report.controllers)} "
        f"controllers active, {report.rate:g} Hz, {warnings or 'no'} warning{'s' * (warnings != 1)}"
    )


def tables(report: CheckReport) -> Iterator[Table]:
    """Yield the tables that have rows."""
    yield _joints(report.joints)
    if report.controllers:
        yield _controllers(report.controllers, len(report.joints))
    yield _buses(report.buses, report.rate)
    if report.motions:
        yield _motions(report.motions, report.duration)


def _table(title: str, left: Sequence[str], right: Sequence[str] = ()) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for name in left:
        table.add_column(name, overflow="fold")
    for name in right:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _joints(rows: Sequence[JointRow]) -> Table:
    table = _table(
        "Joints (deg)",
        ["joint", "bus", "model"],
        ["ID", "reference", "direction", "limits", "reach", "velocity limit"],
    )
    for row in rows:
        table.add_row(
            row.name,
            row.bus,
            row.model,
            str(row.id),
            degrees(row.reference),
            f"{row.direction:+d}",
            _interval(row.lower, row.upper),
            _interval(row.reach_lower, row.reach_upper),
            "none" if row.velocity is None else f"{degrees(row.velocity)}/s",
        )
    return table


def _interval(lower: float, upper: float) -> str:
    return f"{degrees(lower, signed=True)}..{degrees(upper, signed=True)}"


def _controllers(rows: Sequence[ControllerRow], joints: int) -> Table:
    table = _table("Controllers", ["controller", "type", "from", "claims", "of", "active"], ["rate"])
    for row in rows:
        whole = f"all {joints} joints" if len(row.joints) == joints else "\n".join(row.joints)
        table.add_row(
            row.name,
            row.type,
            row.distribution,
            " + ".join(row.command) or "nothing",
            whole if row.command else "",
            "yes" if row.active else "no",
            f"{row.rate:g} Hz",
        )
    return table


def _buses(rows: Sequence[BusRow], rate: float) -> Table:
    table = _table(
        f"Time of one cycle on each bus ({rate:g} Hz leaves {1e3 / rate:.3g} ms)",
        ["bus", "port"],
        [
            "baud rate",
            "servos",
            "bytes out + in",
            "wire",
            "return delay",
            "latency",
            "total",
            "highest rate",
            "of the period",
        ],
    )
    for row in rows:
        table.add_row(
            row.name,
            row.port,
            f"{row.baud_rate}",
            str(row.servos),
            f"{row.request_bytes} + {row.reply_bytes}",
            *(f"{value * 1e3:.1f} ms" for value in (row.wire, row.return_delay, row.latency, row.total)),
            f"{row.highest_rate:.0f} Hz",
            f"{row.share:.0%}",
        )
    return table


def _motions(rows: Sequence[MotionRow], duration: float | None) -> Table:
    ending = "" if duration is None else f" (the run ends at {duration:g} s)"
    table = _table(f"Motions{ending}", ["file", "controller"], ["start", "end", "points", "commands"])
    for row in rows:
        table.add_row(
            row.file,
            row.controller,
            f"{row.start:g} s",
            f"{row.end:g} s",
            str(row.points),
            str(row.commands),
        )
    return table
