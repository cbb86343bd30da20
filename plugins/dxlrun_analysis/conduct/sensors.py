"""Sensors that hang: no value changes while joints move, for much longer than ever before."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun.log.reader import Log
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan import plan_of

_HANGS_S = 1.0
_TIMES_LONGER = 10
"""Than ever before: those of a switch stay for long, and of a simulated sensor without noise at rest."""
_MOVED_RAD = 0.1
"""A robot at rest may have a sensor, a simulated one, that measures the same."""


@dataclass(slots=True)
class _Sensor:
    begin_ns: int
    since_ns: int
    """The last change."""
    values: Floats
    position: Floats
    """Of the joints, at that change."""
    longest_ns: int = 0
    """Between two changes."""
    hung_s: float = 0.0
    from_s: float = 0.0

    def take(self, at_ns: NDArray[np.int64], values: Floats, position: Floats) -> None:
        """Take values in cycles, shape (cycles, states), with where the joints were."""
        changed = (np.vstack([self.values, values[:-1]]) != values).any(axis=1)
        rows = np.flatnonzero(changed)
        times = np.concatenate([[self.since_ns], at_ns[rows], at_ns[-1:]])
        gaps = np.diff(times)
        longest = np.maximum.accumulate(np.append(self.longest_ns, gaps))
        for gap in np.flatnonzero(gaps > max(_HANGS_S, self.hung_s) * 1e9).tolist():
            begin, end = times[gap : gap + 2].tolist()
            there = position[rows[gap - 1]] if gap else self.position
            during = position[(at_ns >= begin) & (at_ns <= end)]
            moved = np.abs(during - there).max(initial=0.0) > _MOVED_RAD
            if longest[gap] and moved and end - begin > _TIMES_LONGER * longest[gap]:
                self.hung_s, self.from_s = (end - begin) * 1e-9, (begin - self.begin_ns) * 1e-9
        if len(rows):
            self.since_ns, self.position = int(at_ns[rows[-1]]), position[rows[-1]].copy()
        self.longest_ns = int(longest[-2])  # the last one may go on
        self.values = values[-1].copy()


class Sensors:
    """Finds sensors that hang, in memory that does not grow with the log."""

    def __init__(self) -> None:
        self._sensors: dict[str, _Sensor] = {}

    def take(self, log: Log) -> None:
        """Take the cycles of the next slice."""
        for name in {one.name for one in plan_of(log).loop.sensors} & log.header.sources.keys():
            valid = log.cycles["source_valid"][:, list(log.header.sources).index(name)]
            values = np.nan_to_num(log.cycles["source_state"][valid][:, log.header.layout.source_slice(name)])
            at_ns, position = log.cycles["read_ns"][valid], np.nan_to_num(log.cycles["position"][valid])
            if len(values) and values.shape[1]:
                begin = _Sensor(int(at_ns[0]), int(at_ns[0]), values[0], position[0])
                self._sensors.setdefault(name, begin).take(at_ns, values, position)

    def findings(self) -> Iterable[Finding]:
        """Name the sensors that hung."""
        for name, one in self._sensors.items():
            if one.hung_s:
                yield Finding(
                    "sensor_hangs",
                    name,
                    f"Sensor {name} hangs: all its values were the same for {one.hung_s:.1f} s while joints "
                    f"moved, from {one.from_s:.1f} s of the run on, and changed all the time before.",
                    "Look at its driver and its plug: samples came, but nothing was measured.",
                    Rank.SERVO_CAUSE,
                    5.0,
                )
