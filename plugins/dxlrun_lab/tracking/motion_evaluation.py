"""Evaluation of one run of the tracking experiment from its log: drift, tracking error and late cycles.

A cycle is *late* by the time from its deadline to its start. The deadline is the first one after the start of
the previous cycle, so if that cycle took too long, it is the one of the first skipped period. Simulated
servos are late if their process is not scheduled. The ledger of the simulated bus records this lateness,
which is reported separately and subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Log
from dxlrun_analysis.cycles.punctuality import ROUGH_NS
from dxlrun_lab.late_servos import waits_for_servos
from dxlrun_lab.tracking.desired_motion import DesiredMotion
from dxlrun_lab.tracking.setups import Setup
from dxlsim import LedgerEntry

Longs = NDArray[np.int64]
LATE_NS = ROUGH_NS


class MotionCurves(msgspec.Struct, frozen=True):
    """Cycles of the motion for the figures, shape (cycles,); times in s since the start of the motion"""

    due_s: Floats
    """First deadline after the start of the previous cycle"""
    woken_s: Floats
    """Start of the cycle"""
    sent_s: Floats
    """Time at which the goal was written"""
    sent: Floats
    """Goal position, rad"""
    read_s: Floats
    """Time at which the position was read"""
    read: Floats
    """Measured position, rad; NaN without a reply"""
    velocity: Floats
    """Measured velocity, rad/s"""
    late_us: Floats
    """Time from deadline to start of the cycle, us, without the part that simulated servos caused"""

    @property
    def worst(self) -> int:
        """Index of the latest cycle"""
        return int(self.late_us.argmax())


class SetupFigures(msgspec.Struct, frozen=True):
    """Figures of the run in one set-up. Fields `*_by_bus*` are the part of simulated servos, or None."""

    setup: str
    title: str
    thesis: str
    """Figures of the thesis that show this set-up"""
    log: str
    ended: bool
    """True if the whole motion was sent"""
    cycles: int
    """Number of cycles from the first to the last pose of the motion"""
    duration_ns: int
    """Time from the first pose to the end of the motion, or to the end of the run"""
    drift_ns: int | None
    """Difference of the duration to that of the motion. The loop may end up to 150 us early."""
    start_delays_ns: int | None
    """Sum of the start delays of a sequential sender's poses; None for the loop"""
    remainder_ns: int
    """Difference of the motion's duration to the next multiple of the period"""
    last_late_ns: int
    """Lateness of the last cycle, which is part of the drift"""
    drift_by_bus_ns: int | None
    rms_rad: float
    """Root mean square of desired minus measured position, with the desired position at the time of reading
    """
    worst_rad: float
    late_cycles: int
    """Number of cycles later than 150 us, without the simulated bus. The next two fields are about these."""
    mean_late_us: float
    max_late_us: float
    late_by_bus_us: float | None
    """Lateness that simulated servos caused, us, as a sum over all cycles"""
    silent_cycles: int
    """Number of cycles without an intact reply, which do not count in the error"""
    remarks: tuple[str, ...] = ()
    """Remarks about the run, one sentence each"""

    @property
    def own_drift_ns(self) -> int | None:
        """Drift without the part that the simulated bus caused"""
        return None if self.drift_ns is None else self.drift_ns - (self.drift_by_bus_ns or 0)

    @property
    def adds_up(self) -> bool:
        """True if the drift of a sequential sender equals the sum of its start delays"""
        return self.drift_ns is not None and self.drift_ns - self.remainder_ns == self.start_delays_ns


class SetupResult(msgspec.Struct, frozen=True):
    """Evaluation of the run in one set-up: figures, and curves to draw"""

    tracked: SetupFigures
    curves: MotionCurves


def measure_tracking(
    log: Log,
    setup: Setup,
    desired: DesiredMotion,
    ledger: Sequence[LedgerEntry] | None,
    remarks: tuple[str, ...] = (),
) -> SetupResult | None:
    """Evaluate how a run followed a motion. Return None if the run ended before the motion started.

    Args:
        log: Log of the run.
        setup: Set-up of the run.
        desired: Desired motion.
        ledger: Ledger of the simulated buses; None for real buses.
        remarks: Remarks about the run.
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
    curves = MotionCurves(
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
    tracked = SetupFigures(
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
    return SetupResult(tracked, curves)


class _Span(NamedTuple):
    """Cycles of the motion in the log of its run"""

    begin_ns: int
    """Start of the motion on the clock of the log, ns"""
    first: int
    """Index of the cycle with the first pose"""
    stop: int
    """Index after the cycle with the last pose"""
    ended: bool
    """True if the log has the end of the motion"""


def _span(log: Log, setup: Setup, desired: DesiredMotion) -> _Span | None:
    """Return the cycles of the motion, or None if it did not start.

    In the loop, the motion starts when the clock reaches the first sample. With a sequential sender, it
    starts when the first pose is sent.
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
        # A cycle that starts slightly before the end of the motion counts as the last one.
        last = int(np.searchsorted(woken, begin_ns + desired.duration_ns - LATE_NS))
    if first + 1 >= len(woken):
        return None
    return _Span(begin_ns, first, min(last + 1, len(woken)), last < len(woken))


def _late_ns(log: Log, setup: Setup) -> Longs:
    due, woken = log.cycles["scheduled_ns"], log.cycles["woken_ns"]
    late: Longs = woken - due
    if setup.schedule == "absolute":
        # Only count deadlines since the start of the previous cycle. Earlier ones made that cycle late.
        passed = (due[1:] - woken[:-1] - 1) // log.period_ns
        late[1:] += np.minimum(passed, log.cycles["skipped"][1:]) * log.period_ns
    return late


def _by_bus(log: Log, late_ns: Longs, ledger: Sequence[LedgerEntry]) -> Longs:
    """Return the part of each cycle's lateness that simulated servos caused, ns.

    They delay a cycle by the read of the previous cycle, and by transactions in idle time. Only the time
    after the deadline counts.
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
