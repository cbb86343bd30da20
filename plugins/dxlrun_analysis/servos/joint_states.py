"""Angle, speed and temperature of each joint as bins, to relate missing replies to them.

States are sampled 50 times a second at most: joints do not change much in 20 ms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun import LINEAR, Floats, Log
from dxlrun.tooling.records import OFFLINE
from dxlrun_analysis.plan_excerpt import LoggedPlan

Numbers = NDArray[np.int64]

_IDS = 256
BINS = 200  # Angles of -500 to 500 deg, speeds to 20 rad/s, temperatures to 200 deg C
QUANTITIES = ANGLE, SPEED, TEMPERATURE = range(3)
_STEPS = np.array([math.radians(5), 0.1, 1.0])[:, None, None]  # rad, rad/s, deg C: width of a bin
_FIRST = np.array([-BINS / 2, 0, 0])[:, None, None]  # Lower edge of the first bin, in bin widths
_SAMPLE_NS = 20_000_000
_MOST_HELD = 10_000  # Samples that wait for their exchanges: 200 s. In a complete log they wait for 20 s.
_USABLE = ~np.isin(np.arange(256), OFFLINE)  # By the value of `torque`


@dataclass(frozen=True, slots=True)
class Places:
    """Angle, speed and temperature of all joints in sampled cycles, as bin numbers."""

    cycle: Numbers = field(default_factory=lambda: np.zeros(0, np.int64))
    """Numbers of the cycles, ascending; shape (cycles,)."""
    bins: NDArray[np.int16] = field(default_factory=lambda: np.zeros((len(QUANTITIES), 0, 0), np.int16))
    """Bin of each quantity; -1 if unknown or offline; shape (quantities, cycles, joints)."""


class JointStates:
    """Buffer of joint states until their cycles' exchanges are paired; counts the time in each bin.

    Its memory does not grow with the log.
    """

    def __init__(
        self, buses: Sequence[str] = (), joints: Sequence[str] = (), plan: LoggedPlan | None = None
    ) -> None:
        self.joint_of = np.full(len(buses) * _IDS, -1, np.int64)
        """Row of the joint that each servo moves, the first if it moves several."""
        self.share = np.ones(len(joints))
        """m of a linear joint per rad of its servo, whose angle is binned; 1 for a rotary joint."""
        self.time_ns = np.zeros((len(joints), len(QUANTITIES), BINS), np.int64)  # Time spent in each bin
        self._held: list[tuple[Numbers, Numbers, Floats, Floats, NDArray[np.bool_]]] = []
        indices = {name: index for index, name in enumerate(buses)}
        rows = {name: row for row, name in enumerate(joints)}
        plan = plan or LoggedPlan()
        for name, movers in reversed(plan.movers.items()):
            for bus, servo, share in movers:
                if 0 <= servo.servo_id < _IDS and bus.name in indices:
                    self.joint_of[indices[bus.name] * _IDS + servo.servo_id] = rows.get(name, -1)
                if name in rows and plan.joint(name).unit is LINEAR:
                    self.share[rows[name]] = share

    def add_states(self, log: Log) -> None:
        """Keep samples of the joint states in the next slice of the log."""
        cycles = log.cycles
        if not len(cycles):
            return
        cycles = cycles[cycles["cycle"] % _cycles_per_sample(cycles["period_ns"]) == 0]
        angle = np.where(cycles["valid"], cycles["position"] / self.share, np.nan)
        usable = _USABLE[cycles["torque"]]
        self._held.append((cycles["cycle"], cycles["period_ns"], angle, cycles["temperature"], usable))
        while len(self._held) > 1 and sum(len(part[0]) for part in self._held) > _MOST_HELD:
            self._held.pop(0)

    def until(self, cycle: int, *, everything: bool = False) -> Places:
        """Remove the samples up to and including a cycle (or `everything`) from the buffer, count them, and
        return them as bins. Missing angles are interpolated."""
        if not self._held:
            return Places()
        numbers, period_ns, angle, heat, usable = map(np.concatenate, zip(*self._held, strict=True))
        end = len(numbers) if everything else int(np.searchsorted(numbers, cycle, side="right"))
        for column in angle.T:
            known = np.isfinite(column)
            if known.any():
                column[~known] = np.interp(numbers[~known], numbers[known], column[known])
        self._held = [(numbers[end:], period_ns[end:], angle[end:], heat[end:], usable[end:])]
        speed = np.full_like(angle, np.nan)
        took_s = (numbers[2:] - numbers[:-2]) * period_ns[1:-1] * 1e-9
        speed[1:-1] = np.abs(angle[2:] - angle[:-2]) / np.maximum(took_s, 1e-9)[:, None]
        values = np.stack([angle, speed, heat])[:, :end]
        bins = np.clip(np.floor(values / _STEPS) - _FIRST, 0, BINS - 1)
        bins = np.where(np.isfinite(values) & usable[:end], bins, -1).astype(np.int16)
        quantity, row, joint = np.nonzero(bins >= 0)
        spent_ns = (period_ns * _cycles_per_sample(period_ns))[row]
        np.add.at(self.time_ns, (joint, quantity, bins[quantity, row, joint]), spent_ns)
        return Places(numbers[:end], bins)

    def range_text(self, joint: int, quantity: int, low: int, high: int) -> str:
        """Return a range of bins of one quantity as text: `between 30 and 45 deg`; `high` is included."""
        begin, end = ((at + _FIRST[quantity].item()) * _STEPS[quantity].item() for at in (low, high + 1))
        if quantity == TEMPERATURE:
            return f"from {begin:.0f} deg C on" if high == BINS - 1 else f"at {begin:.0f} to {end:.0f} deg C"
        share = float(self.share[joint])
        factor, unit = (math.degrees(1.0), "deg") if share == 1.0 else (share * 1e3, "mm")
        if quantity == SPEED:
            return f"when it is faster than {begin * factor:.0f} {unit}/s"
        return f"between {begin * factor:.0f} and {end * factor:.0f} {unit}"


def _cycles_per_sample(period_ns: Numbers) -> Numbers:
    cycles: Numbers = np.maximum(_SAMPLE_NS // np.maximum(period_ns, 1), 1)
    return cycles
