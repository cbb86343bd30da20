"""The tables of `dxlrun check`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from dxlrun.cli.output.narrow import fitting
from dxlrun.compile import Compiled
from dxlrun.compile.limits import degrees
from dxlrun.compile.report import (
    BusRow,
    CheckReport,
    ControllerRow,
    JointRow,
    MotionRow,
    PolicyRow,
    WayRow,
)
from dxlrun.errors import counted

if TYPE_CHECKING:
    from dxlrun.run.identification import RegisterRow


def verdict(result: Compiled) -> str:
    """Say in one line how it stands."""
    report = result.report
    active = sum(controller.active for controller in report.controllers)
    joints = counted(len(report.joints), "joint", "joints")
    controllers = counted(len(report.controllers), "controller", "controllers")
    warnings = len(result.warnings)
    return (
        f"{report.robot}: good. {joints}, {active} of {controllers} active, {report.rate:g} Hz, "
        f"{warnings or 'no'} warning{'s' * (warnings != 1)}"
    )


def tables(report: CheckReport, width: int) -> Iterator[RenderableType]:
    """Yield the tables that have rows, for a terminal of `width` columns."""
    sheets = [_joints(report.joints)]
    if report.controllers:
        sheets.append(_controllers(report.controllers, len(report.joints)))
    sheets.append(_buses(report.buses, report.rate))
    sheets.append(_ways(report.ways))
    sheets.append(_policies(report.policies))
    if report.motions:
        sheets.append(_motions(report.motions, report.duration))
    for sheet in sheets:
        yield sheet.shown(width)


@dataclass(slots=True)
class _Sheet:
    """Rows under names; a terminal that is too narrow for a table gets a paragraph a row: nothing is cut."""

    title: str
    left: Sequence[str]
    right: Sequence[str] = ()
    rows: list[tuple[str, ...]] = field(default_factory=list)

    def add_row(self, *cells: str) -> None:
        """Add one cell a column."""
        self.rows.append(cells)

    def shown(self, width: int) -> RenderableType:
        """Return what is printed."""
        table = Table(title=self.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
        for name in self.left:
            table.add_column(name, no_wrap=True)
        for name in self.right:
            table.add_column(name, justify="right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(Text(cell) for cell in row))
        return fitting(table, width)


def _joints(rows: Sequence[JointRow]) -> _Sheet:
    efforts = any(row.effort is not None for row in rows)
    table = _Sheet(
        "Joints (deg)",
        ["joint", "bus", "model", "mode"],
        ["ID", "reference", "direction", "limits", "reach", "velocity limit", *["effort limit"] * efforts],
    )
    for row in rows:
        table.add_row(
            row.name,
            row.bus,
            row.model,
            row.mode,
            str(row.id),
            degrees(row.reference),
            f"{row.direction:+d}",
            _interval(row.lower, row.upper) if row.bounded else "none",
            _interval(row.reach_lower, row.reach_upper) if row.bounded else "turns for ever",
            "none" if row.velocity is None else f"{degrees(row.velocity)}/s",
            *["none" if row.effort is None else f"{row.effort:g} {row.effort_unit}".rstrip()] * efforts,
        )
    return table


def _interval(lower: float, upper: float) -> str:
    return f"{degrees(lower, signed=True)}..{degrees(upper, signed=True)}"


def _controllers(rows: Sequence[ControllerRow], joints: int) -> _Sheet:
    table = _Sheet("Controllers", ["controller", "type", "from", "claims", "of", "active"], ["rate"])
    for row in rows:
        everyone = "the joint" if joints == 1 else f"all {joints} joints"
        whole = everyone if len(row.joints) == joints else "\n".join(row.joints)
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


def _buses(rows: Sequence[BusRow], rate: float) -> _Sheet:
    table = _Sheet(
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


def registers(rows: Sequence[RegisterRow], width: int) -> RenderableType:
    """Return the table of declared registers and what the servos hold, for a terminal of `width` columns."""
    table = _Sheet(
        "Registers", ["joint", "item", "area"], ["address", "declared", "found", "a run would"], []
    )
    for row in rows:
        found = "no answer" if row.found is None else str(row.found)
        action = {"nothing": "leave it", "write": "write it", "": "not start"}[row.action]
        table.add_row(row.joint, row.item, row.area, str(row.address), str(row.declared), found, action)
    return table.shown(width)


def _ways(rows: Sequence[WayRow]) -> _Sheet:
    table = _Sheet(
        "Ways to read the servos",
        ["bus", "read by", "asked", "chosen"],
        ["bytes out + in", "total", "highest rate", "waits", "states are old"],
    )
    asked = {"together": "when a cycle begins", "split": "behind the goals"}
    for row in rows:
        table.add_row(
            row.bus,
            row.way,
            asked[row.asked],
            "yes" if row.chosen else "",
            f"{row.request_bytes} + {row.reply_bytes}",
            f"{row.total * 1e3:.2f} ms",
            f"{row.highest_rate:.0f} Hz",
            *(f"{value * 1e3:.2f} ms" for value in (row.wait, row.age)),
        )
    return table


def _policies(rows: Sequence[PolicyRow]) -> _Sheet:
    table = _Sheet("Policies", ["policy", "does", "when the loop is gone"], ["at most"])
    for row in rows:
        table.add_row(row.name, row.does, row.without_loop, f"{row.longest:.1f} s" if row.longest else "")
    return table


def _motions(rows: Sequence[MotionRow], duration: float | None) -> _Sheet:
    ending = "" if duration is None else f" (the run ends at {duration:g} s)"
    table = _Sheet(f"Motions{ending}", ["file", "controller"], ["start", "end", "points", "commands"])
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
