"""The tables of `dxlrun bench`."""

from __future__ import annotations

from rich.table import Table

from dxlrun.bench.bus import BusBench
from dxlrun.bench.figures import HostFigures


def bus_table(result: BusBench) -> Table:
    """Return the table of an exchange's cost; ratios are those of the first host of each case."""
    wired = any(case.baud_rate for case in result.cases)
    table = Table(box=None, pad_edge=False)
    for head in ("against", "protocol", "servos", "host"):
        table.add_column(head)
    for head in ("median us", "p99 us", "processor us", "bytes", "wall", "processor", "lost"):
        table.add_column(head, justify="right")
    for head in ("wire us", "late us", "x wire") if wired else ():
        table.add_column(head, justify="right")
    for case in result.cases:
        against = "canned" if case.baud_rate is None else f"{case.baud_rate / 1e6:g} Mbit/s"
        for one in case.hosts:
            table.add_row(
                against,
                f"{case.protocol:.1f}",
                f"{case.servos} x {case.model}",
                one.host,
                f"{one.median_us:.0f}",
                f"{one.p99_us:.0f}",
                f"{one.processor_us:.0f}",
                f"{one.sent_bytes:g} + {one.received_bytes:g}",
                *_ratios(case.hosts[0], one),
                str(one.lost),
                *(_wire(one) if wired else ()),
            )
    return table


def _ratios(first: HostFigures, one: HostFigures) -> tuple[str, str]:
    if one is first:
        return "", ""
    return f"{first.wall_ratio[one.host]:.2f} of it", f"{first.processor_ratio[one.host]:.2f} of it"


def _wire(one: HostFigures) -> tuple[str, str, str]:
    if one.wire is None:
        return "", "", ""
    return f"{one.wire.wire_us:.0f}", f"{one.wire.late_us:.0f}", f"{one.wire.ratio:.2f}"
