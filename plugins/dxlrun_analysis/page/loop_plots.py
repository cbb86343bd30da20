"""Plots of the loop's time: wake-up latency, steps of a cycle, updates of the controllers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import Range1d

from dxlrun.tooling.output import microseconds
from dxlrun_analysis.cycles.punctuality import STEPS, Latency, StepDuration
from dxlrun_analysis.page.canvas import (
    BLUE,
    ERROR,
    GREEN,
    INK,
    ORANGE,
    Canvas,
    Plot,
    PlotLine,
    many_lines,
)
from dxlrun_analysis.page.run_curves import Curves, CurvesOfRun
from dxlrun_analysis.page.wake_up_plots import WakeUps, wake_up_plots

_COLOURS = {"read": BLUE, "update": GREEN, "write": ORANGE, "cycle": INK}


def latency_plots(canvas: Canvas, run: CurvesOfRun, latency: Latency) -> tuple[Plot, ...]:
    """Return the three plots of a run's wake-up latency."""
    summary = (
        f"{run.late_bins.sum()} wake-ups; median {latency.median_us:.1f} us, 99 % {latency.p99_us:.1f} us, "
        f"99.9 % {latency.p999_us:.1f} us, mean {latency.mean_us:.2f} us, standard deviation "
        f"{latency.deviation_us:.2f} us, mode {latency.mode_us} us, maximum {microseconds(latency.max_us)}."
    )
    series = WakeUps(PlotLine("late", "delay after the deadline", BLUE), run.late_bins)
    return wake_up_plots(canvas, run.cycles, [series], summary)


def steps_plot(canvas: Canvas, cycles: Curves) -> Plot:
    """Return the plot of the duration of each step of the cycle over the run, with the period as a line."""
    plot = canvas.timed("steps", "Duration of each step", "duration", 260, log=True)
    lines = [
        PlotLine(name, name, _COLOURS[name], width=3.5 if name == "cycle" else 1.2)
        for name, _, _ in reversed(STEPS)
    ]
    canvas.curves(plot, cycles, [*lines, PlotLine("period", "period", ERROR, "dashed")], "us", 0.0)
    largest = max(float(np.nanmax(cycles.high(name))) for name in ("cycle", "period"))
    smallest = min(float(np.nanmin(cycles.low(name))) for name, _, _ in STEPS)
    plot.model.y_range = Range1d(max(0.6, smallest / 2), 2 * largest)
    plot.durations("y")
    over = int(np.count_nonzero(cycles.high("cycle") > cycles.low("period")))
    plot.text = (
        "Read, update and write follow the wake-up; the cycle is their sum. A point of a curve can combine "
        "several cycles; the band spans their shortest and longest times. "
        + (
            "Some cycles took longer than their period."
            if over
            else "Every cycle is shorter than its period."
        )
    )
    return plot


def controllers_plot(canvas: Canvas, cycles: Curves, controllers: Sequence[StepDuration]) -> Plot | None:
    """Return the plot of the duration of each controller's update over the run; None if none took time."""
    lines = many_lines(cycles, ((f"controller {one.name}", one.name) for one in controllers))
    if not lines:
        return None
    plot = canvas.timed("controllers", "Updates of the controllers", "duration", 200, log=True)
    canvas.curves(plot, cycles, lines, "us", 0.0)
    highest = max(float(np.nanmax(cycles.high(line.curve))) for line in lines)
    lowest = min(float(np.nanmin(cycles.low(line.curve))) for line in lines)
    plot.model.y_range = Range1d(max(0.1, lowest / 2), 2 * highest)
    plot.durations("y")
    plot.text = "A curve has gaps where its controller was not updated."
    return plot


def typical_plot(canvas: Canvas, steps: Sequence[StepDuration], period_us: float) -> Plot:
    """Return the plot of a typical cycle: its steps as stacked bars, compared with the period."""
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
    plot.reference(period_us / 1e3, "height", ERROR)
    words = "; ".join(f"{name} {microseconds(sum(values))}" for name, values in bars[:2])
    plot.text = (
        f"{words[0].upper()}{words[1:]}. The dashed line is the period, {period_us / 1e3:g} ms; the rest "
        "is idle time. The 99 % and longest steps can belong to different cycles."
    )
    return plot
