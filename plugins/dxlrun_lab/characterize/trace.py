"""Trace: one joint's goals and positions, each at the time at which the servo had it.

A state in the log arrived with a reply; the servo took it when the instruction had ended, before its return
delay and the reply's time on the wire. A goal is with the servo when the last byte of its packet has passed
the wire.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun_lab.guided.experiment import Joint
from dxlrun_lab.guided.segment import Recorded
from dxlwire import BITS_PER_BYTE, BusPlan, ServoPlan


class Trace(msgspec.Struct, frozen=True):
    """A joint over time, one row a cycle with an intact reply; times in s from one origin."""

    time: Floats
    """When the servo had the position"""
    position: Floats
    """rad"""
    sent: Floats
    """When the last byte of the cycle's goal had passed the wire; later than `time`"""
    goal: Floats
    """rad, behind the gate"""
    tick: float
    """rad; the servo's unit of position"""

    @classmethod
    def of(cls, recorded: Recorded, joint: Joint, buses: Sequence[BusPlan]) -> Self:
        """Return what was recorded of a joint; rows without an intact reply are left out."""
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
        """Median time between two positions, s; NaN below two."""
        return float(np.median(np.diff(self.time))) if len(self) > 1 else math.nan

    def part(self, rows: slice | NDArray[np.bool_]) -> Trace:
        """Return some rows."""
        return Trace(self.time[rows], self.position[rows], self.sent[rows], self.goal[rows], self.tick)


def _on_the_wire(servo: ServoPlan, buses: Sequence[BusPlan]) -> tuple[int, int]:
    """Return how long a servo's state needs to the host, and a goal to the servo, ns, by the plan."""
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
            # those behind the first one of a group answer later, but in their state at its end
            place = group.index(index) + 1
            part_ns = replies_ns if fast else replies_ns * place // len(group)
            return part_ns + bus.latency_ns, goal_ns
    raise LookupError(f"no bus has the servo of {servo.joint}")


def slopes(time: Floats, values: Floats, half_width: float) -> Floats:
    """Return the slope of a straight line through the samples within `half_width` of each one.

    As the first derivative by A. Savitzky and M. J. E. Golay (Anal. Chem. 36, 1964), for times that need not
    be evenly spaced; NaN where fewer than two samples are.
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
    """Return when rising values first reach a level, between two samples by a straight line; NaN: never."""
    reached = np.flatnonzero(values >= level)
    if not len(reached):
        return math.nan
    at = int(reached[0])
    if at == 0:
        return float(time[0])
    part = (level - values[at - 1]) / (values[at] - values[at - 1])
    return float(time[at - 1] + part * (time[at] - time[at - 1]))


def polynomial(x: Floats, y: Floats, degree: int) -> Floats:
    """Return the coefficients of the least-squares polynomial, the highest power first, as numpy.polyfit.

    Of samples that determine none it is the smallest, without a warning.
    """
    return np.linalg.lstsq(np.vander(x, degree + 1), y, rcond=None)[0].astype(np.float64)
