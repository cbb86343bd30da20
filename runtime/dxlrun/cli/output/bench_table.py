"""The tables of `dxlrun bench`, and how far it has come."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from dxlrun.bench.bus import BusBench
from dxlrun.bench.figures import HostFigures
from dxlrun.bench.rate import RateBench
from dxlrun.plurals import counted

_REFRESH_S = 0.25


@contextmanager
def progress_bar(*, hidden: bool) -> Iterator[Callable[[str, float], None]]:
    """Give what shows words and a share that is done, where a person looks.

    Nothing runs beside the measurement: the bar is drawn between two rounds.
    """
    if hidden or not sys.stderr.isatty():
        yield lambda *_: None
        return
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        drawn = 0.0

        def show(words: str, share: float) -> None:
            nonlocal drawn
            if time.monotonic() - drawn > _REFRESH_S:
                drawn = time.monotonic()
                progress.update(task, description=words, completed=share, refresh=True)

        yield show


def bus_table(result: BusBench) -> Table:
    """Return the table of an exchange's cost; ratios are those of the first host of each case."""
    wired = any(case.baud_rate for case in result.cases)
    table = Table(box=None, pad_edge=False)
    for head in ("against", "protocol", "servos", "host"):
        table.add_column(head)
    for head in ("10 % us", "median us", "99 % us", "processor us", "bytes", "wall", "processor", "lost"):
        table.add_column(head, justify="right")
    for head in ("wire us", "late us", "x wire") if wired else ():
        table.add_column(head, justify="right")
    for case in result.cases:
        against = "canned" if case.baud_rate is None else f"{case.baud_rate / 1e6:g} Mbit/s"
        for one in case.hosts:
            times = (one.p10_us, one.median_us, one.p99_us, one.processor_us)
            table.add_row(
                against,
                f"{case.protocol:.1f}",
                f"{case.servos} x {case.model}",
                one.host,
                *(_number(value, 0) for value in times),
                f"{one.sent_bytes:g} + {one.received_bytes:g}",
                *_ratios(case.hosts[0], one),
                str(one.lost),
                *(_wire(one) if wired else ()),
            )
    return table


def _ratios(first: HostFigures, one: HostFigures) -> tuple[str, str]:
    if one is first:
        return "", ""
    wall, processor = first.wall_ratio[one.host], first.processor_ratio[one.host]
    return f"{_number(wall, 2)} of it", f"{_number(processor, 2)} of it"


def _number(value: float, digits: int) -> str:
    """Write a figure; of a host that never exchanged whole there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _wire(one: HostFigures) -> tuple[str, str, str]:
    if one.wire is None:
        return "", "", ""
    return f"{one.wire.wire_us:.0f}", f"{one.wire.late_us:.0f}", f"{one.wire.ratio:.2f}"


def rate_table(result: RateBench) -> Table:
    """Return the table of the runs at each rate."""
    table = Table(box=None, pad_edge=False)
    for head in ("rate Hz", "cycles", "overruns", "by simulated servos", "median us", "99.9 % us", "kept"):
        table.add_column(head, justify="right")
    for one in result.tries:
        table.add_row(
            f"{one.rate_hz:g}",
            str(one.cycles),
            str(one.overruns),
            str(one.by_simulation),
            f"{one.median_us:.0f}",
            f"{one.p999_us:.0f}",
            "yes" if one.kept else "no",
        )
    return table


def rate_verdict(result: RateBench) -> str:
    """Return what was found in a sentence."""
    computed = f"its buses alone allow {result.computed_hz:g} Hz"
    if result.kept_hz is None:
        return f"{result.robot} kept no rate in {counted(len(result.tries), 'run', 'runs')}; {computed}"
    return f"{result.robot} keeps {result.kept_hz:g} Hz on this machine; {computed}"
