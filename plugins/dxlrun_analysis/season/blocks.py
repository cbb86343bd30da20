"""Figures of a run in blocks of its cycles: how much a figure varies within the run is its noise.

A run is cut into 20 to 40 blocks of equal length, whatever it is as a whole: blocks begin short and are
joined two by two when there are too many. So memory does not grow with the run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dxlrun.log.reader import Log
from dxlrun_analysis.plan import plan_of
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing

MOST = 40
_FIRST_SIZE = 16
"""Cycles of a block at the beginning."""
_FINE = 32
"""Bins an octave: 2 % wide."""
_OCTAVES = 40
"""ns: up to 18 minutes."""
_BINS = _FINE * _OCTAVES
_FEW = 0.5
"""Share of the usual weight; a block with less (the last one, one after a gap) is left out."""
_LEVELS = {"temperature of": "deg C", "voltage of": "V"}

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
_NONE: Numbers = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """One figure of a run: as a whole, and of each block in order of time."""

    unit: str
    """us, rad, deg C, V; empty: a share from 0 to 1."""
    overall: float
    blocks: Floats

    @property
    def level(self) -> bool:
        """Whether it changes slowly, over many blocks: a temperature, a voltage."""
        return self.unit in _LEVELS.values()


class _Times:
    """Counts of times, ns, by block and bin of their logarithm."""

    def __init__(self) -> None:
        self.counts = np.zeros((MOST, _BINS), np.int32)

    def take(self, block: Numbers, values: Numbers) -> None:
        bins = np.log2(np.maximum(values, 1)) * _FINE
        np.add.at(self.counts, (block, np.minimum(bins.astype(np.int64), _BINS - 1)), 1)

    def join(self) -> None:
        self.counts = _joined(self.counts)

    def values(self, share: float) -> Floats:
        """Return a quantile of each block, ns, NaN of one with few values."""
        return np.array([_quantile(row, share) for row in self.counts[_heavy(self.counts.sum(axis=1))]])

    def overall(self, share: float) -> float:
        return _quantile(self.counts.sum(axis=0), share)


class _Sums:
    """Sums and weights by block, of one figure."""

    def __init__(self) -> None:
        self.sums, self.weights = np.zeros(MOST), np.zeros(MOST)

    def take(self, block: Numbers, values: Floats, weights: Floats) -> None:
        self.sums += np.bincount(block, values, MOST)
        self.weights += np.bincount(block, weights, MOST)

    def join(self) -> None:
        self.sums, self.weights = _joined(self.sums), _joined(self.weights)

    def values(self) -> Floats:
        """Return the mean of each block."""
        rows = _heavy(self.weights)
        found: Floats = self.sums[rows] / self.weights[rows]
        return found

    def overall(self) -> float:
        return float(self.sums.sum() / self.weights.sum())


class Blocks:
    """The figures of one run, taken slice by slice."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._size = _FIRST_SIZE
        self._times: dict[str, _Times] = {}
        self._shares: dict[str, _Sums] = {}
        self._squares: dict[str, _Sums] = {}
        self._levels: dict[str, _Sums] = {}
        self._units: dict[str, str] = {}
        """Of the squares' roots"""
        self._pairing = Pairing()
        self._goals: tuple[int, Floats] | None = None
        """Number of the newest cycle, and the goals that it sent."""

    def take(self, log: Log) -> None:
        """Take the next slice. Raises LogError when a packet in it cannot be read."""
        if len(log.cycles):
            self._cycles(log)
        self._replies(self._pairing.take(log))

    def figures(self) -> dict[str, Figure]:
        """Return the figures by name; no more slices come."""
        self._replies(self._pairing.finish())
        found: dict[str, Figure] = {}
        for name, times in self._times.items():
            for share, word in ((0.5, "median"), (0.99, "99 %")):
                found[f"{name}, {word}"] = Figure("us", times.overall(share) / 1e3, times.values(share) / 1e3)
        for name, one in self._shares.items():
            found[name] = Figure("", one.overall(), one.values())
        for name, one in self._squares.items():
            found[name] = Figure(self._units[name], math.sqrt(one.overall()), np.sqrt(one.values()))
        for name, one in self._levels.items():
            found[name] = Figure(_LEVELS[f"{name.partition(' of ')[0]} of"], one.overall(), one.values())
        return found

    def _block(self, cycle: Numbers) -> Numbers:
        """Return the block of each cycle, by its number; blocks are joined until there is one for each."""
        if self._first is None:
            self._first = int(cycle[0])
        ahead = np.maximum(cycle - self._first, 0)
        while int(ahead.max(initial=0)) // self._size >= MOST:
            self._size *= 2
            for stores in (self._times, self._shares, self._squares, self._levels):
                for store in stores.values():
                    store.join()
        found: Numbers = ahead // self._size
        return found

    def _cycles(self, log: Log) -> None:
        cycles = log.cycles
        block = self._block(cycles["cycle"].astype(np.int64))
        steps = {
            "wake-up latency": cycles["woken_ns"] - cycles["scheduled_ns"],
            "read": cycles["read_ns"] - cycles["woken_ns"],
            "update": cycles["updated_ns"] - cycles["read_ns"],
            "write": cycles["written_ns"] - cycles["updated_ns"],
        }
        for name, values in steps.items():
            self._times.setdefault(name, _Times()).take(block, values)
        for index, controller in enumerate(log.controllers):
            took = cycles["controller_ns"][:, index]
            if took.any():
                ran = took > 0
                name = f"update of {controller.name}"
                self._times.setdefault(name, _Times()).take(block[ran], took[ran])
        skipped = cycles["skipped"].astype(np.float64)
        self._shares.setdefault("skipped periods", _Sums()).take(block, skipped, skipped + 1)
        self._joints(log, block)

    def _joints(self, log: Log, block: Numbers) -> None:
        cycles = log.cycles
        number, goals = cycles["cycle"], cycles["goal_position"]
        before = np.full(goals.shape, np.nan)
        before[1:] = np.where(np.diff(number)[:, None] == 1, goals[:-1], np.nan)
        if self._goals is not None and number[0] == self._goals[0] + 1:
            before[0] = self._goals[1]
        self._goals = int(number[-1]), goals[-1].copy()
        error = np.where(cycles["valid"], cycles["position"], np.nan) - before
        columns = (
            ("tracking error of", self._squares, error**2),
            ("temperature of", self._levels, cycles["temperature"]),
            ("voltage of", self._levels, cycles["voltage"]),
        )
        plan = plan_of(log)
        for row, joint in enumerate(log.joints):
            self._units[f"tracking error of {joint}"] = plan.joint(joint).unit
            for name, sums, values in columns:
                known = np.isfinite(values[:, row])
                if known.any():
                    one = sums.setdefault(f"{name} {joint}", _Sums())
                    one.take(block[known], values[known, row], np.ones(int(known.sum())))

    def _replies(self, exchanges: Exchanges | None) -> None:
        """Take reply times, and requests that had none, of each servo in the cycles."""
        if exchanges is None:
            return
        in_cycle = exchanges.cycle >= 0
        if not in_cycle.any():
            return
        replies = exchanges.replies
        block = self._block(np.where(in_cycle, exchanges.cycle, exchanges.cycle[in_cycle][0]))
        answers = np.flatnonzero(replies.answers & in_cycle[replies.exchange])
        of, servo_id = replies.exchange[answers], replies.servo_id[answers]
        took_ns = replies.last_ns[answers] - exchanges.asked_ns[of]
        asked = exchanges.asks[exchanges.request] & (in_cycle & exchanges.ended)[:, None]
        for index, bus in enumerate(exchanges.buses):
            mine = exchanges.bus == index
            joints = {servo.servo_id: servo.own_name for servo in bus.servos}
            for each in np.flatnonzero(asked[mine].any(axis=0)).tolist():
                name = joints.get(each) or f"servo {each} on bus {bus.name}"
                rows = np.flatnonzero(mine[of] & (servo_id == each))
                self._times.setdefault(f"reply of {name}", _Times()).take(block[of[rows]], took_ns[rows])
                requests = np.flatnonzero(mine & asked[:, each])
                lost = ~np.isin(requests, of[rows])
                sums = self._shares.setdefault(f"lost replies of {name}", _Sums())
                sums.take(block[requests], lost.astype(np.float64), np.ones(len(requests)))


def _joined(values: NDArray[Any]) -> NDArray[Any]:
    """Return rows joined two by two; the second half is empty."""
    joined = np.zeros_like(values)
    joined[: MOST // 2] = values[0::2] + values[1::2]
    return joined


def _heavy(weights: NDArray[Any]) -> NDArray[np.int64]:
    """Return the blocks that have no less than half of what the usual one has."""
    used = weights[weights > 0]
    return np.flatnonzero(weights >= max(_FEW * float(np.median(used)), 1e-9)) if len(used) else _NONE


def _quantile(counts: NDArray[np.int32], share: float) -> float:
    """Return a quantile by the counts of bins, ns; times are spread evenly in their bin."""
    ends = np.cumsum(counts)
    if not ends[-1]:
        return 0.0
    rank = share * float(ends[-1])
    index = int(np.searchsorted(ends, rank))
    inside = (rank - float(ends[index] - counts[index])) / float(counts[index])
    return float(2 ** ((index + inside) / _FINE)) if index else 0.0
