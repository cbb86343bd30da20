"""Angle, speed and temperature of each joint in each cycle as bins, to relate missing replies to them."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dxlrun import LINEAR, Floats, Log
from dxlrun.tooling.compiled_code import load_compiled, parse_structs
from dxlrun.tooling.records import OFFLINE
from dxlrun_analysis.plan_excerpt import LoggedPlan

Numbers = NDArray[np.int64]

SOURCE = Path(__file__).with_name("joint_states.c")
_STRUCTS = parse_structs(SOURCE.read_text())
_IDS = 256
BINS = 200  # Angles of -500 to 500 deg, speeds to 20 rad/s, temperatures to 200 deg C
QUANTITIES = ANGLE, SPEED, TEMPERATURE = range(3)
_STEPS = np.array([math.radians(5), 0.1, 1.0])  # rad, rad/s, deg C: width of a bin
_FIRST = np.array([-BINS / 2, 0, 0])  # Lower edge of the first bin, in bin widths
_MOST_HELD = 200_000  # Cycles that wait for their exchanges; in a complete log they cover 20 s
_USABLE = ~np.isin(np.arange(256), OFFLINE)  # By the value of `torque`


@dataclass(frozen=True, slots=True)
class Places:
    """Angle, speed and temperature of all joints in some cycles, as bin numbers."""

    cycle: Numbers = field(default_factory=lambda: np.zeros(0, np.int64))
    """Numbers of the cycles, ascending; shape (cycles,)."""
    bins: NDArray[np.int16] = field(default_factory=lambda: np.zeros((len(QUANTITIES), 0, 0), np.int16))
    """Bin of each quantity; -1 if unknown or offline; shape (quantities, joints, cycles)."""


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
        self._held: list[tuple[Numbers, Numbers, Floats, NDArray[np.bool_], Floats]] = []
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
        """Keep the joint states of the next slice of the log."""
        cycles = log.cycles
        if not len(cycles):
            return
        # Joint by joint in memory, so that each is read without gaps.
        angle, heat = (np.array(cycles[name].T, order="C") for name in ("position", "temperature"))
        angle /= self.share[:, None]
        angle[~cycles["valid"].T] = np.nan
        usable = _USABLE[np.array(cycles["torque"].T, order="C")]
        self._held.append((cycles["cycle"].copy(), cycles["period_ns"].copy(), angle, usable, heat))
        while len(self._held) > 1 and sum(len(part[0]) for part in self._held) > _MOST_HELD:
            self._held.pop(0)

    def until(self, cycle: int, *, everything: bool = False) -> Places:
        """Remove the states up to and including a cycle (or `everything`) from the buffer, count them, and
        return them as bins. Missing angles are interpolated."""
        if not self._held:
            return Places()
        numbers, period_ns, angle, usable, heat = (
            np.concatenate(part, axis=-1) for part in zip(*self._held, strict=True)
        )
        end = len(numbers) if everything else int(np.searchsorted(numbers, cycle, side="right"))
        bins = np.empty((len(QUANTITIES), len(angle), end), np.int16)
        states = {"cycle": numbers, "period_ns": period_ns, "angle": angle, "heat": heat, "usable": usable}
        table = {"step": _STEPS, "first": _FIRST, "at": bins, "time_ns": self.time_ns}
        size = {"until": end, "quantities": len(QUANTITIES), "bins": BINS}
        structures = (
            _STRUCTS[name](**{key: one.ctypes.data for key, one in columns.items()}, **counts)
            for name, columns, counts in (
                ("States", states, {"count": len(numbers), "joints": len(angle)}),
                ("Bins", table, size),
            )
        )
        _library().joint_states_bin(*map(ctypes.byref, structures))
        self._held = [(numbers[end:], period_ns[end:], angle[:, end:], usable[:, end:], heat[:, end:])]
        return Places(numbers[:end], bins)

    def range_text(self, joint: int, quantity: int, low: int, high: int) -> str:
        """Return a range of bins of one quantity as text: `between 30 and 45 deg`; `high` is included."""
        begin, end = ((at + _FIRST[quantity]) * _STEPS[quantity] for at in (low, high + 1))
        if quantity == TEMPERATURE:
            return f"from {begin:.0f} deg C on" if high == BINS - 1 else f"at {begin:.0f} to {end:.0f} deg C"
        share = float(self.share[joint])
        factor, unit = (math.degrees(1.0), "deg") if share == 1.0 else (share * 1e3, "mm")
        if quantity == SPEED:
            return f"when it is faster than {begin * factor:.0f} {unit}/s"
        return f"between {begin * factor:.0f} and {end * factor:.0f} {unit}"


@cache
def _library() -> ctypes.CDLL:
    found = load_compiled(SOURCE, ctypes.CDLL)
    found.joint_states_bin.argtypes, found.joint_states_bin.restype = (ctypes.c_void_p,) * 2, None
    return found
