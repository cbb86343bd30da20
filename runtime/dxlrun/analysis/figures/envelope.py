"""Many samples on few columns of a plot, without hiding what stands out.

A column keeps its smallest and its largest sample, in the order in which they happened: a single late cycle
among a million stays visible. Averages would hide exactly what a report is for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.interfaces import Floats

COLUMNS = 900
"""About as many as a figure has pixels across."""


@dataclass(frozen=True, slots=True)
class Columns:
    """How `count` samples are laid on columns of `width` samples each, the last one perhaps shorter."""

    count: int
    most: int = COLUMNS

    @property
    def width(self) -> int:
        """Samples a column."""
        return max(1, -(-self.count // self.most))

    @property
    def number(self) -> int:
        """Columns."""
        return -(-self.count // self.width)

    @property
    def whole(self) -> bool:
        """True where each sample has a column of its own: nothing is left out."""
        return self.width == 1

    def envelope(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the samples to draw: all, or the smallest and the largest of each column; NaN = gap.

        x, y: shape (count,). A column without any number is NaN.
        """
        if self.whole:
            return x, y
        low = self._rows(np.where(np.isnan(y), np.inf, y), np.inf).argmin(axis=1)
        high = self._rows(np.where(np.isnan(y), -np.inf, y), -np.inf).argmax(axis=1)
        first = np.arange(self.number) * self.width
        picked = np.sort(np.stack([first + low, first + high], axis=1), axis=1).ravel()
        return x[picked], y[picked]

    def largest(self, y: Floats) -> NDArray[np.intp]:
        """Return the index of the largest sample of each column."""
        first = np.arange(self.number) * self.width
        picked: NDArray[np.intp] = first + self._rows(y, -np.inf).argmax(axis=1)
        return picked

    def bounds(self, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the smallest sample of each column, the median, and the largest; y has no NaN."""
        rows = self._rows(y, np.nan)
        return np.nanmin(rows, axis=1), np.nanmedian(rows, axis=1), np.nanmax(rows, axis=1)

    def marked(self, flags: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the index of the first marked sample of each column that has one."""
        rows = self._rows(flags.astype(np.float64), 0.0)
        first = np.arange(self.number) * self.width
        picked: NDArray[np.intp] = (first + rows.argmax(axis=1))[rows.any(axis=1)]
        return picked

    def said(self, what: str) -> str:
        """Return the sentence that says how the figure was drawn; empty where every sample is shown."""
        return (
            ""
            if self.whole
            else f"Each column of the figure stands for {self.width} cycles and shows {what}."
        )

    def _rows(self, y: Floats, filler: float) -> Floats:
        missing = self.number * self.width - self.count
        return np.concatenate([y, np.full(missing, filler)]).reshape(self.number, self.width)
