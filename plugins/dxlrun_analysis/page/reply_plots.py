"""Plots of the buses: reply times and lost replies of each servo over the run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, Range1d

from dxlrun.tooling.output import microseconds
from dxlrun_analysis.page.canvas import BLUE, ERROR, MUTED, ORANGE, Canvas, Plot, many_lines
from dxlrun_analysis.page.run_curves import Curves
from dxlrun_analysis.servos.traffic import ServoTraffic

_ROW = 17  # Pixels per servo


def reply_plots(canvas: Canvas, replies: Curves, servos: Sequence[ServoTraffic]) -> list[Plot]:
    """Return the plots of reply times and lost replies over the run, and of each servo's slowest reply."""
    plots = []
    names = {f"{servo.bus} {servo.servo_id}": _name(servo) for servo in servos}
    lines = many_lines(replies, ((f"reply {key}", name) for key, name in names.items()))
    if lines:
        plot = canvas.timed("replies", "Reply times", "reply time, us", 220)
        canvas.curves(plot, replies, lines, "us", 100.0)
        plot.text = (
            "Time from the write of the instruction to the read of the reply's last byte. A band spans the "
            "fastest and slowest replies at one point. In a read of several servos, each time includes the "
            "preceding replies."
        )
        plots.append(plot)
    lost = {key: name for key, name in names.items() if f"lost {key}" in replies}
    if lost:
        plots.append(_lost(canvas, replies, lost))
    shown = [servo for servo in servos if servo.asked > servo.lost]
    if shown:
        plots.append(_typical(canvas, shown))
    return plots


def _name(servo: ServoTraffic) -> str:
    return f"{servo.joint or servo.bus} {servo.servo_id}"


def _lost(canvas: Canvas, replies: Curves, lost: dict[str, str]) -> Plot:
    plot = canvas.timed("lost", "Lost replies", "", 70 + _ROW * len(lost))
    times = canvas.seconds(replies.rows.t_ns)
    x, y, servo = [], [], []
    for row, (key, name) in enumerate(lost.items()):
        at = times[np.isfinite(replies.low(f"lost {key}"))].tolist()
        x += at
        y += [row] * len(at)
        servo += [name] * len(at)
    source = ColumnDataSource({"x": np.array(x), "y": np.array(y, np.uint8), "servo": servo})
    style = {"marker": "dash", "angle": np.pi / 2, "size": 12, "line_width": 1.5, "color": ERROR}
    drawn = plot.model.scatter("x", "y", source=source, **style)
    plot.hover(drawn, ("servo", "@servo"), ("time", "@x{0.000} s"))
    plot.rows(list(lost.values()))
    plot.text = "Each tick marks one or more missing replies."
    return plot


def _typical(canvas: Canvas, shown: Sequence[ServoTraffic]) -> Plot:
    axes = ("reply time, ms", "")
    plot = canvas.free("reply-times", "Reply time of each servo", axes, 90 + _ROW * len(shown))
    rows = list(range(len(shown)))
    median = [servo.reply_median_us / 1e3 for servo in shown]
    most = [servo.reply_max_us / 1e3 for servo in shown]
    plot.model.segment(x0=median, y0=rows, x1=most, y1=rows, color=MUTED)
    plot.named("median", plot.model.scatter(median, rows, color=BLUE, size=7))
    plot.named("slowest", plot.model.scatter(most, rows, color=ORANGE, size=7, marker="diamond"))
    plot.model.x_range = Range1d(0, max(most) * 1.06 or 1)
    plot.rows([_name(servo) for servo in shown])
    slowest = max(shown, key=lambda servo: servo.reply_max_us)
    plot.text = f"The slowest reply, of {_name(slowest)}, took {microseconds(slowest.reply_max_us)}."
    return plot
