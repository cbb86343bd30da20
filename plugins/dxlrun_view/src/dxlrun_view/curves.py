"""Curves: what a page draws of a robot, one column a value that changes, one row a moment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
"""Shape (moments,) or (moments, columns); NaN: not known."""

JOINT_COLUMNS = (
    *("position", "velocity", "effort"),
    *("goal_position", "goal_velocity", "goal_effort", "goal_pwm"),
    *("temperature", "voltage", "hardware_error", "mode", "torque", "valid"),
)
"""Of each joint, as `JOINT/position`; the names are those of the log's cycles."""
LATE, CYCLE = "loop/late", "loop/cycle"
"""Columns of the loop: how late it woke up, s, and the number of its cycle."""


MOST_OF_FIELD = 40
"""Numbers of one field of a message that can be drawn."""


class Curve(msgspec.Struct, frozen=True):
    """One column in a span of time, thinned to what a plot can show."""

    name: str
    time: list[float]
    """s, as the page has them."""
    value: list[float | None]
    """None: not known."""


class Moment(msgspec.Struct, frozen=True):
    """All columns at one time."""

    time: float
    """s; NaN is no JSON: a robot without a cycle yet has time 0 and no values."""
    values: list[float | None]
    """In the order of the columns."""


def columns_of(
    joints: Sequence[str], states: Sequence[str], references: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the names of all columns of a robot, in their order."""
    of_joints = [f"{joint}/{column}" for column in JOINT_COLUMNS for joint in joints]
    return (CYCLE, LATE, *of_joints, *states, *references)


class History:
    """The newest moments of a robot in memory that does not grow, or all moments of a log."""

    def __init__(self, columns: Sequence[str], most: int) -> None:
        self.columns = tuple(columns)
        self._place = {name: place for place, name in enumerate(self.columns)}
        self._times = np.zeros(most)
        self._values = np.full((most, len(self.columns)), np.nan, np.float32)
        self._count = 0

    def append(self, time: float, values: Values) -> None:
        """Add a moment behind the others, whose times are smaller; the oldest leaves."""
        place = self._count % len(self._times)
        self._times[place] = time
        self._values[place] = values
        self._count += 1

    def fill(self, times: Values, name: str, values: Values) -> None:
        """Write one column of all moments at once; every column gets the same times."""
        self._count = len(times)
        self._times[: len(times)] = times
        self._values[: len(times), self._place[name]] = values

    def __contains__(self, name: object) -> bool:
        return name in self._place

    def __len__(self) -> int:
        return min(self._count, len(self._times))

    @property
    def span(self) -> tuple[float, float]:
        """Time of the oldest and of the newest moment, s; both 0 while there is none."""
        if not len(self):
            return 0.0, 0.0
        first, last = self._times[self._rows(np.array([0, len(self) - 1]))]
        return float(first), float(last)

    def at(self, time: float | None = None) -> Moment:
        """Return the last moment until a time, or the first; without a time the newest."""
        if not len(self):
            return Moment(0.0, [])
        index = len(self) if time is None else max(self._index(time), 1)
        row = int(self._rows(np.array(index - 1)))
        return Moment(float(self._times[row]), plain(self._values[row]))

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return one column between two times, at most about so many points: of each piece its smallest and
        its largest value, so that no peak is lost.

        Raises KeyError for a column that there is not.
        """
        place = self._place[name]
        first = max(self._index(begin) - 1, 0)
        last = min(self._index(end) + 1, len(self))
        rows = self._rows(np.arange(first, last))
        return thinned(name, self._times[rows], self._values[rows, place], points)

    def _rows(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return where moments are, whose indices count from the oldest."""
        oldest = self._count % len(self._times) if self._count > len(self._times) else 0
        return (oldest + index) % len(self._times)

    def _index(self, time: float) -> int:
        """Return how many moments were until a time."""
        oldest = self._count % len(self._times) if self._count > len(self._times) else 0
        first, second = self._times[oldest : self._count], self._times[:oldest]
        if len(second) and time >= second[0]:
            return len(first) + int(np.searchsorted(second, time, "right"))
        return int(np.searchsorted(first, time, "right"))


def thinned(name: str, times: Values, values: Values, points: int) -> Curve:
    """Return a curve of at most `points` points: where there are more, the extremes of each piece."""
    if len(times) > max(points, 2):
        pieces = np.array_split(np.arange(len(times)), max(points // 2, 1))
        kept: list[int] = []
        for piece in pieces:
            known = piece[np.isfinite(values[piece])]
            chosen = known[[np.argmin(values[known]), np.argmax(values[known])]] if len(known) else piece[:1]
            kept += sorted(set(chosen.tolist()))
        times, values = times[kept], values[kept]
    return Curve(name, np.round(times, 6).tolist(), plain(values))


def numbers_in(message: Mapping[str, object], name: str) -> dict[str, float]:
    """Return the numbers of a message by their curves: `/arm/state:error[0]`; of long arrays none."""
    found: dict[str, float] = {}
    for field, value in message.items():
        if isinstance(value, Mapping):
            inner = numbers_in(value, "")
            found |= {f"{name}{field}.{each}": number for each, number in inner.items()}
        elif isinstance(value, int | float | np.number | np.bool_):
            found[f"{name}{field}"] = float(value)
        elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes):
            row = np.asarray(value)
            if row.ndim == 1 and row.dtype.kind in "biuf" and 0 < len(row) <= MOST_OF_FIELD:
                found |= {f"{name}{field}[{place}]": float(one) for place, one in enumerate(row)}
    return found


def plain(values: Values) -> list[float | None]:
    """Return numbers of JSON: what is none becomes None."""
    return [value if math.isfinite(value) else None for value in values.tolist()]
