"""Plots of the loop's time: wake-up latency and how it is distributed, the steps of a cycle, controllers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import Range1d, Span

from dxlrun.output.table import microseconds
from dxlrun_analysis.cycles.latency import ROUGH_NS, STEPS, Duration, Latency
from dxlrun_analysis.page.canvas import (
    BLUE,
    ERROR,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    WARNING,
    Canvas,
    Line,
    Plot,
    many_lines,
)
from dxlrun_analysis.page.curves import LATE_BINS_US, Curves, CurvesOfRun

_ROUGH_US = ROUGH_NS // 1000
_SHARES = (1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999)
_COLOURS = {"read": BLUE, "update": GREEN, "write": ORANGE, "cycle": INK}
_DURATIONS = tuple(10**exponent for exponent in range(8))
"""us, from 1 us to 10 s."""


def latency_plots(canvas: Canvas, run: CurvesOfRun, latency: Latency) -> tuple[Plot, ...]:
    """Return the wake-ups over the run, as a histogram to 150 us, and cumulative.

    As in M. A. Araujo, UFU 2017, Figures 25 to 30. Logarithmic axes: the tails are what matters.
    """
    count = int(run.late_bins.sum())
    summary = (
        f"{count} wake-ups; mean {latency.mean_us:.2f} us, standard deviation {latency.deviation_us:.2f} us, "
        f"mode {latency.mode_us} us, maximum {microseconds(latency.max_us)}."
    )
    return _lateness(canvas, run.cycles, summary), _histogram(canvas, run, count), _cumulative(canvas, run)


def _lateness(canvas: Canvas, cycles: Curves, summary: str) -> Plot:
    plot = canvas.timed("lateness", "Wake-up latency", "wake-up latency", 230, log=True)
    canvas.curves(plot, cycles, [Line("late", "woken after the deadline", BLUE)], "us", 0.0)
    canvas.marks(
        plot, cycles, [Line("rough", "later than 150 us", WARNING), Line("skipped", "periods skipped", ERROR)]
    )
    _line(plot, _ROUGH_US, "width")
    worst = float(np.nanmax(cycles.high("late")))
    plot.model.y_range = Range1d(0.6, 2 * max(worst, _ROUGH_US))
    duration_ticks(plot, "y")
    plot.text = f"{summary} The dashed line is at 150 us. What is below 1 us is drawn at 1 us."
    return plot


def _histogram(canvas: Canvas, run: CurvesOfRun, count: int) -> Plot:
    axes = ("wake-up latency, us (bins of 1 us)", "wake-ups in the bin")
    plot = canvas.free("latency-histogram", "Histogram of the wake-ups up to 150 us", axes, 210, log="y")
    shown = run.late_bins[: _ROUGH_US + 1]
    full = np.flatnonzero(shown)
    plot.model.quad(left=full, right=full + 1, bottom=0.5, top=shown[full], color=BLUE, line_width=0)
    plot.model.x_range = Range1d(-1, _ROUGH_US + 2)
    plot.model.y_range = Range1d(0.5, 2.0 * max(1, int(shown.max())))
    counts = [10**exponent for exponent in range(len(str(shown.max())) + 1)]
    plot.ticks("y", {one: f"{one:,}" for one in counts})
    beyond = count - int(shown.sum())
    plot.text = "No wake-up is later than 150 us."
    if beyond:
        plot.text = (
            f"{beyond} of {count} wake-ups ({beyond / count:.3%}) are later than 150 us and lie beyond the "
            "right edge."
        )
    return plot


def _cumulative(canvas: Canvas, run: CurvesOfRun) -> Plot:
    axes = ("wake-up latency (logarithmic)", "share of wake-ups up to it (logit)")
    plot = canvas.free("latency-cumulative", "Cumulative distribution of the wake-ups", axes, 260, log="x")
    late = np.flatnonzero(run.late_bins)
    up_to = np.cumsum(run.late_bins[late])
    total = int(up_to[-1])
    share = (up_to - 0.5) / total
    plot.model.line(np.maximum(late, 1), _logit(share), color=BLUE, line_width=1.5)
    plot.model.scatter(np.maximum(late, 1), _logit(share), color=BLUE, size=3)
    edge = min(0.05, 0.4 / total)
    ticks = [one for one in _SHARES if edge <= one <= 1 - edge]
    places = _logit(np.array(ticks)).tolist()
    plot.ticks("y", {place: f"{100 * one:.6g} %" for place, one in zip(places, ticks, strict=True)})
    low, high = _logit(np.array([edge, 1 - edge])).tolist()
    plot.model.y_range = Range1d(low, high)
    plot.model.x_range = Range1d(0.8, 1.5 * max(_ROUGH_US, int(late[-1])))
    _line(plot, _ROUGH_US, "height")
    duration_ticks(plot, "x")
    plot.text = (
        "A logit axis stretches both ends: 99 %, 99.9 % and 99.99 % are equally far apart, and the last "
        "point is the largest delay. The dashed line is at 150 us."
    )
    if late[-1] == LATE_BINS_US:
        plot.text += f" What is later than {LATE_BINS_US // 1000} ms is drawn there."
    return plot


def steps_plot(canvas: Canvas, cycles: Curves) -> Plot:
    """Return how long each step of the cycles took over the run, with the period as a line."""
    plot = canvas.timed("steps", "Duration of the steps", "duration", 260, log=True)
    lines = [
        Line(name, name, _COLOURS[name], width=3.5 if name == "cycle" else 1.2)
        for name, _, _ in reversed(STEPS)
    ]
    canvas.curves(plot, cycles, [*lines, Line("period", "period", ERROR, "dashed")], "us", 0.0)
    largest = max(float(np.nanmax(cycles.high(name))) for name in ("cycle", "period"))
    smallest = min(float(np.nanmin(cycles.low(name))) for name, _, _ in STEPS)
    plot.model.y_range = Range1d(max(0.6, smallest / 2), 2 * largest)
    duration_ticks(plot, "y")
    over = int(np.count_nonzero(cycles.high("cycle") > cycles.low("period")))
    plot.text = (
        "Read, update and write follow the wake-up; the cycle is their sum. Bands lie between the shortest "
        "and the longest of the cycles drawn together. "
        + (
            "Here and there a cycle took longer than its period."
            if over
            else "Every cycle is shorter than its period."
        )
    )
    return plot


def controllers_plot(canvas: Canvas, cycles: Curves, controllers: Sequence[Duration]) -> Plot | None:
    """Return how long the update of each controller took; None where none took any time."""
    lines = many_lines(cycles, ((f"controller {one.name}", one.name) for one in controllers))
    if not lines:
        return None
    plot = canvas.timed("controllers", "Updates of the controllers", "duration", 200, log=True)
    canvas.curves(plot, cycles, lines, "us", 0.0)
    highest = max(float(np.nanmax(cycles.high(line.curve))) for line in lines)
    lowest = min(float(np.nanmin(cycles.low(line.curve))) for line in lines)
    plot.model.y_range = Range1d(max(0.1, lowest / 2), 2 * highest)
    duration_ticks(plot, "y")
    plot.text = "A curve has gaps where its controller was not updated."
    return plot


def typical_plot(canvas: Canvas, steps: Sequence[Duration], period_us: float) -> Plot:
    """Return the steps of a typical cycle as bars in a row, against the period."""
    bars = (
        ("median of each step", [step.median_us for step in steps[:-1]]),
        ("99 % of each step", [step.p99_us for step in steps[:-1]]),
        ("longest of each step", [step.max_us for step in steps[:-1]]),
    )
    plot = canvas.free("budget-typical", "Budget of a cycle", ("time since the wake-up, ms", ""), 170)
    for number, step in enumerate(steps[:-1]):
        left = [sum(values[:number]) / 1e3 for _, values in bars]
        right = [sum(values[: number + 1]) / 1e3 for _, values in bars]
        rows = list(range(len(bars)))
        drawn = plot.model.hbar(y=rows, left=left, right=right, height=0.55, color=_COLOURS[step.name])
        plot.named(step.name, drawn)
    plot.rows([name for name, _ in bars])
    plot.model.x_range = Range1d(
        0, min(2.5 * period_us, 1.1 * max(period_us, *(sum(v) for _, v in bars))) / 1e3
    )
    _line(plot, period_us / 1e3, "height", ERROR)
    words = "; ".join(f"{name} {microseconds(sum(values))}" for name, values in bars[:2])
    plot.text = (
        f"{words[0].upper()}{words[1:]}. The dashed line is the period, {period_us / 1e3:g} ms; what is left "
        "of it is idle. The steps' 99 % and their longest need not come in the same cycle."
    )
    return plot


def duration_ticks(plot: Plot, which: str) -> None:
    """Write the ticks of a logarithmic axis in us as a person does: 100 us, 1 ms."""
    names = {
        us: f"{us // 10**6} s" if us >= 10**6 else f"{us // 1000} ms" if us >= 1000 else f"{us} us"
        for us in _DURATIONS
    }
    plot.ticks(which, names, [part * us for us in _DURATIONS for part in (2, 5)])


def _line(plot: Plot, at: float, dimension: str, colour: str = MUTED) -> None:
    plot.model.add_layout(Span(location=at, dimension=dimension, line_color=colour, line_dash="dashed"))


def _logit(
    share: np.ndarray[tuple[int], np.dtype[np.float64]],
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.log(share / (1 - share))
