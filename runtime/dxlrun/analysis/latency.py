"""How well the loop kept its time: wake-up latency, duration of each step, skipped periods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.recording.reader import Log

ROUGH_NS = 150_000
"""A wake-up later than this does not happen on a real-time kernel (M. A. Araujo, UFU 2017)."""

_MS = 1_000_000
_MOST_RATES = 4
"""More are not said one by one."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Lateness of the wake-ups (woken - scheduled), us; shares from 0 to 1."""

    max_us: float
    mean_us: float
    deviation_us: float
    """Standard deviation of the population."""
    mode_us: int
    """Lower edge of the fullest bin of 1 us; the smallest where several are as full."""
    share_over_150_us: float
    share_over_1_ms: float
    share_over_period: float


@dataclass(frozen=True, slots=True)
class Duration:
    """How long one step of the cycle, or one controller's update, took, us."""

    name: str
    cycles: int
    median_us: float
    p99_us: float
    max_us: float


@dataclass(frozen=True, slots=True)
class Periods:
    """Where the periods of the run went; `elapsed` counts from the first deadline to the last record."""

    elapsed: int
    records: int
    skipped: int
    """Declared skipped by the loop."""
    missing: int
    """Elapsed, but neither recorded nor declared skipped; 0 in a whole log."""
    agree: bool
    """records + skipped = elapsed, and each record declares what is missing right before it."""
    rate_hz: float
    """At the start."""
    seconds: float
    rates_hz: tuple[float, ...] = ()
    """Every rate at which cycles ran, in the order in which they came first."""

    @property
    def rates(self) -> str:
        """The rates in words."""
        rates = self.rates_hz or (self.rate_hz,)
        if len(rates) > _MOST_RATES:
            return f"{len(rates)} rates from {min(rates):g} to {max(rates):g} Hz"
        *others, last = (f"{rate:g} Hz" for rate in rates)
        return f"{', '.join(others)} and {last}" if others else last


def on_virtual_time(log: Log) -> bool:
    """Tell whether the run's clock was virtual: its times are computed, and say nothing of this machine."""
    return log.metadata.get("run", {}).get("clock") == "virtual"


def first_deadline_ns(log: Log) -> int:
    """Return the loop's first deadline; the time of the first event in a log without cycles."""
    if log.activation is not None:
        return int(log.activation["scheduled_ns"][0])
    if len(log.cycles):
        first = log.cycles[0]
        return int(first["scheduled_ns"]) - int(first["cycle"]) * log.period_ns
    return log.events[0].t_ns if log.events else 0


def cycle_periods_ns(log: Log) -> NDArray[np.int64]:
    """Return the period in which each cycle ran, ns: the time to the next deadline, shape (cycles,).

    A change of the rate holds from the cycle that took it. Where cycles are lost it is a mean over them.
    """
    numbers, due = log.cycles["cycle"], log.cycles["scheduled_ns"]
    if len(numbers) < 2:
        return np.full(len(numbers), log.period_ns, dtype=np.int64)
    between = np.diff(due) // np.maximum(np.diff(numbers), 1)
    return np.append(between, between[-1])


def latency(log: Log) -> Latency | None:
    """Return the statistics of the wake-ups; None without cycles."""
    late = (log.cycles["woken_ns"] - log.cycles["scheduled_ns"]).astype(np.int64)
    if not len(late):
        return None
    bins, counts = np.unique(late // 1000, return_counts=True)
    return Latency(
        max_us=float(late.max()) / 1e3,
        mean_us=float(late.mean()) / 1e3,
        deviation_us=float(late.std()) / 1e3,
        mode_us=int(bins[np.argmax(counts)]),
        share_over_150_us=float(np.mean(late > ROUGH_NS)),
        share_over_1_ms=float(np.mean(late > _MS)),
        share_over_period=float(np.mean(late > cycle_periods_ns(log))),
    )


def durations(log: Log) -> tuple[Duration, ...]:
    """Return read, update, write and their sum, from the wake-up on; empty without cycles."""
    cycles = log.cycles
    if not len(cycles):
        return ()
    steps = {
        "read": cycles["read_ns"] - cycles["woken_ns"],
        "update": cycles["updated_ns"] - cycles["read_ns"],
        "write": cycles["written_ns"] - cycles["updated_ns"],
        "cycle": cycles["written_ns"] - cycles["woken_ns"],
    }
    return tuple(_duration(name, values) for name, values in steps.items())


def controller_durations(log: Log) -> tuple[Duration, ...]:
    """Return the update of each controller over the cycles in which it was updated."""
    found = []
    for index, controller in enumerate(log.controllers):
        values = log.cycles["controller_ns"][:, index]
        found.append(_duration(controller.name, values[values > 0]))
    return tuple(found)


def _duration(name: str, values: NDArray[np.int64]) -> Duration:
    if not len(values):
        return Duration(name, 0, 0.0, 0.0, 0.0)
    median, p99 = np.percentile(values, [50, 99])
    return Duration(name, len(values), float(median) / 1e3, float(p99) / 1e3, float(values.max()) / 1e3)


def periods(log: Log) -> Periods:
    """Return the account of the periods: none may vanish."""
    numbers, skipped = log.cycles["cycle"], log.cycles["skipped"]
    records, declared = len(numbers), int(skipped.sum())
    elapsed = int(numbers[-1]) + 1 if records else 0
    steps = np.diff(numbers, prepend=-1) - 1
    each = cycle_periods_ns(log)
    end_ns = int(log.cycles["scheduled_ns"][-1] + each[-1]) if records else 0
    return Periods(
        elapsed=elapsed,
        records=records,
        skipped=declared,
        missing=elapsed - records - declared,
        agree=bool(np.array_equal(steps, skipped)),
        rate_hz=1e9 / log.period_ns,
        seconds=(end_ns - first_deadline_ns(log)) / 1e9 if records else 0.0,
        rates_hz=tuple(1e9 / period for period in dict.fromkeys(each.tolist()) if period > 0),
    )
