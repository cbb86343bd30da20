"""Picture: the score of a sweep over one or two parameters, as a heat map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dxlrun.output.target import new_target
from dxlrun_lab.sweep import PICTURE_MARK, By
from dxlrun_lab.sweep.ranges import Value
from dxlrun_lab.sweep.ranking import ranked, score, unit
from dxlrun_lab.sweep.results import Row, SweepHeader

_MOST_TICKS = 10
_METADATA = {
    ".png": {"Software": PICTURE_MARK},
    ".svg": {"Creator": PICTURE_MARK, "Date": None},
    ".pdf": {"Creator": PICTURE_MARK},
}
_SPREAD = 5.0
"""A worst score so many times the best makes the scale of colours logarithmic: good runs differ little."""


def draw(path: Path, header: SweepHeader, names: Sequence[str], rows: Sequence[Row], by: By) -> None:
    """Write the map of a sweep of one or two parameters, in the format of the file's name.

    Raises InputError where that fails.

    Runs without a score are left blank, the best one is marked.
    """
    across, *up = (_values(rows, index) for index in range(len(header.parameters)))
    high: list[Value] = up[0] if up else [""]
    heat = np.full((len(high), len(across)), np.nan)
    places = {row.run: (high.index(row.values[1]) if up else 0, across.index(row.values[0])) for row in rows}
    for row in rows:
        if (found := score(row, by)) is not None:
            heat[places[row.run]] = found
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.add_subplot()
    low, most = np.nanmin(heat, initial=np.inf), np.nanmax(heat, initial=0.0)
    scale = LogNorm(low, most) if 0 < _SPREAD * low < most else Normalize()
    image = axes.imshow(heat, origin="lower", aspect="auto", norm=scale)
    for row in ranked(rows, by)[:1]:
        axes.plot(*reversed(places[row.run]), "o", mfc="none", mec="red", ms=14, mew=2)
    labels = [f"{name} {column.unit}".strip() for name, column in zip(names, header.parameters, strict=True)]
    axes.set_title(f"{header.robot}: {by} of each run")
    axes.set_xlabel(labels[0])
    axes.set_xticks(*_ticks(across))
    axes.set_ylabel("".join(labels[1:]))
    axes.set_yticks(*_ticks(high))
    figure.colorbar(image, label=f"{by}, {unit(by)} (best: red)")
    kind = path.suffix.lower()
    with new_target(path, PICTURE_MARK) as beside:
        figure.savefig(beside, format=kind.removeprefix("."), metadata=_METADATA[kind])


def _values(rows: Sequence[Row], index: int) -> list[Value]:
    """Return the values of a parameter, numbers in order, words as they come."""
    found = list(dict.fromkeys(row.values[index] for row in rows))
    numbers = [value for value in found if isinstance(value, float)]
    return [*sorted(numbers)] if len(numbers) == len(found) else found


def _ticks(values: Sequence[Value]) -> tuple[list[int], list[str]]:
    """Return places 0, 1, 2 ... of an axis and their labels, as many as fit."""
    places = list(range(0, len(values), -(-len(values) // _MOST_TICKS)))
    found = (values[place] for place in places)
    return places, [f"{value:.4g}" if isinstance(value, float) else str(value) for value in found]
