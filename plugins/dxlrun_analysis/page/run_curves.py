"""Curves of the cycles of a run over time, in bounded size, collected slice by slice.

Each curve is an envelope of the whole run, with every sample in the windows around its worst cycles.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun_analysis.cycles.punctuality import LATE_BINS_US, ROUGH_NS, STEPS, cycle_periods_ns, late_bins
from dxlrun_analysis.page.envelope import Envelope, EnvelopeRows, Samples, Times

BYTES_OF_CURVES = 7_000_000
"""Size of all curves of cycles in a page before conversion to text, bytes: 4 a number, two numbers per row
and curve."""
_FEWEST_ROWS, _MOST_ROWS = 100, 6000
_BYTES_A_VALUE = 8  # Smallest and largest value, float32 each
_PART_OF_WINDOWS = 2 / 3  # Share of the rows for windows; the rest are bins of the whole run
_AT_ONCE = 4096  # Cycles that are binned together
_GAP_NS = 500_000_000
_GAP_PERIODS = 3  # A longer interval without cycles is a gap in the curves
_WINDOW_NS = 1_000_000_000  # Length of the window around a worst cycle
LEAST_US = 1.0  # Lower bound for drawn wake-ups, because the axis is logarithmic
_LEAST_NS = 100  # Lower bound for drawn durations; on virtual time steps take no time
_QUANTITIES = ("position", "velocity", "effort")
_JOINT_FIELDS = (
    *(f"{kind}{quantity}" for quantity in _QUANTITIES for kind in ("", "goal_", "command_")),
    "temperature",
    "voltage",
)
_GOAL = "goal_position"  # Name of a cycle's field and of its curves


@dataclass(frozen=True, slots=True)
class Curves:
    """Named curves over common times, with the smallest and largest value in each row."""

    rows: EnvelopeRows
    columns: Mapping[str, int]
    """Column of each curve in `rows`, by name; curves without any value are omitted."""

    @classmethod
    def from_rows(cls, rows: EnvelopeRows, names: Iterable[str]) -> Curves:
        """Name the columns of `rows`, one name per column, and omit curves without any value."""
        there: NDArray[np.bool_] = np.asarray(np.isfinite(rows.low).any(axis=0))
        return cls(rows, {name: index for index, name in enumerate(names) if there[index]})

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def low(self, name: str) -> Samples:
        """Return the smallest values of a curve, shape (rows,)."""
        return self.rows.low[:, self.columns[name]]

    def high(self, name: str) -> Samples:
        """Return the largest values of a curve, shape (rows,)."""
        return self.rows.high[:, self.columns[name]]

    def only_samples(self, name: str) -> bool:
        """Return whether the smallest and largest values of a curve are equal in every row."""
        return bool(np.array_equal(self.low(name), self.high(name), equal_nan=True))


@dataclass(frozen=True, slots=True)
class CurvesOfRun:
    """Curves of all quantities of the cycles of a run, and the distribution of its wake-ups."""

    cycles: Curves
    late_bins: NDArray[np.int64]
    """Number of wake-ups in each bin of 1 us, shape (LATE_BINS_US + 1,). Early ones count as 0."""
    windows: tuple[tuple[int, int], ...]
    """Windows in which the curves have every sample: begin and end, ns of the run's clock."""
    begin_ns: int
    end_ns: int  # `begin_ns` and `end_ns` are the first and the last deadline


def joint_curve(field: str, joint: str) -> str:
    """Return the name of the curve of a joint's field, such as `position knee`."""
    return f"{field} {joint}"


class CurveCollector:
    """Accumulator of the curves of a run: steps of the cycle, controllers and joints."""

    def __init__(self, worst_ns: Iterable[int] = ()) -> None:
        """Create the accumulator.

        Args:
            worst_ns: Deadlines of the worst cycles, around which every sample is kept.
        """
        self._worst_ns = tuple(worst_ns)
        self._names: tuple[str, ...] = ()
        self._envelope: Envelope | None = None
        self._windows: list[tuple[int, int]] = []
        self._kept: list[tuple[Times, Samples]] = []
        self._most = 0
        self._pending: list[NDArray[np.void]] = []
        self._waiting = 0
        self._log: Log | None = None
        self._late_bins = np.zeros(LATE_BINS_US + 1, np.int64)
        self._span: tuple[int, int] | None = None
        self._goal: NDArray[np.float64] | None = None
        """Position goals of the preceding cycle, shape (joints,), or None."""

    def add_slice(self, log: Log) -> None:
        """Add the cycles of the next slice of the log."""
        if self._envelope is None:
            self._set_up_curves(log)
        if len(log.cycles):
            self._pending.append(log.cycles)
            self._waiting += len(log.cycles)
            if self._waiting >= _AT_ONCE:
                self._digest()

    def build_curves(self) -> CurvesOfRun:
        """Return the curves of the whole run; for a log without cycles, no curves."""
        self._digest()
        rows = Envelope(0, 2, 1).rows()
        if self._envelope is not None and self._log is not None:
            kept = self._kept or [(np.zeros(0, np.int64), np.zeros((0, len(self._names)), np.float32))]
            times, samples = (np.concatenate(column) for column in zip(*kept, strict=True))
            rows = self._envelope.rows().and_samples(times, samples, self._windows)
            longest_ns = max(_GAP_NS, _GAP_PERIODS * self._log.period_ns, self._envelope.apart_ns)
            rows = rows.with_gaps(longest_ns)
        begin, end = self._span or (0, 0)
        curves = Curves.from_rows(rows, self._names)
        return CurvesOfRun(curves, self._late_bins, tuple(self._windows), begin, end)

    def _set_up_curves(self, log: Log) -> None:
        joints, controllers = log.joints, [controller.name for controller in log.controllers]
        self._names = (
            "late",
            *(name for name, _, _ in STEPS),
            "period",
            *(f"controller {name}" for name in controllers),
            "rough",
            "skipped",
            *(joint_curve(field, joint) for field in (*_JOINT_FIELDS, "error") for joint in joints),
            *(joint_curve(flag, joint) for flag in ("silent", "clamped") for joint in joints),
        )
        rows = BYTES_OF_CURVES // (_BYTES_A_VALUE * len(self._names))
        rows = min(max(rows, _FEWEST_ROWS), _MOST_ROWS)
        self._most = int(rows * _PART_OF_WINDOWS)
        self._log = log
        self._envelope = Envelope(len(self._names), rows - self._most, log.period_ns)
        self._windows = windows(self._worst_ns, self._most, log.period_ns)

    def _digest(self) -> None:
        if self._envelope is None or self._log is None or not self._pending:
            return
        cycles = np.concatenate(self._pending)
        self._pending, self._waiting = [], 0
        times = cycles["scheduled_ns"]
        begin, end = self._span or (int(times[0]), int(times[0]))
        self._span = min(begin, int(times.min())), max(end, int(times.max()))
        self._late_bins += late_bins(cycles["woken_ns"] - times)
        before = np.full((1, len(self._log.joints)), np.nan) if self._goal is None else self._goal[None]
        goals = np.concatenate([before, cycles[_GOAL]])
        self._goal = goals[-1].copy()
        values = _values(replace(self._log, cycles=cycles), goals[:-1])
        self._envelope.add_samples(times, values)
        room = self._most - sum(len(part) for part, _ in self._kept)
        inside = np.zeros(len(times), np.bool_)
        for start, stop in self._windows:
            inside |= (times >= start) & (times < stop)
        rows = np.flatnonzero(inside)[: max(0, room)]
        if len(rows):
            self._kept.append((times[rows].copy(), values[rows]))


def windows(worst_ns: Iterable[int], most: int, period_ns: int) -> list[tuple[int, int]]:
    """Return disjoint ascending windows of time around the deadlines of the worst cycles: a second each,
    or shorter to hold `most` cycles together."""
    worst = list(worst_ns)
    if not worst:
        return []
    length = max(period_ns, min(_WINDOW_NS, most // len(worst) * period_ns))
    found: list[tuple[int, int]] = []
    for due in sorted(worst):
        begin, end = due - length // 2, due + length // 2 + period_ns
        if found and begin <= found[-1][1]:
            found[-1] = found[-1][0], end
        else:
            found.append((begin, end))
    return found


def _values(log: Log, goals: NDArray[np.float64]) -> Samples:
    """Return the values of all curves in each cycle, shape (cycles, curves), in order of their names; times
    in us.

    Args:
        log: Log with the cycles.
        goals: Position goals of the cycle before each, which the servo had received when its position was
            read.
    """
    cycles, count = log.cycles, len(log.cycles)
    late: NDArray[np.int64] = cycles["woken_ns"] - cycles["scheduled_ns"]
    took = cycles["controller_ns"] / 1e3
    took[took <= 0] = np.nan
    valid = cycles["valid"]
    columns = [
        np.maximum(late[:, None] / 1e3, LEAST_US),
        *(np.maximum(cycles[end] - cycles[begin], _LEAST_NS)[:, None] / 1e3 for _, begin, end in STEPS),
        cycle_periods_ns(log)[:, None] / 1e3,
        took,
        _marks((late > ROUGH_NS)[:, None]),
        _marks((cycles["skipped"] > 0)[:, None]),
        *(
            np.where(valid, cycles[field], np.nan) if field in _QUANTITIES else cycles[field]
            for field in _JOINT_FIELDS
        ),
        np.where(valid, cycles["position"] - goals, np.nan),
        _marks(~valid),
        _marks(cycles["clamped"] != 0),
    ]
    values = np.concatenate([column.reshape(count, -1) for column in columns], axis=1).astype(np.float32)
    values[~np.isfinite(values)] = np.nan
    return values


def _marks(flags: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(flags, 1.0, np.nan)
