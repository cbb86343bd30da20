"""Figures of the loop's timing: wake-up latency, and the time that each step of a cycle takes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dxlrun.analysis.cycles.latency import Latency, cycle_periods_ns
from dxlrun.analysis.figures.drawing import (
    BLUE,
    DASHED,
    ERROR,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    PURPLE,
    Caption,
    Columns,
    Drawing,
    SteeringMarks,
    draw,
    run_time_s,
    time_axis,
)
from dxlrun.analysis.figures.wake_ups import WakeUps, wake_up_drawings
from dxlrun.log.reader import Log
from dxlrun.output.table import microseconds
from dxlrun.run.channels.cycle import Floats


def lateness_us(log: Log) -> Floats:
    """Return how much later than its deadline each cycle woke, us."""
    late: Floats = (log.cycles["woken_ns"] - log.cycles["scheduled_ns"]) / 1e3
    return late


def latency_drawings(log: Log, statistics: Latency) -> tuple[Drawing, ...]:
    """Return the three figures of the wake-up latency; `log` has at least one cycle."""
    late = lateness_us(log)
    summary = (
        f"{len(late)} wake-ups; mean {statistics.mean_us:.2f} us, standard deviation "
        f"{statistics.deviation_us:.2f} us, mode {statistics.mode_us} us, maximum "
        f"{microseconds(statistics.max_us)}."
    )
    numbers = log.cycles["cycle"].astype(np.float64)
    period_us = float(cycle_periods_ns(log).min()) / 1e3
    name = "one period" if period_us * 1e3 == log.period_ns else "the shortest period"
    wake_ups = WakeUps("", late, numbers, "iteration (period since the loop's first deadline)")
    return wake_up_drawings([wake_ups], period_us, name, summary)


# The budget of a cycle


_STEPS = (
    ("wake-up", "scheduled_ns", "woken_ns", PURPLE),
    ("read", "woken_ns", "read_ns", BLUE),
    ("update", "read_ns", "updated_ns", GREEN),
    ("write", "updated_ns", "written_ns", ORANGE),
)
_FEW = 5
"""So many periods are drawn with a line each."""
_MOST_PERIODS = 2.5
"""The axis ends here: one cycle of a second would flatten all others. What is beyond is marked."""

_Rows = NDArray[np.float64]
"""Shape (steps, cycles), ms."""


def budget_drawings(log: Log) -> tuple[Drawing, ...]:
    """Return the figures of the cycle's budget; `log` has at least one cycle."""
    cycles = log.cycles
    steps = np.stack(
        [(cycles[end] - cycles[begin]) / 1e6 for _, begin, end, _ in _STEPS]
    )  # (steps, cycles), ms
    return _typical(log, steps), _over_time(log, steps)


def _typical(log: Log, steps: _Rows) -> Drawing:
    periods = sorted(set((cycle_periods_ns(log) / 1e6).tolist()))
    period = periods[-1]
    worst = steps[:, int(steps.sum(axis=0).argmax())]
    bars = (
        ("longest cycle", worst),
        ("99 % of each step", np.percentile(steps, 99, axis=1)),
        ("median of each step", np.median(steps, axis=1)),
    )
    end = _end(period, [float(values.sum()) for _, values in bars])

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        for row, (_, values) in enumerate(bars):
            left = 0.0
            for (_, _, _, colour), value in zip(_STEPS, values, strict=True):
                axes.barh(row, value, left=left, height=0.55, color=colour, linewidth=0)
                left += float(value)
            beyond = left > end
            axes.annotate(
                f"goes on to {microseconds(left * 1e3)}" if beyond else microseconds(left * 1e3),
                xy=(min(left, end), row),
                xytext=(-4 if beyond else 4, 0),
                textcoords="offset points",
                ha="right" if beyond else "left",
                va="center",
                color=PAPER if beyond else INK,
            )
        axes.set_yticks(range(len(bars)), [name for name, _ in bars])
        axes.grid(visible=False, axis="y")
        axes.set_xlim(0, end)
        axes.set_xlabel("time since the cycle's deadline, ms")
        for one in periods if len(periods) <= _FEW else (periods[0], period):
            axes.axvline(one, color=ERROR, linewidth=0.9, linestyle=DASHED)
        _legend(axes)

    lines = f"The dashed line is the period, {period:g} ms"
    if len(periods) > 1:
        lines = f"The dashed lines are the periods, {periods[0]:g} ms to {period:g} ms"
    totals = "; ".join(
        f"{name}: {microseconds(float(values.sum()) * 1e3)}" for name, values in reversed(bars)
    )
    caption = Caption(
        "budget-typical",
        "Budget of a cycle",
        "Stacked bars of wake-up, read, update and write in ms against the period of "
        f"{period:g} ms. {totals}.",
        f"{totals[0].upper()}{totals[1:]}. {lines}; what is left of it is "
        "idle. The steps' 99 % need not come in the same cycle.",
    )
    return draw(caption, 1.9, fill)


def _over_time(log: Log, steps: _Rows) -> Drawing:
    periods = cycle_periods_ns(log) / 1e6
    period = float(periods.max())
    steering = SteeringMarks.of(log)
    total = steps.sum(axis=0)
    columns = Columns(steps.shape[1])
    picked = columns.largest(total)
    end = _end(period, [float(total.max())])
    beyond = picked[total[picked] > end]
    times = run_time_s(log)

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        below = np.zeros(len(picked))
        for (_, _, _, colour), values in zip(_STEPS, steps, strict=True):
            above = below + values[picked]
            axes.fill_between(times[picked], below, above, color=colour, linewidth=0, step="mid")
            below = above
        if not columns.whole:
            middle = columns.bounds(total)[1]
            axes.plot(times[picked], middle, color=INK, linewidth=1.0, label="median cycle")
        axes.plot(
            times[beyond],
            np.full(len(beyond), end * 0.985),
            "^",
            color=ERROR,
            markersize=5,
            markeredgewidth=0,
        )
        axes.set_ylim(0, end)
        axes.set_ylabel("time since the\ncycle's deadline, ms")
        if periods.min() < period:
            axes.step(times, periods, where="post", color=ERROR, linewidth=0.9, linestyle=DASHED)
        else:
            axes.axhline(period, color=ERROR, linewidth=0.9, linestyle=DASHED)
        steering.draw(axes)
        time_axis(axes)
        _legend(axes)

    over = int(np.count_nonzero(total > periods))
    late = (
        f"{over} of {len(total)} cycles ended later than one period after their deadline."
        if over
        else "Every cycle fits its period."
    )
    cut = (
        f" Triangles: {np.count_nonzero(total > end)} cycles go beyond the figure, the longest to "
        f"{microseconds(float(total.max()) * 1e3)}."
        if len(beyond)
        else ""
    )
    drawn = columns.note("its longest cycle, and the median as a line")
    caption = Caption(
        "budget-time",
        "Duration of the steps over the run",
        f"Stacked areas of wake-up, read, update and write in ms over the time of the run in s. {late}{cut}",
        " ".join(f"{late}{cut} {drawn} {steering.note}".split()),
    )
    return draw(caption, 2.6, fill)


def _end(period: float, values: list[float]) -> float:
    """Return where the axis ends, ms: the period in sight, and never more than a few of it."""
    return min(max(*values, period) * 1.12, _MOST_PERIODS * period)


def _legend(axes: Axes) -> None:
    for name, _, _, colour in _STEPS:
        axes.fill_between([], [], [], color=colour, linewidth=0, label=name)
    axes.plot([], [], color=ERROR, linewidth=0.9, linestyle=DASHED, label="period")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=6, borderaxespad=0.2, labelcolor=MUTED)
