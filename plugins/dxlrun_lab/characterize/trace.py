"""Trace: goals and positions of one joint, with the times at which they were valid in the servo.

A servo samples its state at the end of the instruction packet, so before its return delay and before the
transmission of the reply. A goal takes effect when the last byte of its packet has been transmitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_lab.guided.experiment import ExperimentJoint
from dxlrun_lab.guided.segment import SegmentRecording
from dxlwire import BITS_PER_BYTE, BusPlan, ServoPlan


class Trace(msgspec.Struct, frozen=True):
    """Goals and positions of a joint, one row per cycle with an intact reply

    Times are s since the wake-up of the recording's first cycle.
    """

    time: Floats
    """Time at which the servo had the position"""
    position: Floats
    """Position of the joint, rad"""
    sent: Floats
    """Time at which the last byte of the cycle's goal was transmitted; later than `time`"""
    goal: Floats
    """Goal that was sent, after the gate limited it, rad"""
    tick: float
    """Resolution of the position, rad"""

    @classmethod
    def from_recording(
        cls, recorded: SegmentRecording, joint: ExperimentJoint, buses: Sequence[BusPlan]
    ) -> Self:
        """Extract the trace of a joint from a recording. Cycles without an intact reply are omitted.

        The delays of the bus are those of the plan in `buses`.
        """
        column = recorded.joints.index(joint.name)
        reply_ns, goal_ns = _on_the_wire(joint.servo, buses)
        taken_ns = recorded.of_cycles("read_ns") - recorded.of_joints("age_ns")[:, column] - reply_ns
        origin = int(recorded.of_cycles("woken_ns")[0]) if len(recorded) else 0
        keep = recorded.valid[:, column] & np.isfinite(recorded.goal[:, column])
        time = (taken_ns[keep] - origin).astype(np.float64) * 1e-9
        sent = (recorded.of_cycles("written_ns")[keep] + goal_ns - origin).astype(np.float64) * 1e-9
        return cls(
            time,
            recorded.position[keep, column],
            sent,
            recorded.goal[keep, column],
            joint.servo.position_per_tick,
        )

    def __len__(self) -> int:
        return len(self.time)

    @property
    def period(self) -> float:
        """Median time between two positions, s; NaN with fewer than two"""
        return float(np.median(np.diff(self.time))) if len(self) > 1 else math.nan

    def part(self, rows: slice | NDArray[np.bool_]) -> Trace:
        """Return a trace with some of the rows."""
        return Trace(self.time[rows], self.position[rows], self.sent[rows], self.goal[rows], self.tick)


def _on_the_wire(servo: ServoPlan, buses: Sequence[BusPlan]) -> tuple[int, int]:
    """Return the computed delays, ns, of a servo's state to the host and of a goal to the servo. Raises
    LookupError if no bus of the plan has the servo."""
    for bus in buses:
        if servo not in bus.servos:
            continue
        index = bus.servos.index(servo)
        goal_ns = bus.budget.goals_ns
        for group, fast, read in zip(bus.groups, bus.fast, bus.reads, strict=True):
            if index not in group:
                continue
            asked_ns = len(read.packet) * BITS_PER_BYTE * 1_000_000_000 // bus.baud_rate
            replies_ns = read.due_ns - asked_ns
            # Servos after the first one of a group answer later, but sample their state at the same time.
            place = group.index(index) + 1
            part_ns = replies_ns if fast else replies_ns * place // len(group)
            return part_ns + bus.latency_ns, goal_ns
    raise LookupError(f"the servo of {servo.joint} is on no bus")


def slopes(time: Floats, values: Floats, half_width: float) -> Floats:
    """Return the derivative at each sample: the slope of a line through the samples within `half_width`, s.

    This is the first derivative of A. Savitzky and M. J. E. Golay (Anal. Chem. 36, 1964), for times that need
    not be evenly spaced. It is NaN with fewer than two samples.
    """
    shifted_t, shifted_v = time - time[:1], values - values[:1]
    sums = [
        np.concatenate(([0.0], np.cumsum(column)))
        for column in (np.ones(len(time)), shifted_t, shifted_v, shifted_t**2, shifted_t * shifted_v)
    ]
    first = np.searchsorted(time, time - half_width * (1 + 1e-9), side="left")
    last = np.searchsorted(time, time + half_width * (1 + 1e-9), side="right")
    n, t, v, tt, tv = (column[last] - column[first] for column in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Floats = (n * tv - t * v) / (n * tt - t * t)
    found[n < 2] = np.nan
    return found


def crossing(time: Floats, values: Floats, level: float) -> float:
    """Return the time at which rising values first reach a level, linearly interpolated; NaN if never."""
    reached = np.flatnonzero(values >= level)
    if not len(reached):
        return math.nan
    at = int(reached[0])
    if at == 0:
        return float(time[0])
    part = (level - values[at - 1]) / (values[at] - values[at - 1])
    return float(time[at - 1] + part * (time[at] - time[at - 1]))


def polynomial(x: Floats, y: Floats, degree: int) -> Floats:
    """Return the coefficients of the least-squares polynomial, the highest power first, as in numpy.polyfit.

    If the samples do not determine it, the solution is the one of minimum norm, without a warning.
    """
    return np.linalg.lstsq(np.vander(x, degree + 1), y, rcond=None)[0].astype(np.float64)
