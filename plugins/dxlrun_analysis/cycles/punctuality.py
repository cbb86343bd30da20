"""Punctuality of the control loop: lateness of wake-ups, duration of each step, skipped periods."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.records import RING_SECONDS
from dxlrun_analysis.counts import Counts, median, quantile
from dxlrun_analysis.plan_excerpt import plan_of

ROUGH_NS = 150_000
"""Bound above which a wake-up counts as late: 150 us, a lateness that does not occur on a real-time Linux
kernel (M. A. Araujo, UFU 2017)."""

DISORDER_NS = RING_SECONDS * 1_000_000_000
"""Greatest time by which a record of a log can be out of order. The recorder drains several rings in turn,
and each ring holds at most this time."""
_MS = 1_000_000
LATE_BINS_US = 100_000  # Wake-ups are counted in bins of 1 us; the last bin has all later ones
_TENTH_NS = 100  # Resolution of counted times: 0.1 us
_MOST_RATES = 4  # A longer list of rates is shown as a range
_MOST_KEPT = 1000  # Number of distinct rates that are kept
_LATEST_NS = 1 << 43  # Clip for lateness from damaged times: more than two hours
_LOW = 20  # Bits of the low part; parts are squared separately so that sums fit into 64 bits


@dataclass(frozen=True, slots=True)
class Latency:
    """Lateness of the loop's wake-ups (actual minus scheduled time) in a run, us; shares from 0 to 1."""

    max_us: float
    mean_us: float
    deviation_us: float  # Standard deviation of the population
    mode_us: int  # Lower edge of the fullest bin of 1 us, the smallest of equal ones
    share_over_150_us: float
    share_over_1_ms: float
    share_over_period: float
    # Counted in steps of 0.1 us; earlier wake-ups count as 0
    median_us: float = 0.0
    p99_us: float = 0.0
    p999_us: float = 0.0


@dataclass(frozen=True, slots=True)
class StepDuration:
    """Duration of one step of the cycle, or of the update of one controller, over all cycles of a run, us.

    Durations are counted in steps of 0.1 us; `counts.py` defines the quantiles.
    """

    name: str
    cycles: int
    median_us: float
    p99_us: float
    max_us: float


@dataclass(frozen=True, slots=True)
class LongCycle:
    """Durations of the steps of the cycle that exceeded its period most in a run, ns."""

    period_ns: int
    read_ns: int
    update_ns: int
    write_ns: int

    @property
    def lasted_ns(self) -> int:
        """Duration of the cycle, from its wake-up to its last write."""
        return self.read_ns + self.update_ns + self.write_ns

    @property
    def exceeded_ns(self) -> int:
        """Duration of the cycle minus its period."""
        return self.lasted_ns - self.period_ns


@dataclass(frozen=True, slots=True)
class Periods:
    """Number of periods in a run that were recorded as cycles, skipped by the loop, or missing in the log.

    `elapsed` counts from the first deadline to the last record. If the first part of a log is missing, it
    counts from the first record.
    """

    elapsed: int
    records: int
    skipped: int  # Declared skipped by the loop
    missing: int  # Elapsed, but neither recorded nor declared skipped; 0 in a complete log
    agree: bool  # records + skipped = elapsed, and each record declares the periods skipped right before it
    rate_hz: float  # At the start
    seconds: float
    rates_hz: tuple[float, ...] = ()  # Rates at which cycles ran, in order of first occurrence
    begin_ns: int = 0  # First deadline; in a log without cycles, the time of the first event

    @property
    def rates(self) -> str:
        """Rates at which the loop ran, as text: `100 Hz and 50 Hz`, or a range."""
        rates = self.rates_hz or (self.rate_hz,)
        if len(rates) > _MOST_RATES:
            return f"{len(rates)} rates from {min(rates):g} to {max(rates):g} Hz"
        *others, last = (f"{rate:g} Hz" for rate in rates)
        return f"{', '.join(others)} and {last}" if others else last


def on_virtual_time(log: Log) -> bool:
    """Return whether the loop of the run had a virtual clock: its times are computed, not measured."""
    return log.metadata.get("run", {}).get("clock") == "virtual"


def first_deadline_ns(log: Log) -> int:
    """Return the deadline of the loop's first cycle on the run's clock, ns. In a log without cycles,
    return the time of the first event, or 0."""
    if log.activation is not None:
        return int(log.activation["scheduled_ns"][0])
    if len(log.cycles):
        first = log.cycles[0]
        return int(first["scheduled_ns"]) - int(first["cycle"]) * log.period_ns
    return log.events[0].t_ns if log.events else 0


def begins(log: Log) -> bool:
    """Return whether this slice of a log has a cycle or the activation of the controllers, so that
    `first_deadline_ns` is exact."""
    return log.activation is not None or len(log.cycles) > 0


def late_bins(late_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count wake-ups by lateness, in bins of 1 us; shape (LATE_BINS_US + 1,). Early wake-ups are in the
    first bin, all beyond 100 ms in the last."""
    return np.bincount(np.clip(late_ns // 1000, 0, LATE_BINS_US), minlength=LATE_BINS_US + 1)


def cycle_periods_ns(log: Log) -> NDArray[np.int64]:
    """Return the period of each cycle, ns: the time from its deadline to the next one, shape (cycles,).

    A changed rate applies from the cycle that executed the change. Across missing cycles the period is a
    mean. In a sequential schedule it counts from the wake-up, not from the deadline.
    """
    if len(log.cycles) < 2:
        return np.full(len(log.cycles), log.period_ns, dtype=np.int64)
    between = _between_ns(log.cycles, sequential=_is_sequential(log))
    return np.append(between, between[-1])


def _is_sequential(log: Log) -> bool:
    return plan_of(log).loop.schedule == "sequential"


def _between_ns(cycles: NDArray[np.void], *, sequential: bool) -> NDArray[np.int64]:
    """Return the time from each cycle's deadline to the next deadline, ns, shape (cycles - 1,); a mean across
    missing cycles.

    In a sequential schedule it counts from the wake-up of a cycle, not from its deadline.
    """
    due = cycles["scheduled_ns"]
    counted_from = cycles["woken_ns"] if sequential else due
    between: NDArray[np.int64] = (due[1:] - counted_from[:-1]) // np.maximum(np.diff(cycles["cycle"]), 1)
    return between


STEPS = (
    ("read", "woken_ns", "read_ns"),
    ("update", "read_ns", "updated_ns"),
    ("write", "updated_ns", "written_ns"),
    ("cycle", "woken_ns", "written_ns"),
)
"""Steps of a cycle: name, and the fields of the cycle record with its begin and end. The last, `cycle`, is
the sum of the others."""


class Durations:
    """Accumulator of the durations of cycle steps and controller updates, fed slice by slice."""

    def __init__(self) -> None:
        self._took = Counts()  # In steps of 0.1 us; groups are the steps, then the controllers
        self._controllers: tuple[str, ...] = ()

    def add_slice(self, log: Log) -> None:
        """Add the durations of all cycles in the next slice of the log."""
        self._controllers = tuple(controller.name for controller in log.controllers)
        cycles = log.cycles
        steps = [cycles[end] - cycles[begin] for _, begin, end in STEPS]
        updates = [column[column > 0] for column in cycles["controller_ns"].T]
        for group, took_ns in enumerate((*steps, *updates)):
            self._took.count_values(np.full(len(took_ns), group), np.maximum(took_ns, 0) // _TENTH_NS)

    def compute_durations(self) -> tuple[tuple[StepDuration, ...], tuple[StepDuration, ...]]:
        """Return the durations of the steps of the cycle, and those of the controllers' updates.

        Returns:
            Read, update, write and their sum, empty without cycles; and the update of each controller
                over the cycles in which it was updated.
        """
        steps = [self._duration(number, name) for number, (name, _, _) in enumerate(STEPS)]
        updates = (self._duration(number, name) for number, name in enumerate(self._controllers, len(STEPS)))
        return tuple(step for step in steps if step.cycles), tuple(updates)

    def _duration(self, group: int, name: str) -> StepDuration:
        values, counts = self._took.counts_of(group)
        found = (median(values, counts), quantile(values, counts, 0.99), int(values.max(initial=0)))
        return StepDuration(name, int(counts.sum()), *(tenths / 10 for tenths in found))


_TIMES = ("cycle", "scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns", "skipped")
"""Fields of a cycle record that `Punctuality` uses; the fields per joint are not needed."""
_WHOLE = np.dtype([(name, np.int64) for name in _TIMES])


class Punctuality:
    """Accumulator of the wake-up latency and skipped periods, fed slice by slice in constant memory."""

    def __init__(self) -> None:
        self._held: NDArray[np.void] | None = None  # Newest cycle: its period ends with the next one
        self._records = self._skipped = self._elapsed = 0
        self._agree = True
        self._start = 0  # Number of the first period that counts
        self._first, self._sequential = True, False
        self._begin_ns = self._from_ns = self._end_ns = 0
        self._nominal_ns = self._period_ns = 1
        self._sum = self._squares = self._max_ns = 0
        self._over = [0, 0, 0]
        self._bins = np.zeros(LATE_BINS_US + 1, np.int64)
        self._late = Counts()  # In steps of 0.1 us, one group
        self._rates: dict[int, None] = {}
        self.slowest: LongCycle | None = None  # Cycle that exceeded its period most, or None

    def add_slice(self, log: Log) -> None:
        """Add the cycles of the next slice of the log."""
        if self._first:
            self._begin_ns = self._from_ns = first_deadline_ns(log)
            self._nominal_ns = self._period_ns = log.period_ns
            self._sequential = _is_sequential(log)
            self._first = not begins(log)
        cycles = log.cycles[list(_TIMES)].astype(_WHOLE)
        cycles = cycles if self._held is None else np.concatenate([self._held, cycles])
        if not len(cycles):
            return
        if self._held is None and log.part:
            first = cycles[0]
            self._start = self._elapsed = int(first["cycle"] - first["skipped"])
            self._from_ns = int(first["scheduled_ns"] - first["skipped"] * log.period_ns)
        self._held = cycles[-1:].copy()
        if len(cycles) > 1:
            self._count(cycles[:-1], _between_ns(cycles, sequential=self._sequential))

    def _count(self, cycles: NDArray[np.void], each: NDArray[np.int64]) -> None:
        numbers, skipped = cycles["cycle"], cycles["skipped"]
        steps = np.diff(numbers, prepend=self._elapsed - 1) - 1
        self._agree &= bool((steps == skipped).all())
        self._records += len(numbers)
        self._skipped += int(skipped.sum())
        self._elapsed = int(numbers[-1]) + 1
        self._period_ns = int(each[-1])
        self._end_ns = int(cycles["scheduled_ns"][-1]) + self._period_ns
        rates, first = np.unique(each, return_index=True)
        if len(self._rates) < _MOST_KEPT:
            self._rates.update(dict.fromkeys(rates[np.argsort(first)][:_MOST_KEPT].tolist()))
        late = np.minimum(cycles["woken_ns"] - cycles["scheduled_ns"], _LATEST_NS)
        # Exact integer sums avoid the cancellation in count * squares - sum^2.
        high, low = np.abs(late) >> _LOW, np.abs(late) & ((1 << _LOW) - 1)
        self._sum += int(late.sum())
        parts = (int((high * high).sum()), int((high * low).sum()), int((low * low).sum()))
        self._squares += (parts[0] << 2 * _LOW) + (parts[1] << _LOW + 1) + parts[2]
        self._max_ns = max(self._max_ns, int(late.max()))
        for index, limit in enumerate((ROUGH_NS, _MS, each)):
            self._over[index] += int(np.count_nonzero(late > limit))
        self._bins += late_bins(late)
        self._late.count_values(np.zeros(len(late), np.int64), np.maximum(late, 0) // _TENTH_NS)
        exceeded = cycles["written_ns"] - cycles["woken_ns"] - each
        worst = int(np.argmax(exceeded))
        if exceeded[worst] > (0 if self.slowest is None else self.slowest.exceeded_ns):
            times = [int(cycles[name][worst]) for name in ("woken_ns", "read_ns", "updated_ns", "written_ns")]
            read, update, write = (end - begin for begin, end in itertools.pairwise(times))
            self.slowest = LongCycle(int(each[worst]), read, update, write)

    def compute_latency(self) -> tuple[Periods, Latency | None]:
        """Return the number of recorded, skipped and missing periods, and the lateness of the wake-ups,
        which is None without cycles."""
        if self._held is not None:
            self._count(self._held, np.full(1, self._period_ns, np.int64))
            self._held = None
        rates = tuple(1e9 / period for period in self._rates if period > 0)
        elapsed = self._elapsed - self._start
        account = Periods(
            elapsed=elapsed,
            records=self._records,
            skipped=self._skipped,
            missing=elapsed - self._records - self._skipped,
            agree=self._agree,
            rate_hz=1e9 / self._nominal_ns,
            seconds=(self._end_ns - self._from_ns) / 1e9 if self._records else 0.0,
            rates_hz=rates,
            begin_ns=self._begin_ns,
        )
        return account, self._latency() if self._records else None

    def _latency(self) -> Latency:
        count = self._records
        mean = self._sum / count
        tenths = self._late.counts_of(0)
        return Latency(
            max_us=self._max_ns / 1e3,
            mean_us=mean / 1e3,
            deviation_us=math.sqrt(max(0, count * self._squares - self._sum**2)) / count / 1e3,
            mode_us=int(np.argmax(self._bins)),
            share_over_150_us=self._over[0] / count,
            share_over_1_ms=self._over[1] / count,
            share_over_period=self._over[2] / count,
            median_us=median(*tenths) / 10,
            p99_us=quantile(*tenths, 0.99) / 10,
            p999_us=quantile(*tenths, 0.999) / 10,
        )
