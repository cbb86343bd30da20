"""Plots of findings: the curve of the joint that one names, and the median of the other joints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from dxlrun.analysis.finding import Finding
from dxlrun.analysis.joints.bins import Series
from dxlrun.analysis.joints.tracking import JointTracking
from dxlrun.analysis.joints.trends import Trend
from dxlrun.analysis.page.canvas import BLUE, ERROR, Canvas, Plot
from dxlrun.run.channels.cycle import Floats

_MOVEMENT = frozenset(("frozen_position", "jammed_joint", "torque_limit", "error_grew"))
_SUPPLY = frozenset(("own_supply", "undervoltage"))


def finding_plots(
    canvas: Canvas, findings: Sequence[Finding], trends: Sequence[Trend], joints: Sequence[JointTracking]
) -> list[Plot]:
    """Return a plot of each finding about the movement or the supply of one joint."""
    units = {joint.name: joint.unit for joint in joints}
    plots = []
    for number, finding in enumerate(findings):
        of = next((trend for trend in trends if trend.joint == finding.subject), None)
        if of is None or finding.code not in _MOVEMENT | _SUPPLY:
            continue
        moves = finding.code in _MOVEMENT
        unit = units[of.joint] if moves else "V"
        label = f"error, {'deg' if unit == 'rad' else unit}" if moves else "voltage, V"
        others = [
            _values(trend, moves=moves)
            for trend in trends
            if trend is not of and (not moves or units[trend.joint] == unit)
        ]
        scale = math.degrees(1.0) if unit == "rad" else 1.0
        plot = canvas.timed(f"finding-{number}", finding.code, label, 150)
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
