"""Plots of wake-up latency, of a run or of several conditions: over time, as a histogram, cumulative.

They correspond to M. A. Araujo, UFU 2017, Figures 25 to 30: per iteration, as a histogram to 150 us, and
cumulative. The axes are logarithmic because the tails matter most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from bokeh.models import Range1d
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_analysis.cycles.punctuality import LATE_BINS_US, ROUGH_NS
from dxlrun_analysis.page.canvas import ERROR, WARNING, Canvas, Plot, PlotLine
from dxlrun_analysis.page.run_curves import Curves

ROUGH_US = ROUGH_NS // 1000
_SHARES = (1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999)


class WakeUps(NamedTuple):
    """Wake-ups of a run or of one measured condition: their line in the plots, and their distribution."""

    line: PlotLine  # Line of their lateness in us
    bins: NDArray[np.int64]  # Output of `late_bins`


def wake_up_plots(
    canvas: Canvas, curves: Curves, series: Sequence[WakeUps], summary: str
) -> tuple[Plot, ...]:
    """Return the plots of wake-up latency: over time (caption `summary`), histogram, cumulative."""
    lines = [one.line for one in series]
    return _lateness(canvas, curves, lines, summary), _histogram(canvas, series), _cumulative(canvas, series)


def _lateness(canvas: Canvas, curves: Curves, lines: Sequence[PlotLine], summary: str) -> Plot:
    plot = canvas.timed("lateness", "Wake-up latency", "wake-up latency", 230, log=True)
    canvas.curves(plot, curves, lines, "us", 0.0)
    marks = PlotLine("rough", "later than 150 us", WARNING), PlotLine("skipped", "periods skipped", ERROR)
    canvas.marks(plot, curves, marks)
    plot.reference(ROUGH_US, "width")
    worst = max(float(np.nanmax(curves.high(line.curve))) for line in lines)
    plot.model.y_range = Range1d(0.6, 2 * max(worst, ROUGH_US))
    plot.durations("y")
    plot.text = f"{summary} The dashed line is at 150 us. Latencies below 1 us are drawn at 1 us."
    return plot


def _histogram(canvas: Canvas, series: Sequence[WakeUps]) -> Plot:
    axes = ("wake-up latency, us (bins of 1 us)", "wake-ups in the bin")
    plot = canvas.free("latency-histogram", "Histogram of the wake-ups up to 150 us", axes, 210, log="y")
    most, notes = 1, []
    for line, bins in series:
        full = np.flatnonzero(bins[: ROUGH_US + 1])
        drawn = plot.model.quad(
            left=full,
            right=full + 1,
            bottom=0.5,
            top=bins[full],
            color=line.colour,
            line_width=0,
            fill_alpha=1.0 if len(series) == 1 else 0.5,
        )
        most = max(most, int(bins[full].max(initial=0)))
        of = ""
        if len(series) > 1:
            plot.named(line.name, drawn)
            of = f" of {line.name}"
        count, beyond = int(bins.sum()), int(bins[ROUGH_US + 1 :].sum())
        notes.append(
            f"{beyond} of {count} wake-ups{of} ({beyond / count:.3%}) are later than 150 us, beyond the "
            "right edge."
            if beyond
            else f"No wake-up{of} is later than 150 us."
        )
    plot.model.x_range = Range1d(-1, ROUGH_US + 2)
    plot.model.y_range = Range1d(0.5, 2.0 * most)
    counts = [10**exponent for exponent in range(len(str(most)) + 1)]
    plot.ticks("y", {one: f"{one:,}" for one in counts})
    plot.text = " ".join(notes)
    return plot


def _cumulative(canvas: Canvas, series: Sequence[WakeUps]) -> Plot:
    axes = ("wake-up latency (logarithmic)", "cumulative share of wake-ups (logit)")
    plot = canvas.free("latency-cumulative", "Cumulative distribution of the wake-ups", axes, 260, log="x")
    latest, longest = ROUGH_US, 0
    for line, bins in series:
        late = np.flatnonzero(bins)
        up_to = np.cumsum(bins[late])
        share = _logit((up_to - 0.5) / up_to[-1])
        drawn = plot.model.line(np.maximum(late, 1), share, color=line.colour, line_width=1.5)
        dots = plot.model.scatter(np.maximum(late, 1), share, color=line.colour, size=3)
        if len(series) > 1:
            plot.named(line.name, drawn, dots)
        latest, longest = max(latest, int(late[-1])), max(longest, int(up_to[-1]))
    edge = min(0.05, 0.4 / longest)
    ticks = [one for one in _SHARES if edge <= one <= 1 - edge]
    places = _logit(np.array(ticks)).tolist()
    plot.ticks("y", {place: f"{100 * one:.6g} %" for place, one in zip(places, ticks, strict=True)})
    low, high = _logit(np.array([edge, 1 - edge])).tolist()
    plot.model.y_range = Range1d(low, high)
    plot.model.x_range = Range1d(0.8, 1.5 * latest)
    plot.reference(ROUGH_US, "height")
    plot.durations("x")
    plot.text = (
        "A logit axis stretches both ends: 99 %, 99.9 % and 99.99 % are equally far apart, and the last "
        "point is the largest delay. The dashed line is at 150 us."
    )
    if latest == LATE_BINS_US:
        plot.text += f" Latencies above {LATE_BINS_US // 1000} ms are drawn at this value."
    return plot


def _logit(share: Floats) -> Floats:
    odds: Floats = np.log(share / (1 - share))
    return odds
