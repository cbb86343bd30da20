"""Tables of a latency measurement: the thesis' table, one column per condition; intervals over the blocks."""

from __future__ import annotations

from collections.abc import Callable

from dxlrun.tooling.output import Cell, Column, Part, Sentence, Table, Value, counted, flagged, microseconds
from dxlrun_analysis.latency.statistics import ConfidenceInterval, Figures, Result

_OVER_BLOCKS = {"mean_us": "mean", "median_us": "median", "p99_us": "99 %"}


def parts(result: Result) -> tuple[Part, ...]:
    """Return the terminal output of `dxlrun latency`: its tables and remarks."""
    return (
        statistics_table(result),
        *((blocks_table(result),) if result.blocks > 1 else ()),
        *(Sentence(remark, "warning") for remark in result.remarks),
    )


def line(result: Result) -> str:
    """Return the result of a measurement in one line."""
    each = (
        f"{one.label} {duration(one.mean_us)} late on average, at most {duration(one.max_us)}"
        for one in result.conditions
    )
    return f"{title(result)}: {'; '.join(each)}"


def title(result: Result) -> str:
    """Return the title of a measurement's tables: period, number of blocks and load."""
    load = f"; load: {result.load}" if result.load else "; no load"
    period = f"{result.period_us / 1e3:g} ms" if result.period_us >= 1e3 else f"{result.period_us:g} us"
    return f"Wake-up latency, period {period}, {counted(result.blocks, 'block', 'blocks')}{load}"


def statistics_table(result: Result) -> Table:
    """Return the table with the statistics of each condition over all its wake-ups."""
    rows: tuple[tuple[str, Callable[[Figures], Value]], ...] = (
        ("wake-ups", lambda one: one.wake_ups),
        ("maximum", lambda one: duration(one.max_us)),
        ("mean", lambda one: duration(one.mean_us)),
        ("standard deviation", lambda one: duration(one.deviation_us)),
        ("mode", lambda one: f"{one.mode_us} us"),
        ("median", lambda one: duration(one.median_us)),
        ("99 %", lambda one: duration(one.p99_us)),
        ("99.9 %", lambda one: duration(one.p999_us)),
        ("later than 150 us", lambda one: f"{one.share_over_150_us:.3%}"),
        ("later than 1 ms", lambda one: f"{one.share_over_1_ms:.3%}"),
        ("deadlines skipped", lambda one: flagged(one.skipped)),
        ("polled before each deadline", lambda one: duration(one.polling_us) if one.polling_us else "-"),
        (
            "share of a core used",
            lambda one: "-" if one.processor_share is None else f"{one.processor_share:.1%}",
        ),
    )
    columns = (Column("", "name"), *(Column(one.label) for one in result.conditions))
    cells = ((name, *(value(one) for one in result.conditions)) for name, value in rows)
    return Table.from_rows(title(result), columns, cells)


def blocks_table(result: Result) -> Table:
    """Return the table with mean and 95 % interval over the blocks, and the ratios to the reference."""
    columns = (Column("", "name"), *(Column(one.label) for one in result.conditions))
    rows: list[tuple[Value, ...]] = [
        (words, *(_interval(one.over_blocks[name], duration) for one in result.conditions))
        for name, words in _OVER_BLOCKS.items()
    ]
    rows += [
        (
            f"{_OVER_BLOCKS[name]}, relative to {result.reference}",
            *(
                _interval(one.ratios[name], "{:.3g}".format) if name in one.ratios else "-"
                for one in result.conditions
            ),
        )
        for name in ("mean_us", "p99_us")
        if result.reference
    ]
    return Table.from_rows("Over the blocks, with 95 % confidence intervals (t)", columns, rows)


def duration(us: float) -> str:
    """Return a latency as text, with fractions of a microsecond below 100 us."""
    return f"{us:.2f} us" if us < 100 else microseconds(us)


def _interval(interval: ConfidenceInterval, written: Callable[[float], str]) -> Cell:
    if interval.low is None or interval.high is None:
        return Cell(written(interval.mean))
    # Latencies and ratios are never negative, but the interval of few, scattered blocks can be.
    low, high = written(max(0.0, interval.low)), written(interval.high)
    if low.partition(" ")[2] == high.partition(" ")[2]:
        low = low.partition(" ")[0]
    return Cell(f"{written(interval.mean)} ({low} to {high})")
