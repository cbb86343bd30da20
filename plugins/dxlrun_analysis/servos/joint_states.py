"""Angles and temperatures of the joints in each cycle, and how long each was at which, as plain counts.

Places of a joint are its angles in bins of 5 deg, then its temperatures in whole deg C.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import OFFLINE, Floats
from dxlrun.log.reader import Log
from dxlrun_analysis.plan import LoggedPlan

Numbers = NDArray[np.int64]

_IDS = 256
BIN_DEG = 5
ANGLES = 720 // BIN_DEG  # From -360 to 360 deg; what is beyond is in the outer ones
STEP_RAD_S = 0.1
SPEEDS = 200  # From 0 to 20 rad/s; what is faster is in the last one
PLACES = ANGLES + 112  # Then 0 to 111 deg C, with what is beyond in the outer ones, too
_MOST_HELD = 200_000  # Cycles that wait for their exchanges; in a whole log they are those of 20 s


@dataclass(frozen=True, slots=True)
class Places:
    """Where the joints were in some cycles; shape (cycles, joints), -1: not known, or offline."""

    cycle: Numbers = field(default_factory=lambda: np.zeros(0, np.int64))
    """Their numbers, ascending; shape (cycles,)."""
    angle: Numbers = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    temperature: Numbers = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    speed: Numbers = field(default_factory=lambda: np.zeros((0, 0), np.int64))  # In bins of 0.1 rad/s


class JointStates:
    """Holds the states of cycles until their exchanges come, in memory that does not grow with the log."""

    def __init__(
        self, buses: Sequence[str] = (), joints: Sequence[str] = (), plan: LoggedPlan | None = None
    ) -> None:
        self.joint_of = np.full(len(buses) * _IDS, -1, np.int64)
        """Row of the joint that each servo moves; one that moves several counts with the first."""
        self.share = np.ones(len(joints))
        """m of a linear joint for each rad of its servo, whose angle then counts; 1 of one that turns"""
        self.time_ns, self.crossed = (np.zeros((len(joints), PLACES), np.int64) for _ in range(2))
        """How long each joint was at each place, and how often it came to it from below or left it so."""
        self.speed_ns = np.zeros((len(joints), SPEEDS), np.int64)  # How long each joint was how fast
        self._held: list[tuple[Numbers, Numbers, Floats, NDArray[np.bool_], Floats]] = []
        indices = {name: index for index, name in enumerate(buses)}
        rows = {name: row for row, name in enumerate(joints)}
        plan = plan or LoggedPlan()
        for name, movers in reversed(plan.movers.items()):
            for bus, servo, share in movers:
                if 0 <= servo.servo_id < _IDS and bus.name in indices:
                    self.joint_of[indices[bus.name] * _IDS + servo.servo_id] = rows.get(name, -1)
                if name in rows and plan.joint(name).linear:
                    self.share[rows[name]] = share

    def take(self, log: Log) -> None:
        """Keep the states of the next slice."""
        cycles = log.cycles
        if not len(cycles):
            return
        angle = np.where(cycles["valid"], cycles["position"] / self.share, np.nan)
        usable = ~np.isin(cycles["torque"], OFFLINE)
        columns = (cycles["cycle"].copy(), cycles["period_ns"].copy(), angle, usable)
        self._held.append((*columns, cycles["temperature"].copy()))
        while len(self._held) > 1 and sum(len(part[0]) for part in self._held) > _MOST_HELD:
            self._held.pop(0)

    def until(self, cycle: int, *, everything: bool = False) -> Places:
        """Return where the joints were in the cycles up to one; between two angles these are interpolated."""
        if not self._held:
            return Places()
        numbers, period_ns, angle, usable, heat = (
            np.concatenate(part) for part in zip(*self._held, strict=True)
        )
        end = len(numbers) if everything else int(np.searchsorted(numbers, cycle, side="right"))
        for row in range(len(self.share)):
            known = np.isfinite(angle[:, row])
            if known.any() and not known.all():
                angle[:, row] = np.interp(numbers, numbers[known], angle[known, row])
        speed = _speeds(numbers, period_ns, angle)[:end]
        self._held = [(numbers[end:], period_ns[end:], angle[end:], usable[end:], heat[end:])]
        binned = np.floor(np.degrees(np.nan_to_num(angle[:end])) / BIN_DEG).astype(np.int64) + ANGLES // 2
        known = usable[:end] & np.isfinite(angle[:end])
        angles = np.where(known, np.clip(binned, 0, ANGLES - 1), -1)
        degrees = np.rint(np.nan_to_num(heat[:end])).astype(np.int64) + ANGLES
        known = usable[:end] & np.isfinite(heat[:end])
        temperatures = np.where(known, np.clip(degrees, ANGLES, PLACES - 1), -1)
        for places in (angles, temperatures):
            self._count(places, period_ns[:end])
        known = usable[:end] & np.isfinite(speed)
        steps = np.minimum(np.nan_to_num(speed) / STEP_RAD_S, SPEEDS - 1).astype(np.int64)
        speeds = np.where(known, steps, -1)
        for row, mine in enumerate(speeds.T):
            ns = period_ns[:end][mine >= 0]
            self.speed_ns[row] += np.bincount(mine[mine >= 0], ns, SPEEDS).astype(np.int64)
        return Places(numbers[:end], angles, temperatures, speeds)

    def _count(self, places: Numbers, period_ns: Numbers) -> None:
        for row, mine in enumerate(places.T):
            known = mine >= 0
            self.time_ns[row] += np.bincount(mine[known], period_ns[known], PLACES).astype(np.int64)
            low, high = np.sort([mine[known][:-1], mine[known][1:]], axis=0)
            ends = np.bincount(low + 1, minlength=PLACES + 1) - np.bincount(high + 1, minlength=PLACES + 1)
            self.crossed[row] += np.cumsum(ends)[:PLACES]

    def range_text(self, servo: int, low: float, high: float) -> str:
        """Write a range of a servo's angles, rad, for people, in the unit of its joint."""
        share = float(self.share[self.joint_of[servo]])
        factor, unit = (math.degrees(1.0), "deg") if share == 1.0 else (share * 1e3, "mm")
        return f"between {low * factor:.0f} and {high * factor:.0f} {unit}"


def _speeds(numbers: Numbers, period_ns: Numbers, angle: Floats) -> Floats:
    """Return how fast each joint was between the cycles around each, rad/s, in shape (cycles, joints)."""
    found = np.full(angle.shape, np.nan)
    if len(numbers) > 2:
        took_s = np.maximum((numbers[2:] - numbers[:-2]) * period_ns[1:-1] * 1e-9, 1e-9)
        found[1:-1] = np.abs(angle[2:] - angle[:-2]) / took_s[:, None]
    return found


def edge_rad(place: int) -> float:
    """Return the lower edge of a bin of angles, rad."""
    return math.radians((place - ANGLES // 2) * BIN_DEG)
