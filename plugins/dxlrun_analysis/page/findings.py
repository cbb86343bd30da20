"""Plots of findings: the curve of the joint that one names, and the median of the other joints; of a late
servo its reply times by angle and temperature.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence

import numpy as np

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.joints.bins import Series
from dxlrun_analysis.joints.kinds import KINDS
from dxlrun_analysis.joints.trends import Trend
from dxlrun_analysis.page.canvas import BLUE, ERROR, Canvas, Plot
from dxlrun_analysis.page.joints import shown_in
from dxlrun_analysis.report import Report
from dxlrun_analysis.servos.traffic import ServoTraffic

_SUPPLY = frozenset(("own_supply", "undervoltage"))
_PLOTS = {
    "machine-busy": "busy_machine",
    "lateness": "rate_kept rough_wake_ups late_wake_ups throttled_processor",
    "steps": "skipped_periods slow_writes own_work",
    "worst-0": "long_cycle",
    "replies": "latency_timer late_replies late_replies_everywhere slow_servo return_delay all_answered",
    "lost": "missing_replies loose_cable lossy_servo shared_cable lossy_line silent_bus broken_replies "
    "invalid_states noise",
    "all-temperature": "hot_joint",
    "all-voltage": "sagging_supply undervoltage power_lost",
    "all-effort": "overload",
    "events-timeline": "servo_errors errors_logged another_host",
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
        if finding.code == "slow_servo":
            plots += _by_place(canvas, number, finding, report.servos)
            continue
        of = next((trend for trend in report.trends if trend.joint == finding.subject), None)
        if of is None or finding.code not in KINDS.keys() | _SUPPLY:
            continue
        moves = finding.code in KINDS
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


def _by_place(
    canvas: Canvas, number: int, finding: Finding, servos: Sequence[ServoTraffic]
) -> Iterator[Plot]:
    own = next((servo.own for servo in servos if servo.own and servo.joint == finding.subject), None)
    by = () if own is None else (own.by_angle, own.by_temperature)
    for label, points in zip(("angle of the servo, deg", "temperature, deg C"), by, strict=False):
        if len(points) > 1:
            axes = (label, "reply time, us")
            plot = canvas.free(f"finding-{number}-{label[:5]}", finding.code, axes, 150)
            plot.text = finding.sentence
            at, us = zip(*points, strict=True)
            plot.named(f"{finding.subject}: median", plot.model.line(at, us, color=ERROR))
            yield plot


def _values(trend: Trend, *, moves: bool) -> Floats:
    """Return the greatest error of each bin, or the least voltage."""
    series: Series = trend.error if moves else trend.voltage
    least = np.array(series.least, np.float64)
    return np.fmax(np.abs(least), np.abs(np.array(series.most, np.float64))) if moves else least
