"""Health of servos: temperature, overload, and supply voltages that are too high, too low or sag under load.

The voltages of most servos on a bus fall together when the supply of the bus sags. The voltage of one servo
falls alone when its own supply does. Limits are those of the models' control tables as shipped, or of the
robot file's `registers`. A control table also defines the meaning of hardware errors.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats, Log
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.joints.bins import Bins
from dxlrun_analysis.joints.joint_columns import JointColumns
from dxlrun_analysis.joints.planned import PlannedJoint, planned_joints
from dxlwire import Fault

Numbers = NDArray[np.int64]

_QUANTITIES = ("temperature", "voltage")

_NONSENSE_C = 120.0  # Higher readings, or a greater range, are not real
_NEAR_LIMIT_C = 10.0  # The run also warns at this distance from Temperature Limit
_SAG = 0.03  # Relative drop of a voltage from which a supply sags
_STEP_V = 0.1  # Resolution of Present Input Voltage in the control tables
_LEAST_V = 0.3  # Three steps of the resolution
_FEWEST_VOLTAGES = 6  # Readings that a comparison with the load needs
_FEWEST_OTHERS = 2  # Servos to compare a voltage with
_DIPS_S = 1.5  # Each voltage is read about once a second, so a dip must last longer than one reading
_MOST_SAMPLES = 100_000  # Number of voltages that are kept


@dataclass(frozen=True, slots=True)
class Extremes:
    """Highest temperature and lowest supply voltage of a joint's servos in the run; None if never read."""

    joint: str
    hottest_c: float | None
    lowest_volts: float | None


class _Sample(NamedTuple):
    """New reading of a joint's voltage, with the total load of its bus at that time: sum of each joint's
    share of its maximum."""

    joint: int
    volts: float
    bus_load: float


class ServoHealth:
    """Accumulator of temperatures, voltages and hardware errors of all joints, in constant memory."""

    def __init__(self) -> None:
        self._joints: tuple[PlannedJoint, ...] = ()
        self._bins = Bins()
        self._faults: list[set[Fault]] = []  # By joint
        self._volts = np.zeros(0)
        self._samples: list[_Sample] = []

    def add_slice(self, log: Log) -> None:
        """Add the cycles of the next slice of the log."""
        cycles = log.cycles
        if not len(cycles):
            return
        if not self._bins.begin_ns:
            self._joints = planned_joints(log)
            self._bins = Bins(len(_QUANTITIES), len(log.joints), int(cycles["read_ns"][0]))
            self._faults = [set() for _ in log.joints]
            self._volts = np.full(len(log.joints), np.nan)
        columns = JointColumns(cycles)
        self._bins.bin_cycles(columns["read_ns"], [columns[name] for name in _QUANTITIES])
        # Hardware errors are rare.
        for row in np.flatnonzero(columns["hardware_error"].any(axis=1)).tolist():
            for value in np.unique(columns["hardware_error"][row]).tolist():
                self._faults[row].update(self._joints[row].faults(value))
        self._keep_volts(cycles)

    def _keep_volts(self, cycles: NDArray[np.void]) -> None:
        """Keep each voltage that differs from the one before, with the load of its bus at that time."""
        volts = cycles["voltage"]
        before = np.vstack([self._volts, volts[:-1]])
        rows, joints = np.nonzero(np.isfinite(volts) & (volts != before))
        self._volts = volts[-1].copy()
        if not len(rows):
            return
        load = np.nan_to_num(np.abs(cycles["effort"]) / [joint.top_effort for joint in self._joints])
        buses = np.array([joint.bus for joint in self._joints])
        for row, joint in zip(rows.tolist(), joints.tolist(), strict=True):
            if len(self._samples) < _MOST_SAMPLES:
                bus_load = float(load[row, buses == buses[joint]].sum())
                self._samples.append(_Sample(joint, volts[row, joint], bus_load))

    # Results

    def extremes(self) -> tuple[Extremes, ...]:
        """Return highest temperature and lowest voltage of each joint, in the order of the joints."""
        if not self._joints:
            return ()
        _, least, _, most = self._bins.joined(0.0)
        hottest = np.fmax.reduce(most[0], initial=math.nan)
        lowest = np.fmin.reduce(least[1], initial=math.nan)
        return tuple(
            Extremes(joint.name, *(None if math.isnan(x) else round(float(x), 6) for x in pair))
            for joint, *pair in zip(self._joints, hottest, lowest, strict=True)
        )

    def findings(self, movement: Sequence[Finding]) -> Iterable[Finding]:
        """Report hot and overloaded servos, impossible temperatures, and bad supply voltages.

        Args:
            movement: Findings about movement. Overload of the joints that they accuse is not reported
                again.
        """
        if not self._joints:
            return
        named = {finding.subject for finding in movement}
        _, least, mean, most = self._bins.joined(0.0)
        for index, joint in enumerate(self._joints):
            coldest = float(np.fmin.reduce(least[0, :, index], initial=math.nan))
            hottest = float(np.fmax.reduce(most[0, :, index], initial=math.nan))
            parts = list(self._heat(index, joint, coldest, hottest))
            if "overload" in self._faults[index] and joint.name not in named:
                parts.append("reported overload")
            if parts:
                yield cause(
                    "servo_error", joint.name, f"{joint.name} ({joint.servos}) {' and '.join(parts)}."
                )
        buses = np.array([joint.bus for joint in self._joints])
        for bus in dict.fromkeys(buses.tolist()):
            members = np.flatnonzero(buses == bus)
            yield from self._supplies(
                bus, members, least[1][:, members], mean[1][:, members], most[1][:, members]
            )

    def _heat(self, index: int, joint: PlannedJoint, coldest: float, hottest: float) -> Iterable[str]:
        if hottest - coldest > _NONSENSE_C or hottest > _NONSENSE_C:
            yield f"reported impossible temperatures, from {coldest:.0f} to {hottest:.0f} deg C"
            return
        reported = "overheating" in self._faults[index]
        if hottest >= joint.hottest - _NEAR_LIMIT_C:
            yield f"was hot, at {hottest:.0f} deg C with a limit of {joint.hottest:.0f} deg C"
        elif reported and math.isfinite(hottest):
            yield f"was at {hottest:.0f} deg C"
        if reported:
            yield "reported overheating"

    def _supplies(
        self, bus: str, members: Numbers, least: Floats, mean: Floats, most: Floats
    ) -> Iterable[Finding]:
        """Report bad supply voltages of a bus: one finding for each servo that differs, and at most one more.

        A servo differs if its voltage dips while those of the others do not. That is not checked if most
        voltages are too high or sag. The other finding is about the whole bus. It has the first cause that
        applies to most servos: too high, sagging under load, or a reported error. If only a few servos
        reported an error, it is about these.

        Args:
            bus: Name of the bus.
            members: Rows of the joints on the bus.
            least, mean, most: Supply voltages, V; shape (bins, members).
        """
        lowest, highest = np.fmin.reduce(least, initial=np.inf), np.fmax.reduce(most, initial=-np.inf)
        reported = np.array(["voltage" in self._faults[index] for index in members])
        above = highest > np.array([self._joints[index].highest_volts for index in members]) + _STEP_V / 2
        samples = [one for one in self._samples if one.joint in members]
        falls = (lowest < (1 - _SAG) * highest) & _falls_with_load(samples)
        together = 2 * (falls | above).sum() > len(members)
        for at in range(len(members)):
            others = np.delete(mean, at, axis=1)
            if not together and self._has_own_supply(mean[:, at], others):
                reported[at] = False
                how = f", while the other servos of bus {bus} had {np.nanmedian(others):.1f} V"
                yield self._supply(bus, members[[at]], least[:, [at]], most[:, [at]], how)
        for which, how in (
            (above, ""),
            (falls, _how_it_falls(samples) if falls.any() else ""),
            (reported, ""),
        ):
            rows = np.flatnonzero(which)
            of_bus = 2 * len(rows) > len(members) > 1
            if of_bus or (which is reported and len(rows)):
                said = "; an input voltage error was reported" if reported.any() else ""
                rows = np.arange(len(members)) if of_bus else rows
                yield self._supply(bus, members[rows], least[:, rows], most[:, rows], how + said)
                return

    def _supply(self, bus: str, members: Numbers, least: Floats, most: Floats, how: str) -> Finding:
        """Return the finding about the voltages of some servos of a bus; arrays have shape (bins,
        members), `how` continues the sentence."""
        joints = [self._joints[index] for index in members]
        alone = len(joints) == 1
        where = f"at {joints[0].name} ({joints[0].servos})" if alone else f"of bus {bus}"
        low, high = max(one.lowest_volts for one in joints), min(one.highest_volts for one in joints)
        limits = f"; {low:.1f} to {high:.1f} V are allowed" if math.isfinite(high - low) else ""
        measured = "was not read"
        if np.isfinite(least).any():
            lowest = np.fmin.reduce(least, axis=1)
            at_s = float(np.nanargmin(lowest)) * self._bins.bin_ns / 1e9
            measured = f"was {np.nanmin(lowest):.1f} V at its lowest ({at_s:.1f} s of the run), and "
            measured += f"{np.nanmax(most):.1f} V at most"
        sentence = f"The supply voltage {where} {measured}{how}{limits}."
        return cause("supply", joints[0].name if alone else bus, sentence, share=4.0)

    def _has_own_supply(self, volts: Floats, others: Floats) -> bool:
        """Return whether the voltage of a servo falls while those of the others on its bus do not; `volts`
        has shape (bins,), `others` (bins, servos)."""
        if others.shape[1] < _FEWEST_OTHERS or not np.isfinite(volts).any():
            return False
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # Bins before the first voltage are all NaN
            usual = np.nanmedian(others, axis=1)
            below = usual - volts
            least_below, usually = np.nanquantile(below, (0.05, 0.25))
            # A servo can constantly measure slightly less than the others, with some variation.
            below -= max(0.0, min(usually, least_below + _LEAST_V))
            lowest = np.fmin.reduce(others, axis=1)
        least = np.maximum(_SAG * usual, _LEAST_V)
        dips = (below > least) & (usual - lowest < least)
        return bool(dips.sum() * self._bins.bin_ns / 1e9 >= _DIPS_S)


def _how_it_falls(samples: list[_Sample]) -> str:
    volts, load = np.array(samples)[:, 1], np.array(samples)[:, 2]
    by_load, by_time = (abs(np.corrcoef(volts, one)[0, 1]) for one in (load, np.arange(len(volts))))
    return "; it fell during the run" if by_time > by_load else "; it falls under load"


def _falls_with_load(samples: list[_Sample]) -> bool:
    """Return whether the voltages of a bus are lower while its load is above the median."""
    if len(samples) < _FEWEST_VOLTAGES:
        return False
    table = np.array(samples)
    volts, load = table[:, 1], table[:, 2]
    loaded = load > np.median(load)
    if not loaded.any():
        return False
    fall = volts[~loaded].mean() - volts[loaded].mean()
    return bool(fall >= max(_SAG / 2 * volts.max(), (volts.max() - volts.min()) / 10))
