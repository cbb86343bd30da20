"""Plot of the events of a run over time, and selection of the events that the page shows."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource

from dxlrun import Log
from dxlrun.tooling.output import counted
from dxlrun.tooling.records import Event, Severity
from dxlrun_analysis.page.canvas import BLUE, ERROR, WARNING, Canvas, Plot

MOST_EVENTS = 1500  # The first events of each grade are kept
_LONGEST = 200  # Characters of a tooltip
_GRADES = (
    ("information", "circle", BLUE, 5),
    ("warning", "triangle", WARNING, 8),
    ("error", "x", ERROR, 9),
)
_ROW = 17  # Pixels per row


class EventCollector:
    """Accumulator of the first 1500 events each of information, warnings and errors."""

    def __init__(self) -> None:
        self._kept: tuple[list[Event], ...] = tuple([] for _ in _GRADES)

    def add_slice(self, log: Log) -> None:
        """Add the events in the next slice of the log."""
        for event in log.events:
            of_grade = self._kept[grade(event.severity)]
            if len(of_grade) < MOST_EVENTS:
                of_grade.append(event)

    def sort_events(self) -> tuple[Event, ...]:
        """Return the kept events in order of time."""
        return tuple(sorted((one for kept in self._kept for one in kept), key=lambda event: event.t_ns))


def grade(severity: int) -> int:
    """Return the grade of an event's severity: 0 for information, 1 for a warning, 2 for an error."""
    return (severity >= Severity.WARNING) + (severity >= Severity.ERROR)


def events_plot(canvas: Canvas, events: tuple[Event, ...], number: int) -> Plot:
    """Return the plot of events over the run, one row per kind; `number` counts also those not drawn."""
    kinds = list(dict.fromkeys(event.name for event in events))
    plot = canvas.timed("events-timeline", "Events over the run", "", 90 + _ROW * len(kinds))
    times = canvas.seconds(np.array([event.t_ns for event in events], np.int64))
    grades = np.array([grade(event.severity) for event in events])
    for level, (name, marker, colour, size) in enumerate(_GRADES):
        chosen = np.flatnonzero(grades == level)
        if not len(chosen):
            continue
        mine = [events[index] for index in chosen.tolist()]
        source = ColumnDataSource(
            {
                "x": times[chosen],
                "y": np.array([kinds.index(event.name) for event in mine], np.float32),
                "kind": [event.name for event in mine],
                "text": [_short(f"{event.source}: {event.text}") for event in mine],
            }
        )
        drawn = plot.model.scatter(
            "x", "y", source=source, marker=marker, color=colour, size=size, line_width=2
        )
        plot.hover(drawn, ("event", "@kind"), ("time", "@x{0.000} s"), ("", "@text"))
        plot.named(name, drawn)
    plot.rows([kind.replace("_", " ") for kind in kinds])
    few = "" if len(events) == number else f"; {len(events)} are drawn"
    plot.text = f"{counted(number, 'event', 'events')}{few}. Before 0 s the servos are set up."
    return plot


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]}..."
