"""Picture: a score over the parameters of a sweep; one is a curve, two are a map, more are parallel axes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dxlrun_lab.sweep.ranges import Value
from dxlrun_lab.sweep.ranking import By, ranked, score, unit
from dxlrun_lab.sweep.results import ParameterColumn, Row

FORMATS = (".svg", ".png", ".pdf")
_COLOURS = "viridis"
_MOST_TICKS = 10
_SPREAD = 5.0


def draw(
    path: Path,
    columns: Sequence[ParameterColumn],
    names: Sequence[str],
    rows: Sequence[Row],
    *,
    by: By,
    title: str,
) -> None:
    """Write the picture of a sweep, in the format of the file's name; raises OSError.

    `rows` in the order of the grid. Runs without a score are left out.
    """
    axes_names = [
        f"{name} ({column.unit})" if column.unit else name
        for name, column in zip(names, columns, strict=True)
    ]
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title)
    if len(columns) == 1:
        _curve(axes, axes_names[0], rows, by)
    elif len(columns) == 2:
        _map(figure, axes, axes_names, rows, by)
    else:
        _parallel(figure, axes, axes_names, rows, by)
    figure.savefig(path, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)


def _scale(rows: Sequence[Row], by: By) -> Normalize:
    """Return the scale of colours: logarithmic where bad runs would hide how the good ones differ."""
    found = [value for row in rows if (value := score(row, by)) is not None]
    low, high = min(found, default=0.0), max(found, default=1.0)
    return LogNorm(low, high) if 0 < _SPREAD * low < high else Normalize(low, high)


def _values(rows: Sequence[Row], index: int) -> list[Value]:
    """Return the values of a parameter, numbers in order, words as they come."""
    found = list(dict.fromkeys(row.values[index] for row in rows))
    numbers = [value for value in found if isinstance(value, float)]
    return [*sorted(numbers)] if len(numbers) == len(found) else found


def _text(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _ticks(axes: Axes, values: Sequence[Value], which: str) -> None:
    """Label places 0, 1, 2 ... of an axis with values, as many as fit."""
    every = -(-len(values) // _MOST_TICKS)
    places = range(0, len(values), every)
    labels = [_text(values[place]) for place in places]
    if which == "x":
        axes.set_xticks(list(places), labels)
    else:
        axes.set_yticks(list(places), labels)


def _curve(axes: Axes, name: str, rows: Sequence[Row], by: By) -> None:
    values = _values(rows, 0)
    known = {row.values[0]: found for row in rows if (found := score(row, by)) is not None}
    heights = [known.get(value, np.nan) for value in values]
    numbers = [value for value in values if isinstance(value, float)]
    if len(numbers) == len(values):
        axes.plot(numbers, heights, marker="o")
        steps = np.diff(np.log(numbers)) if numbers and numbers[0] > 0 else np.zeros(0)
        if len(steps) > 1 and np.allclose(steps, steps[0], rtol=0.05):
            axes.set_xscale("log")
    else:
        axes.bar(range(len(values)), heights)
        _ticks(axes, values, "x")
    axes.set_xlabel(name)
    axes.set_ylabel(f"{by}, {unit(by)}")
    axes.grid(alpha=0.4)


def _map(figure: Figure, axes: Axes, names: Sequence[str], rows: Sequence[Row], by: By) -> None:
    across, up = _values(rows, 0), _values(rows, 1)
    heat = np.full((len(up), len(across)), np.nan)
    for row in rows:
        if (found := score(row, by)) is not None:
            heat[up.index(row.values[1]), across.index(row.values[0])] = found
    image = axes.imshow(heat, origin="lower", aspect="auto", cmap=_COLOURS, norm=_scale(rows, by))
    for row in ranked(rows, by)[:1]:
        axes.plot(
            across.index(row.values[0]), up.index(row.values[1]), "o", mfc="none", mec="red", ms=14, mew=2
        )
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    _ticks(axes, across, "x")
    _ticks(axes, up, "y")
    figure.colorbar(image, label=f"{by}, {unit(by)} (best: red)")


def _parallel(figure: Figure, axes: Axes, names: Sequence[str], rows: Sequence[Row], by: By) -> None:
    """Draw each run as a line through its values, the best tenth thicker and above the others."""
    best = ranked(rows, by)
    found = [score(row, by) or 0.0 for row in best]
    scale, colours = _scale(rows, by), colormaps[_COLOURS]
    values = [_values(rows, index) for index in range(len(names))]
    for rank, (row, height) in reversed(list(enumerate(zip(best, found, strict=True)))):
        emphasis = 2.0 if rank <= len(best) // 10 else 0.6
        places = [
            own.index(value) / max(1, len(own) - 1) for own, value in zip(values, row.values, strict=True)
        ]
        axes.plot(range(len(names)), places, color=colours(scale(height)), linewidth=emphasis, alpha=0.8)
    for index, own in enumerate(values):
        for place, value in enumerate(own):
            if len(own) <= _MOST_TICKS or place in (0, len(own) - 1):
                axes.text(index + 0.02, place / max(1, len(own) - 1), _text(value), fontsize=8)
        axes.axvline(index, color="grey", linewidth=0.8)
    axes.set_xticks(range(len(names)), names)
    axes.set_yticks([])
    figure.colorbar(ScalarMappable(scale, colours), ax=axes, label=f"{by}, {unit(by)}")
