"""What the plots of a run show, taken slice by slice of a log: curves over its time in bounded size.

Each curve is an envelope of the whole run, with every sample in the windows around its worst cycles.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun_analysis.cycles.latency import LATE_BINS_US, ROUGH_NS, STEPS, cycle_periods_ns, late_bins
from dxlrun_analysis.page.envelope import Envelope, Rows, Samples, Times

BYTES_OF_CURVES = 7_000_000
"""Of all curves of the cycles in a page, before they are text: 4 bytes a number, two numbers a row."""
_FEWEST_ROWS, _MOST_ROWS = 100, 6000
_BYTES_A_VALUE = 8
_PART_OF_WINDOWS = 2 / 3  # Of the rows; the rest are bins of the whole run
_AT_ONCE = 4096  # So many cycles are laid in bins together
_GAP_NS = 500_000_000
_GAP_PERIODS = 3  # A longer time without cycles is a gap in the curves
_WINDOW_NS = 1_000_000_000  # Around a worst cycle
LEAST_US = 1.0  # Earlier wake-ups are drawn here: the axis is logarithmic
_LEAST_NS = 100  # Steps that took less, or no time at all on virtual time, are drawn here
_QUANTITIES = ("position", "velocity", "effort")
_JOINT_FIELDS = (
    *(f"{kind}{quantity}" for quantity in _QUANTITIES for kind in ("", "goal_", "command_")),
    "temperature",
    "voltage",
)
_GOAL = "goal_position"  # Fields of a cycle with a number a joint that become curves of that name


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves over common times."""

    rows: Rows
    columns: Mapping[str, int]
    """Which column of the rows each curve is; one that never had a value is not there."""

    @classmethod
    def of(cls, rows: Rows, names: Iterable[str]) -> Curves:
        """Return the curves that ever had a value; `names` of all columns."""
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
        """Return whether each row of a curve is a single sample, or a value that did not change."""
        return bool(np.array_equal(self.low(name), self.high(name), equal_nan=True))


@dataclass(frozen=True, slots=True)
class CurvesOfRun:
    """All curves of a run, and how its wake-ups are distributed."""

    cycles: Curves
    late_bins: NDArray[np.int64]
    """How many wake-ups were so many us late, shape (LATE_BINS_US + 1,); earlier ones count as 0."""
    windows: tuple[tuple[int, int], ...]
    """Where the curves of the cycles have every sample: begin and end, ns of the run's clock."""
    begin_ns: int
    end_ns: int  # From the first cycle to the last, by their deadlines


def joint_curve(field: str, joint: str) -> str:
    """Return the name of a joint's curve."""
    return f"{field} {joint}"


class CurveCollector:
    """Takes a log slice by slice; `worst_ns`: deadlines around which every sample is kept."""

    def __init__(self, worst_ns: Iterable[int] = ()) -> None:
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
        """Position goals of the cycle before, shape (joints,); None where there is none."""

    def take(self, log: Log) -> None:
        """Take the next slice."""
        if self._envelope is None:
            self._begin(log)
        if len(log.cycles):
            self._pending.append(log.cycles)
            self._waiting += len(log.cycles)
            if self._waiting >= _AT_ONCE:
                self._digest()

    def finish(self) -> CurvesOfRun:
        """Return the curves; none of a log without slices."""
        self._digest()
        rows = Envelope(0, 2, 1).rows()
        if self._envelope is not None and self._log is not None:
            kept = self._kept or [(np.zeros(0, np.int64), np.zeros((0, len(self._names)), np.float32))]
            times, samples = (np.concatenate(column) for column in zip(*kept, strict=True))
            rows = self._envelope.rows().and_samples(times, samples, self._windows)
            longest_ns = max(_GAP_NS, _GAP_PERIODS * self._log.period_ns, self._envelope.apart_ns)
            rows = rows.with_gaps(longest_ns)
        begin, end = self._span or (0, 0)
        curves = Curves.of(rows, self._names)
        return CurvesOfRun(curves, self._late_bins, tuple(self._windows), begin, end)

    def _begin(self, log: Log) -> None:
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
        self._envelope.take(times, values)
        room = self._most - sum(len(part) for part, _ in self._kept)
        inside = np.zeros(len(times), np.bool_)
        for start, stop in self._windows:
            inside |= (times >= start) & (times < stop)
        rows = np.flatnonzero(inside)[: max(0, room)]
        if len(rows):
            self._kept.append((times[rows].copy(), values[rows]))


def windows(worst_ns: Iterable[int], most: int, period_ns: int) -> list[tuple[int, int]]:
    """Return windows around cycles, apart and in order: a second each, or as long as `most` cycles allow."""
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
    """Return the values of all curves, shape (cycles, curves), in the order of their names; times in us.

    `goals`: of positions, those of the cycle before each, which a read position had been given.
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
