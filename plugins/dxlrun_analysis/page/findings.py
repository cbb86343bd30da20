"""Plots of findings: the curve of the joint that one names, and the median of the other joints."""

from __future__ import annotations

import warnings

import numpy as np

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.joints.bins import Series
from dxlrun_analysis.joints.trends import Trend
from dxlrun_analysis.page.canvas import BLUE, ERROR, Canvas, Plot
from dxlrun_analysis.page.joints import shown_in
from dxlrun_analysis.report import Report

_MOVEMENT = frozenset(("stood_still", "follows_worse", "position_jumped", "oscillates"))
_PLOTS = {
    "machine-busy": "busy_machine",
    "lateness": "kept_rate",
    "steps": "skipped own_work",
    "replies": "late_replies slow_servo replies",
    "lost": "lossy_servo lossy_line broken_replies invalid_states noise",
    "all-voltage": "supply power_lost",
    "events-timeline": "servo_error errors_logged another_host",
}
"""Plots of the page, and the codes of the findings that each shows."""


def plot_of(code: str) -> str:
    """Return the name of the plot that shows findings of a code beside others; empty: there is none."""
    return next((plot for plot, codes in _PLOTS.items() if code in codes.split()), "")


def finding_plots(canvas: Canvas, report: Report) -> list[Plot]:
    """Return plots of each finding about the movement, the supply or the reply times of one joint."""
    units = {joint.name: joint.unit for joint in report.joints}
    plots: list[Plot] = []
    for number, finding in enumerate(report.verdict.findings):
        of = next((trend for trend in report.trends if trend.joint == finding.subject), None)
        if of is None or finding.code not in _MOVEMENT | {"supply"}:
            continue
        moves = finding.code in _MOVEMENT
        unit, scale = shown_in(units[of.joint]) if moves else ("V", 1.0)
        label = f"{'error' if moves else 'voltage'}, {unit}"
        others = [
            _values(trend, moves=moves)
            for trend in report.trends
            if trend is not of and (not moves or units[trend.joint] == units[of.joint])
        ]
        plot = canvas.timed(f"finding-{number}", f"{of.joint}: {label}", label, 150)
        plot.text = finding.sentence
        own = _values(of, moves=moves) * scale
        at_s = of.begin_s + (np.arange(len(own)) + 0.5) * of.bin_s
        times = canvas.seconds((at_s * 1e9).astype(np.int64))
        if others:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # where none is known
                median = np.nanmedian(others, axis=0) * scale
            plot.named("median of the other joints", plot.model.line(times, median, color=BLUE))
        plot.named(of.joint, plot.model.line(times, own, color=ERROR))
        plots.append(plot)
    return plots


def _values(trend: Trend, *, moves: bool) -> Floats:
    """Return the greatest error of each bin, or the least voltage."""
    series: Series = trend.error if moves else trend.voltage
    least = np.array(series.least, np.float64)
    return np.fmax(np.abs(least), np.abs(np.array(series.most, np.float64))) if moves else least
