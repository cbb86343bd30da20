"""Curves: values of a robot over time, one column per value and one row per moment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
"""Values of shape (moments,) or (moments, columns); NaN if unknown"""

JOINT_COLUMNS = (
    *("position", "velocity", "effort"),
    *("goal_position", "goal_velocity", "goal_effort", "goal_pwm"),
    *("temperature", "voltage", "hardware_error", "mode", "torque", "valid"),
)
"""Columns of each joint, named `JOINT/position` and so on. The names are fields of the log's cycles."""
LATE, CYCLE = "loop/late", "loop/cycle"
"""Columns of the control loop: lateness of its wake-up, s, and number of the cycle"""


MOST_OF_FIELD = 40
"""Length of an array in a message up to which each element is a curve; longer arrays are skipped"""


class Curve(msgspec.Struct, frozen=True):
    """Points of one column in a span of time, downsampled for a plot"""

    name: str
    """Name of the column, such as `pan/position`"""
    time: list[float]
    """Times, s on the clock of the run, or from the first cycle of a log"""
    value: list[float | None]
    """SI value at each time; None if unknown, which interrupts the line"""


class Moment(msgspec.Struct, frozen=True):
    """Values of all columns in one cycle"""

    time: float
    """Time of the cycle, s; 0 before the first cycle, because JSON has no NaN"""
    values: list[float | None]
    """Values in the order of the columns; empty before the first cycle"""


def columns_of(
    joints: Sequence[str], states: Sequence[str], references: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the names of all columns of a robot: loop, joints, states of sources, references."""
    of_joints = [f"{joint}/{column}" for column in JOINT_COLUMNS for joint in joints]
    return (CYCLE, LATE, *of_joints, *states, *references)


class History:
    """Table in memory: a row (moment) per cycle with its time, and columns such as `pan/position`.

    For a robot it is a ring buffer of the newest `most` moments; for a log it has all moments.
    """

    def __init__(self, columns: Sequence[str], most: int) -> None:
        self.columns = tuple(columns)
        self._place = {name: place for place, name in enumerate(self.columns)}
        self._times = np.zeros(most)
        self._values = np.full((most, len(self.columns)), np.nan, np.float32)
        self._count = 0

    def append(self, time: float, values: Values) -> None:
        """Append a moment at a time (s) not before all others. A full buffer drops the oldest moment."""
        place = self._count % len(self._times)
        self._times[place] = time
        self._values[place] = values
        self._count += 1

    def fill_column(self, times: Values, name: str, values: Values) -> None:
        """Write one column for all moments of a log at once. All columns must have the same times, s."""
        self._count = len(times)
        self._times[: len(times)] = times
        self._values[: len(times), self._place[name]] = values

    def __contains__(self, name: object) -> bool:
        return name in self._place

    def __len__(self) -> int:
        return min(self._count, len(self._times))

    @property
    def span(self) -> tuple[float, float]:
        """Times of the oldest and the newest moment, s; both 0 if there are none"""
        if not len(self):
            return 0.0, 0.0
        first, last = self._times[self._rows(np.array([0, len(self) - 1]))]
        return float(first), float(last)

    def at(self, time: float | None = None) -> Moment:
        """Return the last moment not after `time` (s), or the first one if there is none.

        Without a time, return the newest moment.
        """
        if not len(self):
            return Moment(0.0, [])
        index = len(self) if time is None else max(self._index(time), 1)
        row = int(self._rows(np.array(index - 1)))
        return Moment(float(self._times[row]), plain(self._values[row]))

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return one column between two times (s) and the next point on both sides.

        It is downsampled to about `points` points.

        Downsampling keeps the minimum and the maximum of each piece, so that no peak is lost.

        Raises:
            KeyError: The column is unknown.
        """
        place = self._place[name]
        first = max(self._index(begin) - 1, 0)
        last = min(self._index(end) + 1, len(self))
        rows = self._rows(np.arange(first, last))
        return thinned(name, self._times[rows], self._values[rows, place], points)

    def _rows(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows in the ring buffer of moments that are counted from the oldest one."""
        oldest = self._count % len(self._times) if self._count > len(self._times) else 0
        return (oldest + index) % len(self._times)

    def _index(self, time: float) -> int:
        """Return the number of kept moments whose time is not after `time`, s."""
        oldest = self._count % len(self._times) if self._count > len(self._times) else 0
        first, second = self._times[oldest : self._count], self._times[:oldest]
        if len(second) and time >= second[0]:
            return len(first) + int(np.searchsorted(second, time, "right"))
        return int(np.searchsorted(first, time, "right"))


def thinned(name: str, times: Values, values: Values, points: int) -> Curve:
    """Return a curve of about `points` points: the minimum and maximum of each piece of equal length."""
    # The minimum and the maximum of each piece are kept, so that a plot never hides a short peak.
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
    """Return the numbers of a message by the names of their curves, such as `/arm/state:error[0]`.

    Args:
        message: Message as a mapping; fields of inner messages are named `outer.inner`.
        name: Text before each field's name: `TOPIC:`.

    Texts are skipped, and so are arrays with more than MOST_OF_FIELD elements.
    """
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
    """Return an array as a list for JSON, with None in place of NaN and infinity."""
    return [value if math.isfinite(value) else None for value in values.tolist()]
