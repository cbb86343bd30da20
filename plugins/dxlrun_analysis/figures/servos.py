"""Figures of what a servo can do: step responses, rates, gaps between commands, dead band.

Step responses as in M. A. Araujo, UFU 2017, Figures 19 and 20, many of them over one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dxlrun.channels.cycle import Floats
from dxlrun_analysis.figures.drawing import (
    BLUE,
    DASHED,
    ERROR,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    draw,
)

_HEIGHT = 2.6
_PARTS_SHOWN = 4
"""So many times the longest response time is shown of steps."""


class Mark(NamedTuple):
    """A line at a measured value, with the interval in which it lies."""

    name: str
    value: float
    uncertainty: float


class Points(NamedTuple):
    """Values that were tried, those that failed apart."""

    name: str
    x: Floats
    y: Floats
    failed: Sequence[bool]


def steps_drawing(  # noqa: PLR0917  what the figure shows, from its name to its marks
    name: str,
    title: str,
    text: str,
    curves: Sequence[tuple[Floats, Floats]],
    goal: float,
    marks: Sequence[Mark],
) -> Element:
    """Return step responses over one another: ms since the goal's packet, deg of the way; marks in ms."""

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="time since the goal's packet, ms", ylabel="way, deg")
        for time, way in curves:
            axes.plot(time, way, color=BLUE, linewidth=0.6, marker=".", markersize=2.5, alpha=0.6)
        axes.axhline(goal, color=MUTED, linestyle=DASHED, linewidth=0.8)
        _mark(axes, marks)
        if marks:
            axes.set_xlim(-0.5 * marks[-1].value, _PARTS_SHOWN * marks[-1].value)

    alt = f"Way in deg over time in ms since the goal's packet; {_spoken(marks, 'ms')}"
    return draw(name, title, alt, text, _HEIGHT, fill)


def moves_drawing(
    name: str, title: str, text: str, curves: Sequence[tuple[Floats, Floats]], marks: Sequence[Mark]
) -> Element:
    """Return the speeds of long moves over one another: s, rad/s; marks are levels of the speed."""

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="time since the goal's packet, s", ylabel="speed, rad/s")
        for time, speed in curves:
            axes.plot(time, speed, color=BLUE, linewidth=0.7, alpha=0.7)
        for mark in marks:
            axes.axhline(mark.value, color=ORANGE, linestyle=DASHED, linewidth=0.9, label=mark.name)
        if marks:
            axes.legend(loc="upper right")

    alt = f"Speed in rad/s over time in s; {_spoken(marks, 'rad/s')}"
    return draw(name, title, alt, text, _HEIGHT, fill)


def points_drawing(  # noqa: PLR0917  what the figure shows, from its name to its axes
    name: str,
    title: str,
    text: str,
    series: Sequence[Points],
    level: tuple[str, float] | None,
    marks: Sequence[Mark],
    x_label: str,
    y_label: str,
) -> Element:
    """Return points that were tried: kept ones filled, failed ones crossed; a level to compare them with."""

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel=x_label, ylabel=y_label)
        for points, colour in zip(series, (BLUE, GREEN, PURPLE), strict=False):
            failed = np.array(points.failed, dtype=np.bool_)
            axes.plot(points.x, points.y, color=colour, linewidth=0.8, label=points.name or None)
            axes.plot(
                points.x[~failed], points.y[~failed], color=colour, marker="o", markersize=4, linestyle=""
            )
            axes.plot(points.x[failed], points.y[failed], color=ERROR, marker="x", markersize=6, linestyle="")
        if level is not None:
            axes.axhline(level[1], color=MUTED, linestyle=DASHED, linewidth=0.8, label=level[0])
        _mark(axes, marks)
        if level is not None or any(points.name for points in series):
            axes.legend(loc="best")

    alt = f"{y_label} over {x_label}; failed ones are crossed. {_spoken(marks, '')}"
    return draw(name, title, alt, text, _HEIGHT, fill)


def band_drawing(  # noqa: PLR0917  what the figure shows, from its name to its marks
    name: str, title: str, text: str, goal: Floats, error: Floats, band: float | None
) -> Element:
    """Return how far a joint is from its goal, deg, over the goal, deg: a loop between two edges."""

    def fill(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel="goal, deg", ylabel="goal - position, deg")
        axes.plot(goal, error, color=BLUE, linewidth=0.5, marker=".", markersize=1.5)
        for side in () if band is None else (-band, band):
            axes.axhline(side, color=ORANGE, linestyle=DASHED, linewidth=0.9)

    alt = "Goal minus position in deg over the goal in deg, as it goes slowly to and fro."
    return draw(name, title, alt, text, _HEIGHT, fill)


def _mark(axes: Axes, marks: Sequence[Mark]) -> None:
    for number, (mark, colour) in enumerate(zip(marks, (ORANGE, PURPLE, GREEN), strict=False)):
        axes.axvspan(
            mark.value - mark.uncertainty, mark.value + mark.uncertainty, color=colour, alpha=0.2, linewidth=0
        )
        axes.axvline(mark.value, color=colour, linewidth=0.9, linestyle=DASHED)
        axes.annotate(
            mark.name,
            xy=(mark.value, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, -2 - 9 * number),
            textcoords="offset points",
            va="top",
            color=colour,
            fontsize=7.5,
        )


def _spoken(marks: Sequence[Mark], unit: str) -> str:
    return ", ".join(f"{mark.name} {mark.value:.3g} {unit}".strip() for mark in marks) or "nothing marked"
