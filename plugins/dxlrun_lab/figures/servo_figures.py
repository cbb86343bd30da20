"""Figures of a servo's characteristics: step responses, rates, gaps between commands, dead band.

The step responses are those of M. A. Araujo, UFU 2017, Figures 19 and 20, with many steps in one figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dxlrun import Floats
from dxlrun_lab.figures.drawing import (
    BLUE,
    DASHED,
    ERROR,
    GREEN,
    MUTED,
    ORANGE,
    PURPLE,
    draw_figure,
)

_HEIGHT = 2.6
_PARTS_SHOWN = 4  # time axis of steps, in multiples of the longest response time


class ValueLine(NamedTuple):
    """Vertical line of a figure at a measured value, with its confidence interval"""

    name: str
    value: float
    """Position on the horizontal axis"""
    uncertainty: float
    """Half-width of the interval"""


class Points(NamedTuple):
    """Series of a figure: values that were tried (x), and the result of each (y)"""

    name: str
    """Name in the legend; empty for none"""
    x: Floats
    y: Floats
    failed: Sequence[bool]
    """True for each value that failed, which is crossed"""


def curves_drawing(  # noqa: PLR0917  what the figure shows, from its name to its marks
    name: str,
    title: str,
    text: str,
    labels: tuple[str, str],
    curves: Sequence[tuple[Floats, Floats]],
    levels: Sequence[float],
    marks: Sequence[ValueLine] = (),
) -> Element:
    """Draw superimposed curves, dashed horizontal levels, and marks on the horizontal axis.

    `name` is the identifier in the page, `text` the caption, and `labels` are those of the axes.
    """
    x_label, y_label = labels

    def draw_curves(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel=x_label, ylabel=y_label)
        for x, y in curves:
            axes.plot(x, y, color=BLUE, linewidth=0.6, marker=".", markersize=2, alpha=0.6)
        for level in levels:
            axes.axhline(level, color=MUTED if marks else ORANGE, linestyle=DASHED, linewidth=0.9)
        _mark(axes, marks)
        if marks:
            axes.set_xlim(-0.5 * marks[-1].value, _PARTS_SHOWN * marks[-1].value)

    dashed = ", ".join(f"{level:.3g}" for level in levels)
    alt = f"{y_label} over {x_label}; dashed at {dashed or 'nothing'}; {_spoken(marks, '')}"
    return draw_figure(name, title, alt, text, _HEIGHT, draw_curves)


def points_drawing(  # noqa: PLR0917  what the figure shows, from its name to its axes
    name: str,
    title: str,
    text: str,
    series: Sequence[Points],
    level: tuple[str, float] | None,
    marks: Sequence[ValueLine],
    x_label: str,
    y_label: str,
) -> Element:
    """Draw series of tried values, successful ones filled and failed ones crossed.

    `name` is the identifier in the page, `text` the caption, and `level` a named dashed horizontal line.
    """

    def draw_points(figure: Figure) -> None:
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
    return draw_figure(name, title, alt, text, _HEIGHT, draw_points)


def _mark(axes: Axes, marks: Sequence[ValueLine]) -> None:
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


def _spoken(marks: Sequence[ValueLine], unit: str) -> str:
    return ", ".join(f"{mark.name} {mark.value:.3g} {unit}".strip() for mark in marks) or "nothing marked"
