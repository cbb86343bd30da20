"""Figures of wake-up latency: of a run, or of several ways to wait beside each other.

As in M. A. Araujo, UFU 2017, Figures 25 to 30: per iteration, as a histogram to 150 us, and cumulative.
Logarithmic axes: the tails are what matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from dxlrun.channels.cycle import Floats
from dxlrun.output.table import microseconds
from dxlrun_analysis.cycles.latency import ROUGH_NS
from dxlrun_analysis.figures.drawing import (
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    WARNING,
    Caption,
    Columns,
    Drawing,
    draw,
    duration_ticks,
    reference,
)

_ROUGH_US = ROUGH_NS / 1000
_LEAST_US = 1.0
"""Logarithmic axes begin here; earlier wake-ups are drawn here."""
_MOST_POINTS = 4000
_SHARES = (1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999)
_COLOURS = (BLUE, ORANGE, GREEN, PURPLE)


@dataclass(frozen=True, slots=True)
class WakeUps:
    """Wake-ups that belong together."""

    name: str
    """For the legend; empty where there is nothing beside them."""
    late_us: Floats
    """At least one."""
    numbers: Floats
    """Of the iterations."""
    iteration: str = "iteration"
    """What a number is."""


def wake_up_drawings(
    series: Sequence[WakeUps], period_us: float, period: str, summary: str
) -> tuple[Drawing, ...]:
    """Return the three figures; `period` names the duration with which late wake-ups are compared."""
    return (
        _per_iteration(series, period_us, period, summary),
        _histogram(series, summary),
        _cumulative(series, period_us, period, summary),
    )


def _per_iteration(series: Sequence[WakeUps], period_us: float, period: str, summary: str) -> Drawing:
    columns = [Columns(len(one.late_us)) for one in series]
    worst_us = max(float(one.late_us.max()) for one in series)

    def fill(figure: Figure) -> None:
        rows = figure.subplots(len(series), squeeze=False, sharex=True, sharey=True)[:, 0]
        for axes, one, laid, colour in zip(rows, series, columns, _colours(series), strict=True):
            _delays(axes, one, laid, colour)
            _reference_lines(axes, one.late_us, period_us, period, vertical=False)
            axes.set_ylim(_LEAST_US * 0.8, max(worst_us, _ROUGH_US) * 2)
            axes.set_ylabel("wake-up latency" + (f"\n{one.name}" if one.name else ""))
            duration_ticks(axes, "y")
        rows[-1].set_xlabel(series[0].iteration)
        rows[-1].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        rows[-1].xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))

    note = max(columns, key=lambda one: one.width).note("the smallest, the median and the largest delay")
    caption = Caption(
        "latency-iterations",
        "Delay of each iteration",
        f"Wake-up latency over the number of the iteration, logarithmic from 1 us. {summary}",
        f"{summary} Triangles: later than 150 us. What is below 1 us is drawn at 1 us. {note}".strip(),
    )
    return draw(caption, 2.7 if len(series) == 1 else 1.0 + 1.4 * len(series), fill)


def _delays(axes: Axes, one: WakeUps, columns: Columns, colour: str) -> None:
    shown = np.maximum(one.late_us, _LEAST_US)
    axes.set_yscale("log")
    if columns.whole:
        axes.plot(one.numbers, shown, ".", color=colour, markersize=3.5, markeredgewidth=0)
    else:
        x = one.numbers[:: columns.width]
        low, middle, high = columns.bounds(shown)
        axes.fill_between(x, low, high, color=colour, alpha=0.35, linewidth=0, label="smallest to largest")
        axes.plot(x, middle, color=colour, linewidth=0.9, label="median")
        axes.legend(loc="upper right", ncols=2)
    worst = columns.largest(shown)
    rough = worst[shown[worst] > _ROUGH_US]
    axes.plot(one.numbers[rough], shown[rough], "v", color=WARNING, markersize=4, markeredgewidth=0)


def _histogram(series: Sequence[WakeUps], summary: str) -> Drawing:
    first = min(0, *(int(np.floor(one.late_us.min())) for one in series))
    bins = np.arange(first, 152)

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="wake-up latency, us (bins of 1 us)", ylabel="wake-ups in the bin")
        most = 1.0
        for one, colour in zip(series, _colours(series), strict=True):
            counts, edges = np.histogram(one.late_us[one.late_us <= _ROUGH_US], bins=bins)
            most = max(most, float(counts.max(initial=0)))
            if len(series) == 1:
                axes.stairs(counts, edges, fill=True, color=colour, alpha=0.75, baseline=0.5)
            else:
                axes.stairs(np.maximum(counts, 0.5), edges, color=colour, baseline=0.5, label=one.name)
        axes.set_yscale("log")
        axes.set_ylim(0.5, max(2.0, most * 2))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_xlim(first, 151)
        _legend(axes, series)

    rest = " ".join(_beyond(one) for one in series)
    caption = Caption(
        "latency-histogram",
        "Histogram of the delays up to 150 us",
        f"Histogram of the wake-up latency from 0 to 150 us, logarithmic count. {summary} {rest}",
        rest,
    )
    return draw(caption, 2.4, fill)


def _beyond(one: WakeUps) -> str:
    beyond = int(np.count_nonzero(one.late_us > _ROUGH_US))
    of = f" of {one.name}" if one.name else ""
    if not beyond:
        return f"No wake-up{of} is later than 150 us."
    number = len(one.late_us)
    return (
        f"{beyond} of {number} wake-ups{of} ({beyond / number:.3%}) are later than 150 us and "
        "lie beyond the right edge."
    )


def _cumulative(series: Sequence[WakeUps], period_us: float, period: str, summary: str) -> Drawing:
    longest = max(len(one.late_us) for one in series)
    every_us = np.concatenate([one.late_us for one in series])

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(
            xlabel="wake-up latency (logarithmic)", ylabel="share of wake-ups up to it (logit)"
        )
        axes.set(xscale="log", yscale="logit")
        for one, colour in zip(series, _colours(series), strict=True):
            ordered = np.sort(np.maximum(one.late_us, _LEAST_US))
            share = (np.arange(len(ordered)) + 0.5) / len(ordered)
            kept = _kept(len(ordered))
            axes.plot(
                ordered[kept],
                share[kept],
                color=colour,
                linewidth=1.3,
                marker="." if len(series) == 1 else "",
                markersize=2.5,
                label=one.name,
            )
        edge = min(0.05, 0.4 / longest)
        axes.set_ylim(edge, 1 - edge)
        axes.set_xlim(_LEAST_US * 0.9, max(float(every_us.max()), _ROUGH_US) * 1.5)
        axes.yaxis.set_major_locator(FixedLocator([value for value in _SHARES if edge <= value <= 1 - edge]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.6g} %"))
        duration_ticks(axes, "x")
        _reference_lines(axes, every_us, period_us, period, vertical=True)
        _legend(axes, series)

    caption = Caption(
        "latency-cumulative",
        "Cumulative distribution of the delays",
        "Share of the wake-ups that came up to a delay, from 1 us to the largest, on a logit axis that "
        f"stretches both tails. {summary}",
        "A logit axis stretches both ends: 99 %, 99.9 % and 99.99 % are equally far apart, and the last "
        "point is the largest delay.",
    )
    return draw(caption, 2.9, fill)


def _kept(count: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return which ordered samples to draw: all, or the more the nearer to an end, and both tails whole."""
    if count <= _MOST_POINTS:
        return np.arange(count)
    quarter = _MOST_POINTS // 4
    steps = np.geomspace(1, count / 2, quarter).astype(np.intp)
    tails = np.arange(quarter)
    picked = np.concatenate([tails, steps, count - 1 - steps, count - 1 - tails])
    return np.unique(np.clip(picked, 0, count - 1))


def _reference_lines(axes: Axes, late: Floats, period_us: float, period: str, *, vertical: bool) -> None:
    reference(axes, _ROUGH_US, "150 us", vertical=vertical, colour=MUTED)
    if late.max() > period_us / 4:
        words = f"{period}, {microseconds(period_us)}"
        reference(axes, period_us, words, vertical=vertical, colour=WARNING)


def _colours(series: Sequence[WakeUps]) -> Sequence[str]:
    return [_COLOURS[number % len(_COLOURS)] for number in range(len(series))]


def _legend(axes: Axes, series: Sequence[WakeUps]) -> None:
    if len(series) > 1:
        axes.legend(loc="lower right" if axes.get_yscale() == "logit" else "upper right")
