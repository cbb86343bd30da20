"""What a run's log says about a motion that was sent: when it ended, how it was followed, what was late.

A cycle is *late* by the time from the first deadline after the cycle before began until it begins itself: if
that one took too long, from the deadline of the first skipped period. Simulated servos answer later than real
ones where their process gets no processor; what a cycle is late by that is taken from the ledger of the
simulated bus, kept apart, and subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Log
from dxlrun_analysis.cycles.latency import ROUGH_NS
from dxlrun_lab.late_servos import waits_for_servos
from dxlrun_lab.tracking.motion import DesiredMotion
from dxlrun_lab.tracking.setups import Setup
from dxlsim import LedgerEntry

Longs = NDArray[np.int64]
LATE_NS = ROUGH_NS


class Curves(msgspec.Struct, frozen=True):
    """The cycles of a motion, shape (cycles,); times in s since it began."""

    due_s: Floats
    """The first deadline after the cycle before began."""
    woken_s: Floats
    sent_s: Floats
    sent: Floats
    """rad"""
    read_s: Floats
    read: Floats
    """rad; NaN where no reply came."""
    velocity: Floats
    """rad/s, as read"""
    late_us: Floats
    """Without what the simulated bus was late."""

    @property
    def worst(self) -> int:
        """The cycle that was latest."""
        return int(self.late_us.argmax())


class Tracked(msgspec.Struct, frozen=True):
    """The numbers of one set-up. Lateness and drift are measured; `*_by_bus` is the part of it that the
    simulated bus caused, None on a real one."""

    setup: str
    title: str
    thesis: str
    """Which figures of the thesis show this set-up."""
    log: str
    ended: bool
    """The whole motion was sent; else only its begin was measured."""
    cycles: int
    """From the first to the last that sent a pose of the motion."""
    duration_ns: int
    """From the first pose to the end of the motion, or as far as it came."""
    drift_ns: int | None
    """How much longer than the motion that is; the loop may end up to 150 us before the end."""
    start_delays_ns: int | None
    """Sum of the delays with which the poses of a sequential sender began; None for the loop."""
    remainder_ns: int
    """How much longer than the motion its whole periods are."""
    last_late_ns: int
    """How late the last of these cycles was; it is part of the drift."""
    drift_by_bus_ns: int | None
    rms_rad: float
    """Of desired minus read position; desired is that of the moment of the reading."""
    worst_rad: float
    late_cycles: int
    """Later than 150 us, without the simulated bus; the next two are of these."""
    mean_late_us: float
    max_late_us: float
    late_by_bus_us: float | None
    """Of all cycles together."""
    silent_cycles: int
    """Without an intact reply; the error does not count them."""
    remarks: tuple[str, ...] = ()
    """What else must be known of this run, one sentence each."""

    @property
    def own_drift_ns(self) -> int | None:
        """The drift without what the simulated bus caused."""
        return None if self.drift_ns is None else self.drift_ns - (self.drift_by_bus_ns or 0)

    @property
    def adds_up(self) -> bool:
        """True where a sequential sender ended late by exactly the sum of its start delays."""
        return self.drift_ns is not None and self.drift_ns - self.remainder_ns == self.start_delays_ns


class Measured(msgspec.Struct, frozen=True):
    """One set-up: its numbers, and its curves."""

    tracked: Tracked
    curves: Curves


def measure(
    log: Log,
    setup: Setup,
    desired: DesiredMotion,
    ledger: Sequence[LedgerEntry] | None,
    remarks: tuple[str, ...] = (),
) -> Measured | None:
    """Measure a motion in the log of its run; None where the run ended before it began.

    `ledger`: what simulated buses saw; None: the buses are real.
    """
    span = _span(log, setup, desired)
    if span is None:
        return None
    cycles = log.cycles[span.first : span.stop]
    late_ns = _late_ns(log, setup)
    by_bus = np.zeros(len(late_ns), np.int64) if ledger is None else _by_bus(log, late_ns, ledger)
    late_ns, by_bus = late_ns[span.first : span.stop], by_bus[span.first : span.stop]
    own_us = (late_ns - by_bus) / 1e3
    row = log.joints.index(desired.joint)
    seconds = {name: (cycles[name] - span.begin_ns) / 1e9 for name in ("woken_ns", "read_ns", "written_ns")}
    valid = cycles["valid"][:, row]
    curves = Curves(
        due_s=seconds["woken_ns"] - late_ns / 1e9,
        woken_s=seconds["woken_ns"],
        sent_s=seconds["written_ns"],
        sent=cycles["goal_position"][:, row],
        read_s=seconds["read_ns"],
        read=np.where(valid, cycles["position"][:, row], np.nan),
        velocity=np.where(valid, cycles["velocity"][:, row], np.nan),
        late_us=own_us,
    )
    error = (desired.at(curves.read_s)[0] - curves.read)[valid]
    late = own_us[own_us > LATE_NS / 1e3]
    sequential = setup.schedule == "sequential"
    delays = (cycles["woken_ns"] - cycles["scheduled_ns"])[1:]
    drift_by_bus = int(by_bus[1:].sum()) if sequential else int(by_bus[-1])
    tracked = Tracked(
        setup=setup.name,
        title=setup.title,
        thesis=setup.thesis,
        log=str(log.path),
        ended=span.ended,
        cycles=len(cycles),
        duration_ns=int(cycles["woken_ns"][-1]) - span.begin_ns,
        drift_ns=int(cycles["woken_ns"][-1]) - span.begin_ns - desired.duration_ns if span.ended else None,
        start_delays_ns=int(delays.sum()) if sequential else None,
        remainder_ns=-desired.duration_ns % log.period_ns,
        last_late_ns=int(late_ns[-1]),
        drift_by_bus_ns=None if ledger is None or not span.ended else drift_by_bus,
        rms_rad=float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        worst_rad=float(np.abs(error).max(initial=0.0)),
        late_cycles=len(late),
        mean_late_us=float(late.mean()) if len(late) else 0.0,
        max_late_us=float(late.max(initial=0.0)),
        late_by_bus_us=None if ledger is None else float(by_bus.sum()) / 1e3,
        silent_cycles=int(np.count_nonzero(~valid)),
        remarks=remarks,
    )
    return Measured(tracked, curves)


class _Span(NamedTuple):
    """Where a motion is in a log."""

    begin_ns: int
    first: int
    """Index of the cycle that sent the first pose, and behind the one that sent the last."""
    stop: int
    ended: bool


def _span(log: Log, setup: Setup, desired: DesiredMotion) -> _Span | None:
    """Return the motion's cycles; None where it did not begin.

    The loop begins when its controller is at the first sample by the clock, a sequential sender with that
    pose, whenever it is sent.
    """
    number, woken = log.cycles["cycle"], log.cycles["woken_ns"]
    taken = next((command for command in log.commands if command.planned == 0), None)
    if taken is None:
        return None
    if setup.schedule == "sequential":
        at = taken.cycle + -(-desired.lead_ns // log.period_ns)
        first = int(np.searchsorted(number, at))
        begin_ns = int(woken[first]) if first < len(woken) else 0
        last = int(np.searchsorted(number, at + -(-desired.duration_ns // log.period_ns)))
    else:
        begin_ns = taken.t_ns + desired.lead_ns
        first = int(np.searchsorted(woken, begin_ns))
        # one that begins some ns before the end, as the first one some ns before the begin, is the last
        last = int(np.searchsorted(woken, begin_ns + desired.duration_ns - LATE_NS))
    if first + 1 >= len(woken):
        return None
    return _Span(begin_ns, first, min(last + 1, len(woken)), last < len(woken))


def _late_ns(log: Log, setup: Setup) -> Longs:
    due, woken = log.cycles["scheduled_ns"], log.cycles["woken_ns"]
    late: Longs = woken - due
    if setup.schedule == "absolute":
        # deadlines that passed since the cycle before began; those before it made that one late
        passed = (due[1:] - woken[:-1] - 1) // log.period_ns
        late[1:] += np.minimum(passed, log.cycles["skipped"][1:]) * log.period_ns
    return late


def _by_bus(log: Log, late_ns: Longs, ledger: Sequence[LedgerEntry]) -> Longs:
    """Return how much of each cycle's lateness simulated servos caused, ns.

    They keep a cycle from beginning by the read of the one before, as far as that ended behind the deadline,
    and by what was exchanged in idle time, as far as that did.
    """
    cycles = log.cycles
    in_read, in_idle = waits_for_servos(log, ledger)
    due = cycles["woken_ns"] - late_ns
    overran = np.zeros(len(cycles), np.int64)
    overran[1:] = np.clip(cycles["written_ns"][:-1] - due[1:], 0, None)
    before = np.zeros(len(cycles), np.int64)
    before[1:] = in_read[:-1]
    by_read = np.minimum(np.minimum(before, overran), late_ns)
    found: Longs = by_read + np.minimum(in_idle, late_ns - by_read)
    return found
