"""Temperature, voltage and load of each joint over the run, in bins that double when the run outgrows them.

What they show: a joint that gets hot or is overloaded, and a supply that is too high, too low or sags under
load: that of the bus, where the voltages of most servos fall together, or of one servo, where the others
stay. Limits are those of the models' control tables as shipped, or of the robot file's `registers`; a control
table also has the meaning of hardware errors.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats
from dxlrun.dynamixel.control_table import Fault
from dxlrun.log.reader import Log
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.joints.bins import Bins, Series
from dxlrun_analysis.joints.planned import PlannedJoint, planned_joints

Numbers = NDArray[np.int64]

_QUANTITIES = ("temperature", "voltage", "effort")

_NONSENSE_C = 120.0
_NEAR_LIMIT_C = 10.0  # The run warns at this distance from Temperature Limit, too
_SAG = 0.03  # Part of its voltage by which a supply that sags falls
_STEP_V = 0.1  # Voltages are read in such steps
_LEAST_V = 0.3
_FEWEST_VOLTAGES = 6
_FEWEST_OTHERS = 2
_DIPS_S = 1.5  # So long a servo's voltage has to be lower than the others': each is read about once a second
_LOADED = 1.3  # So many times the load with which it is not lower is load that pulls it down
_MOST_SAMPLES = 100_000  # Voltages kept


@dataclass(frozen=True, slots=True)
class Trend:
    """One joint over the run."""

    joint: str
    begin_s: float  # Of the first bin, on the run's clock
    bin_s: float
    temperature: Series  # deg C
    voltage: Series  # V
    effort: Series  # Magnitude, in the unit of the joint's effort
    error: Series  # Position minus the reachable trajectory, rad or m; only with torque


class _Sample(NamedTuple):
    """A voltage when it was read as another one, and the loads then, as shares of what the servos can."""

    joint: int
    volts: float
    load: float
    bus_load: float


class Trends:
    """Collects the trends of all joints, in memory that does not grow with the log."""

    def __init__(self) -> None:
        self._joints: tuple[PlannedJoint, ...] = ()
        self._bins = Bins()
        self._faults: list[set[Fault]] = []  # Of each joint
        self._volts = np.zeros(0)
        self._samples: list[_Sample] = []

    def take(self, log: Log) -> None:
        """Take the cycles of the next slice."""
        cycles = log.cycles
        if not len(cycles):
            return
        if not self._bins.begin_ns:
            self._joints = planned_joints(log)
            self._bins = Bins(len(_QUANTITIES), len(log.joints), int(cycles["read_ns"][0]))
            self._faults = [set() for _ in log.joints]
            self._volts = np.full(len(log.joints), np.nan)
        values = [np.abs(cycles[name]) if name == "effort" else cycles[name] for name in _QUANTITIES]
        self._bins.take(cycles["read_ns"], np.array(values))
        for joint, faults, values in zip(self._joints, self._faults, cycles["hardware_error"].T, strict=True):
            for value in np.unique(values).tolist():
                faults.update(joint.faults(value))
        self._supply(cycles)

    def _supply(self, cycles: NDArray[np.void]) -> None:
        """Keep the voltages that were read, each with the loads at that moment."""
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
                self._samples.append(_Sample(joint, volts[row, joint], load[row, joint], bus_load))

    # Results

    def finish(self, errors: Bins) -> tuple[Trend, ...]:
        """Return the trends in the order of the joints; `errors`: bins with their error as first quantity."""
        bins, begin_s, bin_s = self._bins, self._bins.begin_ns / 1e9, self._bins.bin_ns / 1e9
        return tuple(
            Trend(
                joint.name,
                begin_s,
                bin_s,
                temperature=bins.series(0, at),
                voltage=bins.series(1, at),
                effort=bins.series(2, at),
                error=errors.series(0, at),
            )
            for at, joint in enumerate(self._joints)
        )

    def findings(self, movement: Sequence[Finding]) -> Iterable[Finding]:
        """Name hot joints, overloaded ones that `movement` does not name, and low and sagging supplies."""
        if not self._joints:
            return
        named = {finding.subject for finding in movement}
        _, least, mean, most = self._bins.joined(0.0)
        for index, joint in enumerate(self._joints):
            coldest = float(np.fmin.reduce(least[0, :, index], initial=math.nan))
            hottest = float(np.fmax.reduce(most[0, :, index], initial=math.nan))
            yield from self._joint(index, joint, coldest, hottest, moves_badly=joint.name in named)
        buses = np.array([joint.bus for joint in self._joints])
        for bus in dict.fromkeys(buses.tolist()):
            members = np.flatnonzero(buses == bus)
            yield from self._power(
                bus, members, least[1][:, members], mean[1][:, members], most[1][:, members]
            )

    def _joint(
        self, index: int, joint: PlannedJoint, coldest: float, hottest: float, *, moves_badly: bool
    ) -> Iterable[Finding]:
        faults = self._faults[index]
        where = f"{joint.name} ({joint.servos})"
        if hottest - coldest > _NONSENSE_C or hottest > _NONSENSE_C:
            yield cause(
                "temperature_sensor",
                joint.name,
                f"{where} reads temperatures that it cannot have: from {coldest:.0f} to {hottest:.0f} deg C.",
                "Feel it: where it is not hot, its temperature sensor is broken, and does not protect it.",
            )
            return
        limit = f" of {joint.hottest:.0f} deg C that it may have" if math.isfinite(joint.hottest) else ""
        if "overheating" in faults or hottest >= joint.hottest - _NEAR_LIMIT_C:
            shut = ", and reported overheating" if "overheating" in faults else ""
            measured = f"was hot, at {hottest:.0f} deg C{limit}" if math.isfinite(hottest) else "was too hot"
            yield cause(
                "hot_joint",
                joint.name,
                f"{where} {measured}{shut}.",
                "Let it cool; give it less load, pauses or air, and look for what makes it work at rest.",
            )
        if "overload" in faults and not moves_badly:
            yield cause(
                "overload",
                joint.name,
                f"{where} reported overload: its load is more than its torque.",
                "Take load off the joint, or move it slower; a reboot clears the error.",
            )

    def _power(
        self, bus: str, members: Numbers, least: Floats, mean: Floats, most: Floats
    ) -> Iterable[Finding]:
        """Name the supply of a bus or of one servo; voltages in shape (bins, members)."""
        lowest, highest = np.fmin.reduce(least, initial=np.inf), np.fmax.reduce(most, initial=-np.inf)
        reported = np.array(["voltage" in self._faults[index] for index in members])
        joints = [self._joints[index] for index in members]
        above = highest > np.array([joint.highest_volts for joint in joints]) + _STEP_V / 2
        if 2 * above.sum() > len(members):
            limit = min(joint.highest_volts for joint in joints)
            yield cause(
                "overvoltage",
                bus,
                f"The supply of bus {bus} is too high: up to {highest.max():.1f} V, and its servos may have "
                f"{limit:.1f} V; the lowest in the run was {lowest.min():.1f} V.",
                "Take it off, and check the supply, its setting, or the charger and the number of cells.",
                4.0,
            )
            return
        falls = lowest < (1 - _SAG) * highest
        samples = [one for one in self._samples if one.joint in members]
        if 2 * falls.sum() > len(members) > 1 and _falls_with_load(samples):
            yield cause(
                "sagging_supply",
                bus,
                f"The supply of bus {bus} {_how_it_falls(samples)}: from {highest.max():.1f} V to "
                f"{lowest.min():.1f} V.",
                "Use a stronger supply or a fresh battery, thicker and shorter cables, and feed the bus "
                "at more than one end.",
                2.0,
            )
            return
        for index, volts in zip(members.tolist(), mean.T, strict=True):
            found = self._own_supply(index, volts, mean[:, members != index])
            if found is not None:
                reported[members == index] = False
                yield found
        if reported.any():
            alone = reported.sum() == 1 < len(members)
            names = [joint.name for joint, bad in zip(joints, reported, strict=True) if bad]
            low, high = (
                max(joint.lowest_volts for joint in joints),
                min(joint.highest_volts for joint in joints),
            )
            where = f"bus {bus}" if 2 * len(names) > len(members) > 1 else ", ".join(names)
            measured = lowest[reported].min(), highest[reported].max()
            yield cause(
                "undervoltage",
                names[0] if alone else bus,
                _describe_voltage(where, (low, high), measured),
                "Check its plug and cable." if alone else "Check the supply or the battery of the bus.",
                4.0,
            )

    def _own_supply(self, index: int, volts: Floats, others: Floats) -> Finding | None:
        """Name a servo whose voltage falls while those of the others stay.

        Where it reported that, it is left to `undervoltage` unless it falls with the servo's load.
        """
        if others.shape[1] < _FEWEST_OTHERS or not np.isfinite(volts).any():
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # before the first voltage there is none
            usual = np.nanmedian(others, axis=1)
            below = usual - volts
            least_below, usually = np.nanquantile(below, (0.05, 0.25))
            # it may always measure a little less, and waver about that
            below -= max(0.0, min(usually, least_below + _LEAST_V))
            lowest = np.fmin.reduce(others, axis=1)
        least = np.maximum(_SAG * usual, _LEAST_V)
        dips = (below > least) & (usual - lowest < least)
        if dips.sum() * self._bins.bin_ns / 1e9 < _DIPS_S:
            return None
        joint, at = self._joints[index], np.nanargmax(np.where(dips, below, -np.inf))
        level = np.nanmax(volts) - least[at]
        mine = [one for one in self._samples if one.joint == index]
        loads = [[one.load for one in mine if (one.volts < level) == low] for low in (True, False)]
        falls = np.count_nonzero(dips[1:] & ~dips[:-1])
        loaded = falls > 1 and all(loads) and np.mean(loads[0]) > _LOADED * np.mean(loads[1])
        if "voltage" in self._faults[index] and not loaded:
            return None
        return cause(
            "own_supply",
            joint.name,
            f"The voltage at {joint.name} ({joint.servos}) falls{' with its load' if loaded else ''} to "
            f"{np.nanmin(volts[dips]):.1f} V while the others of bus {joint.bus} stay at {usual[at]:.1f} V.",
            "Check its plug and the cable that leads to it alone: contacts with a high resistance.",
            4.0,
        )


def _describe_voltage(where: str, limits: tuple[float, float], measured: tuple[float, float]) -> str:
    """Describe the voltage of servos that reported an error of it; `measured`: lowest and highest."""
    (low, high), (lowest, highest) = limits, measured
    bounds = f" of {low:.1f} to {high:.1f} V" if math.isfinite(high - low) else ""
    volts = f"{lowest:.1f} V" if f"{lowest:.1f}" == f"{highest:.1f}" else f"{lowest:.1f} to {highest:.1f} V"
    if not math.isfinite(lowest):
        return f"The voltage of {where} is out of its limits{bounds}."
    if bounds and low <= lowest and highest <= high:
        return (
            f"An input voltage error of {where} was reported, but each voltage that was read is within the "
            f"limits{bounds}: {volts}. A dip or a peak between two readings is not seen."
        )
    return f"The voltage of {where} is out of its limits{bounds}: {volts}."


def _how_it_falls(samples: list[_Sample]) -> str:
    volts, load = np.array(samples)[:, 1], np.array(samples)[:, 3]
    by_load, by_time = (abs(np.corrcoef(volts, one)[0, 1]) for one in (load, np.arange(len(volts))))
    return "runs down in the run, as a battery does" if by_time > by_load else "sags under load"


def _falls_with_load(samples: list[_Sample]) -> bool:
    """Return whether the voltages of a bus are lower while its load is high."""
    if len(samples) < _FEWEST_VOLTAGES:
        return False
    table = np.array(samples)
    volts, load = table[:, 1], table[:, 3]
    loaded = load > np.median(load)
    if not loaded.any():
        return False
    fall = volts[~loaded].mean() - volts[loaded].mean()
    return bool(fall >= max(_SAG / 2 * volts.max(), (volts.max() - volts.min()) / 10))
