"""The comparison of a log with a ledger as tables, for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group
from rich.text import Text

from dxlrun.analysis.ledger.comparison import ComparedBus, Difference, LedgerReport
from dxlrun.analysis.ledger.faults import FaultAnswers, UncausedEvent
from dxlrun.analysis.ledger.lateness import Lateness
from dxlrun.analysis.ledger.overruns import OverrunCauses
from dxlrun.analysis.output.tables import Cell, Column, Table, once
from dxlrun.analysis.output.terminal import Shown
from dxlrun.analysis.verdict import microseconds

MOST_SHOWN = 20
"""Differences and faults in a table; `--json` has all."""
_MOST_BYTES = 16


def render_comparison(report: LedgerReport) -> Group:
    """Return what a terminal shows: sentences, then one table a subject that has something."""
    style = "green" if report.good else "red"
    first, *others = report.sentences
    found = (
        buses_table(report.buses),
        differences_table(report.differences),
        faults_table(report.faults),
        uncaused_table(report.uncaused),
        lateness_table(report.lateness),
        overruns_table(report.causes),
    )
    return Group(
        Text(first, style=style),
        *(Text(sentence) for sentence in others),
        *(Shown(table) for table in found if table.rows),
    )


def buses_table(buses: Sequence[ComparedBus]) -> Table:
    """Return what was compared on each bus."""
    names = ("sent", "bytes", "replies", "bytes", "noise", "differences", "declared", "outside the run")
    rows = tuple(
        (
            Cell(bus.name),
            Cell(str(bus.sent_packets)),
            Cell(str(bus.sent_bytes)),
            Cell(str(bus.replies)),
            Cell(str(bus.received_bytes)),
            Cell(f"{bus.noise_bytes} B", "warning" if bus.noise_bytes else "plain"),
            Cell(str(bus.differences), "error" if bus.differences else "plain"),
            Cell(str(bus.declared), "warning" if bus.declared else "plain"),
            Cell(f"{bus.outside_bytes} B"),
        )
        for bus in buses
    )
    return Table("Buses", (Column("bus", "name"), *(Column(name) for name in names)), rows)


def differences_table(differences: Sequence[Difference]) -> Table:
    """Return where log and ledger differ, the first ones first."""
    columns = (
        Column("at, s"),
        Column("bus", "name"),
        Column("host", "name"),
        Column("only in the log", "text"),
        Column("only in the ledger", "text"),
        Column("declared", "text"),
    )
    rows = tuple(
        (
            Cell(f"{one.seconds:.6f}"),
            Cell(one.bus),
            Cell(one.way),
            Cell(_bytes(one.only_log), "plain" if one.declared else "error"),
            Cell(_bytes(one.only_ledger), "plain" if one.declared else "error"),
            Cell(one.declared or "-"),
        )
        for one in differences[:MOST_SHOWN]
    )
    return Table(_title("Differences", len(differences)), columns, rows)


def faults_table(faults: Sequence[FaultAnswers]) -> Table:
    """Return the injected faults, each beside the first event that may answer it."""
    columns = (
        Column("at, s"),
        Column("bus", "name"),
        Column("fault", "text"),
        Column("after"),
        Column("event of the log", "text"),
    )
    rows = []
    for fault in faults[:MOST_SHOWN]:
        first = fault.answers[0] if fault.answers else None
        rows.append(
            (
                Cell(f"{fault.seconds:.6f}"),
                Cell(fault.bus),
                Cell(fault.text),
                Cell(microseconds(first.after_ms * 1000) if first else "-"),
                Cell(f"{first.name}: {once(f'{first.source}: {first.text}')}" if first else "none within 2 s")
                if not fault.unanswered
                else Cell(f"none of {', '.join(fault.unanswered)} within 2 s", "error"),
            )
        )
    return Table(_title("Injected faults", len(faults)), columns, tuple(rows))


def uncaused_table(events: Sequence[UncausedEvent]) -> Table:
    """Return the events that tell of a fault where the ledger has none."""
    columns = (Column("at, s"), Column("event", "name"), Column("text", "text"))
    rows = tuple(
        (Cell(f"{one.seconds:.6f}"), Cell(one.name, "error"), Cell(once(f"{one.source}: {one.text}")))
        for one in events[:MOST_SHOWN]
    )
    return Table(_title("Events without a cause", len(events)), columns, rows)


def lateness_table(late: Lateness | None) -> Table:
    """Return how late the simulation itself was; empty on virtual time, where nothing is late."""
    columns = (Column("simulation", "name"), Column(""))
    if late is None or not late.max_us:
        return Table("", columns, ())
    rows = (
        ("deliveries", str(late.deliveries)),
        ("late, median", microseconds(late.median_us)),
        ("  99 %", microseconds(late.p99_us)),
        ("  maximum", microseconds(late.max_us)),
        ("later than 1 ms", str(late.rough)),
        ("overruns of the loop", str(late.overruns)),
        ("  beside one later than 1 ms", str(late.overruns_beside)),
    )
    cells = tuple((Cell(name), Cell(value)) for name, value in rows)
    return Table("How late the simulated buses were", columns, cells)


def overruns_table(causes: OverrunCauses | None) -> Table:
    """Return the worst overruns, each split into what was late; empty where there was none."""
    columns = (
        Column("at, s"),
        Column("cause", "name"),
        Column("periods left out"),
        Column("late servos"),
        Column("kept by the kernel"),
        Column("late wake-up"),
        Column("own work beyond the usual"),
    )
    if causes is None or not causes.overruns:
        return Table("", columns, ())
    worst = sorted(
        causes.overruns,
        key=lambda one: one.simulation_us + one.kernel_us + one.wake_up_us + one.own_us,
        reverse=True,
    )
    rows = tuple(
        (
            Cell(f"{one.seconds:.6f}"),
            Cell(one.cause, "warning" if one.cause == "own work" else "plain"),
            Cell(str(one.skipped)),
            Cell(microseconds(one.simulation_us)),
            Cell(microseconds(one.kernel_us)),
            Cell(microseconds(one.wake_up_us)),
            Cell(microseconds(max(0.0, one.own_us))),
        )
        for one in worst[:MOST_SHOWN]
    )
    title = f"Why the loop overran; a cycle usually takes {microseconds(causes.usual_us)}"
    more = "" if len(worst) <= MOST_SHOWN else f"; the worst {MOST_SHOWN} of {len(worst)}, --json has all"
    return Table(title + more, columns, rows)


def _title(what: str, number: int) -> str:
    return what if number <= MOST_SHOWN else f"{what}: the first {MOST_SHOWN} of {number}; --json has all"


def _bytes(data: bytes) -> str:
    if not data:
        return "-"
    more = f" ... {len(data)} bytes" if len(data) > _MOST_BYTES else ""
    return data[:_MOST_BYTES].hex(" ") + more
