"""Part of the report: minimum, mean and maximum of each state of devices, sensors and controllers."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Log
from dxlrun.tooling.output import Column, Columns, quantity_text
from dxlrun_analysis.parts.part import ReportPart, listing

_DIGITS = 4


class SourceValues(msgspec.Struct, frozen=True):
    """Minimum, mean and maximum of one state of a device, sensor or controller over a run, SI units; None
    if it was never valid."""

    name: str  # `imu/angular_velocity.x`
    unit: str  # Empty if the state has no unit, or the log does not record it
    cycles: int  # Cycles with a valid value
    least: float | None
    mean: float | None
    greatest: float | None


class SourceHistory:
    """Accumulator of minimum, mean and maximum of the states of devices, sensors and controllers."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._units: dict[str, str] = {}
        self._counts: NDArray[np.int64] = np.zeros(0, np.int64)
        self._sums: Floats = np.zeros(0)
        self._least: Floats = np.zeros(0)
        self._greatest: Floats = np.zeros(0)

    def add_slice(self, log: Log) -> None:
        """Add the source values in the cycles of the next slice of the log."""
        layout = log.header.layout
        if not len(log.cycles) or not layout.source_states:
            return
        if not self._names:
            self._names, self._units = layout.source_states, log.header.source_units
            count = len(self._names)
            self._counts, self._sums = np.zeros(count, np.int64), np.zeros(count)
            self._least, self._greatest = np.full(count, np.inf), np.full(count, -np.inf)
        values = log.cycles["source_state"]
        known = np.isfinite(values)
        for row, source in enumerate(layout.sources):
            known[:, layout.source_slice(source)] &= log.cycles["source_valid"][:, row, np.newaxis]
        self._counts += known.sum(axis=0)
        self._sums += np.sum(values, axis=0, where=known)
        self._least = np.fmin(self._least, np.min(values, axis=0, where=known, initial=np.inf))
        self._greatest = np.fmax(self._greatest, np.max(values, axis=0, where=known, initial=-np.inf))

    def summarize_values(self) -> tuple[SourceValues, ...]:
        """Return the values of all states, in the order of the cycle's record."""
        rows = zip(self._names, self._counts.tolist(), self._sums, self._least, self._greatest, strict=True)
        return tuple(
            SourceValues(
                name,
                self._units.get(name, ""),
                count,
                *((float(low), float(total) / count, float(high)) if count else (None, None, None)),
            )
            for name, count, total, low, high in rows
        )


_COLUMNS: Columns[SourceValues] = (
    (Column("state", "name"), "name"),
    (Column("valid cycles"), "cycles"),
    (Column("least"), lambda one: quantity_text(one.least, one.unit, digits=_DIGITS)),
    (Column("mean"), lambda one: quantity_text(one.mean, one.unit, digits=_DIGITS)),
    (Column("greatest"), lambda one: quantity_text(one.greatest, one.unit, digits=_DIGITS)),
)

SOURCES = ReportPart(
    "sources",
    lambda report: report.tally.find_collector(SourceHistory).summarize_values(),
    listing("Devices, sensors and states of controllers", _COLUMNS),
    SourceHistory,
    section="joints",
)
