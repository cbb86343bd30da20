"""Figures of events and replies: when events happened, and how soon the servos answered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dxlrun.analysis.cycles.latency import first_deadline_ns
from dxlrun.analysis.figures.drawing import (
    BLUE,
    COLUMNS,
    ERROR,
    MUTED,
    ORANGE,
    WARNING,
    Caption,
    Drawing,
    SteeringMarks,
    draw,
    time_axis,
)
from dxlrun.analysis.servos.traffic import ServoTraffic
from dxlrun.errors import counted
from dxlrun.log.reader import Log
from dxlrun.output.table import microseconds
from dxlrun.run.channels.cycle import Floats
from dxlrun.run.channels.events import Severity

_SHAPES = (
    ("information", Severity.INFO, "o", BLUE, 3.5),
    ("warning", Severity.WARNING, "^", WARNING, 5.0),
    ("error", Severity.ERROR, "X", ERROR, 6.0),
)


def events_drawing(log: Log) -> Drawing | None:
    """Return the timeline of the events, one row a kind; None without events."""
    if not log.events:
        return None
    start = first_deadline_ns(log)
    kinds = list(dict.fromkeys(event.name for event in sorted(log.events, key=lambda event: event.t_ns)))
    times = np.array([(event.t_ns - start) / 1e9 for event in log.events])
    rows = np.array([kinds.index(event.name) for event in log.events], dtype=np.float64)
    steering = SteeringMarks.of(log)
    grades = np.array([_grade(event.severity) for event in log.events])

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        steering.draw(axes)
        for grade, (name, _, shape, colour, size) in enumerate(_SHAPES):
            chosen = grades == grade
            if chosen.any():
                x, y = _apart(times[chosen], rows[chosen])
                axes.plot(x, y, shape, color=colour, markersize=size, markeredgewidth=0, label=name)
        axes.set_yticks(range(len(kinds)), [kind.replace("_", " ") for kind in kinds])
        axes.set_ylim(len(kinds) - 0.5, -0.5)
        time_axis(axes)
        axes.margins(x=0.03)
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2)

    counts = ", ".join(
        f"{name} {np.count_nonzero(grades == grade)}" for grade, (name, *_) in enumerate(_SHAPES)
    )
    number = counted(len(log.events), "event", "events")
    caption = Caption(
        "events-timeline",
        "Events over the run",
        f"Events over the time of the run in s, one row a kind. {number}: {counts}.",
        f"{number}: {counts}. Before 0 s the servos are set up. {steering.note}".strip(),
    )
    return draw(caption, 0.9 + 0.17 * len(kinds), fill)


def _grade(severity: int) -> int:
    return (severity >= Severity.WARNING) + (severity >= Severity.ERROR)


def _apart(times: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Drop events of a kind that would be drawn on the very same spot."""
    span = float(np.ptp(times)) or 1.0
    spots = np.stack([rows, np.round((times - times.min()) / span * COLUMNS)], axis=1)
    _, first = np.unique(spots, axis=0, return_index=True)
    return times[first], rows[first]


def reply_drawing(servos: Sequence[ServoTraffic]) -> Drawing | None:
    """Return the figure of the reply times; None where no servo answered what it was asked."""
    shown = [servo for servo in servos if servo.asked > servo.lost]
    if not shown:
        return None
    slowest = max(shown, key=lambda servo: servo.reply_max_us)

    def fill(figure: Figure) -> None:
        axes = figure.subplots()
        rows = range(len(shown))
        median = [servo.reply_median_us / 1e3 for servo in shown]
        most = [servo.reply_max_us / 1e3 for servo in shown]
        axes.hlines(rows, median, most, color=MUTED, linewidth=1.0)
        axes.plot(median, rows, "o", color=BLUE, markersize=4.5, markeredgewidth=0, label="median")
        axes.plot(most, rows, "D", color=ORANGE, markersize=4, markeredgewidth=0, label="slowest")
        axes.set_yticks(rows, [f"{servo.joint or servo.bus} {servo.servo_id}" for servo in shown])
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlim(0, max(most) * 1.06 or 1)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("reply time, ms")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)

    slow = f"The slowest reply, of servo {slowest.servo_id}, took {microseconds(slowest.reply_max_us)}."
    caption = Caption(
        "reply-times",
        "Reply time of each servo",
        f"Median and slowest reply time of each servo in ms. {slow}",
        f"{slow} From before the instruction is written to after the reply's last byte is read.",
    )
    return draw(caption, 0.9 + 0.21 * len(shown), fill)
