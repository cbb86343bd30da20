"""Temperature, voltage and load of each joint over the run, in bins that double when the run outgrows them.

What they show: a joint that gets hot, a supply that is too low or sags under load, a shaft that is blocked, a
torque that is limited. Limits are those of the models' control tables as shipped, or of the robot file's
`registers`. Bits of the hardware error: ROBOTIS e-Manual, Protocol 2.0, Hardware Error Status (70); Protocol
1.0, Error of the status packet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun.analysis.counts import Counts, quantile
from dxlrun.analysis.finding import Finding, Rank
from dxlrun.analysis.plan import LoggedBus, LoggedJoint, LoggedServo, plan_of
from dxlrun.dynamixel.control_table import control_table
from dxlrun.log.reader import Log
from dxlrun.run.channels.cycle import Torque

_BINS = 512
_FIRST_BIN_NS = 100_000_000
_QUANTITIES = ("temperature", "voltage", "effort")

_VOLTAGE, _HEAT, _OVERLOAD = 0x01, 0x04, 0x20
_NEAR_LIMIT_C = 10.0
"""The run warns at this distance from Temperature Limit, too."""
_STILL_RAD_S = 0.03
"""Slower is still: a tick of Present Velocity is 0.024 rad/s."""
_AWAY_RAD = 0.08
"""A joint that follows its goal is nearer."""
_FAR_RAD = 0.3
"""So far from its goal a joint does not rest for want of gain."""
_GREW_RAD = 0.05
_STUCK_S = 0.25
_TOP_RAD_S = 4.0
"""Of a joint of which the plan knows no speed [i]."""
_WEAK = 0.6
"""A torque is limited that is less than this part of the model's, and the same in this part of the time in
which the joint is far behind its goal."""
_SAG = 0.03
"""Part of its voltage by which a supply that sags falls."""
_FEWEST_VOLTAGES = 6
_SAGS_WITH_LOAD = -0.4
"""Correlation of voltage and load."""
_MOST_SAMPLES = 20_000
"""Voltages kept for each bus."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Series:
    """One quantity of one joint over the run: of each bin least, mean and most; None: not read."""

    least: tuple[float | None, ...]
    mean: tuple[float | None, ...]
    most: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class Trend:
    """One joint over the run."""

    joint: str
    begin_s: float
    """Of the first bin, on the run's clock."""
    bin_s: float
    temperature: Series
    """deg C"""
    voltage: Series
    """V"""
    effort: Series
    """Magnitude, in the unit of the joint's effort."""


@dataclass(slots=True)
class _Joint:
    """What a joint's servo can do, by the plan."""

    name: str
    bus: str = ""
    servos: str = ""
    """As sentences name them"""
    hottest: float = math.nan
    top_effort: float = math.nan
    top_speed: float = _TOP_RAD_S
    logged: LoggedJoint = field(default_factory=lambda: LoggedJoint(""))
    share: float = 1.0
    """m of a linear joint for each rad of its servo; 1 of one that turns"""


class Trends:
    """Collects the trends of all joints, in memory that does not grow with the log."""

    __slots__ = (
        "_away_s",
        "_begin_ns",
        "_bin_ns",
        "_count",
        "_efforts",
        "_errors",
        "_hottest",
        "_joints",
        "_least",
        "_load",
        "_most",
        "_run_away",
        "_run_begin_ns",
        "_stuck_at",
        "_stuck_effort",
        "_stuck_s",
        "_sum",
        "_volts",
    )

    def __init__(self) -> None:
        self._joints: list[_Joint] = []
        self._begin_ns = -1
        self._bin_ns = _FIRST_BIN_NS
        self._size(0)

    def _size(self, joints: int) -> None:
        shape = (len(_QUANTITIES), _BINS, joints)
        self._least, self._most = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._sum, self._count = np.zeros(shape), np.zeros(shape, np.int64)
        self._errors = np.zeros(joints, np.int64)
        self._hottest = np.full(joints, -np.inf)
        self._run_begin_ns = np.full(joints, -1, np.int64)
        self._run_away = np.zeros(joints)
        self._stuck_s, self._stuck_at, self._stuck_effort = (np.zeros(joints) for _ in range(3))
        self._away_s = np.zeros(joints)
        self._efforts = Counts()
        self._volts = np.full(joints, np.nan)
        self._load: dict[str, list[tuple[float, float]]] = {}
        """By bus: load and voltage of samples, the load as the sum of its joints'."""

    def take(self, log: Log) -> None:
        """Take the cycles of the next slice."""
        cycles = log.cycles
        if not len(cycles):
            return
        if self._begin_ns < 0:
            self._begin_ns = int(cycles["read_ns"][0])
            self._size(len(log.joints))
            self._joints = _joints(log)
        self._bins(cycles)
        errors = np.bitwise_or.reduce(cycles["hardware_error"], axis=0)
        self._errors |= errors.astype(np.int64)
        self._hottest = np.fmax(self._hottest, np.fmax.reduce(cycles["temperature"], axis=0))
        self._movement(cycles)
        self._supply(cycles)

    def _bins(self, cycles: NDArray[np.void]) -> None:
        times = cycles["read_ns"] - self._begin_ns
        while int(times[-1]) >= _BINS * self._bin_ns:
            self._halve()
        index = np.clip(times // self._bin_ns, 0, _BINS - 1)
        starts = np.flatnonzero(np.diff(index, prepend=-1))
        bins = index[starts]
        for row, name in enumerate(_QUANTITIES):
            values = np.abs(cycles[name]) if name == "effort" else cycles[name]
            known = np.isfinite(values)
            zero = np.where(known, values, 0.0)
            np.minimum.at(
                self._least[row], bins, np.minimum.reduceat(np.where(known, values, np.inf), starts)
            )
            np.maximum.at(
                self._most[row], bins, np.maximum.reduceat(np.where(known, values, -np.inf), starts)
            )
            np.add.at(self._sum[row], bins, np.add.reduceat(zero, starts))
            np.add.at(self._count[row], bins, np.add.reduceat(known.astype(np.int64), starts))

    def _halve(self) -> None:
        """Join the bins in pairs, which then last twice as long."""
        half = _BINS // 2
        for array, empty in (
            (self._least, np.inf),
            (self._most, -np.inf),
            (self._sum, 0.0),
            (self._count, 0),
        ):
            join = np.minimum if empty == np.inf else np.maximum if empty == -np.inf else np.add
            array[:, :half] = join(array[:, 0::2], array[:, 1::2])
            array[:, half:] = empty
        self._bin_ns *= 2

    def _movement(self, cycles: NDArray[np.void]) -> None:
        """Find the longest time that each joint stood still although its goal was elsewhere."""
        times = cycles["read_ns"]
        share = np.array([joint.share for joint in self._joints])
        away = np.abs(cycles["goal_position"] - cycles["position"]) / share
        driven = (cycles["torque"] == Torque.ON) & cycles["valid"] & ~np.isfinite(cycles["goal_effort"])
        away = np.where(driven, away, 0.0)
        effort = np.abs(cycles["effort"])
        far = away > _AWAY_RAD
        still = far & (np.abs(cycles["velocity"]) < _STILL_RAD_S * share)
        steps = np.diff(times, prepend=times[:1]) * 1e-9
        # far behind, and not for want of speed: what it exerts then is all that it may
        speed = np.abs(cycles["goal_velocity"])
        allowed = np.fmin(speed, np.array([joint.top_speed for joint in self._joints]))
        slow = (away > _FAR_RAD) & (np.abs(cycles["velocity"]) < allowed / 2)
        self._away_s += steps @ slow
        for joint in np.flatnonzero(slow.any(axis=0)).tolist():
            share = effort[slow[:, joint], joint] / self._joints[joint].top_effort
            share = share[np.isfinite(share)]
            self._efforts.take(np.full(len(share), joint, np.int64), np.rint(share * 1000).astype(np.int64))
        for joint in np.flatnonzero(still.any(axis=0) | (self._run_begin_ns >= 0)).tolist():
            self._still(joint, still[:, joint], times, away[:, joint], effort[:, joint])

    def _still(
        self,
        joint: int,
        still: NDArray[np.bool_],
        times: NDArray[np.int64],
        away: Floats,
        effort: Floats,
    ) -> None:
        number = np.arange(len(still))
        last = np.maximum.accumulate(np.where(still, -1, number))  # the newest cycle that was not
        begin = np.where(
            last < 0, int(self._run_begin_ns[joint]), times[np.minimum(last + 1, len(times) - 1)]
        )
        was = np.where(last < 0, self._run_away[joint], away[np.minimum(last + 1, len(away) - 1)])
        if self._run_begin_ns[joint] < 0:
            begin = np.where(last < 0, times[0], begin)
            was = np.where(last < 0, away[0], was)
        lasts = np.where(still, (times - begin) * 1e-9, 0.0)
        stuck = (lasts >= _STUCK_S) & ((away - was >= _GREW_RAD) | (away >= _FAR_RAD))
        if stuck.any():
            longest = int(np.argmax(np.where(stuck, lasts, 0.0)))
            if lasts[longest] > self._stuck_s[joint]:
                self._stuck_s[joint], self._stuck_at[joint] = lasts[longest], away[longest]
            self._stuck_effort[joint] = max(self._stuck_effort[joint], float(effort[stuck].max()))
        self._run_begin_ns[joint] = int(begin[-1]) if still[-1] else -1
        self._run_away[joint] = float(was[-1])

    def _supply(self, cycles: NDArray[np.void]) -> None:
        """Keep the voltages that were read, each with the load of its bus at that moment."""
        volts = cycles["voltage"]
        before = np.vstack([self._volts, volts[:-1]])
        read = np.isfinite(volts) & (volts != before)
        self._volts = volts[-1].copy()
        if not read.any():
            return
        tops = np.array([joint.top_effort for joint in self._joints])
        with np.errstate(invalid="ignore"):
            part = np.nan_to_num(np.abs(cycles["effort"]) / tops)
        for bus in {joint.bus for joint in self._joints}:
            mine = np.array([joint.bus == bus for joint in self._joints])
            rows, columns = np.nonzero(read[:, mine])
            load = part[:, mine].sum(axis=1)
            samples = self._load.setdefault(bus, [])
            if len(samples) < _MOST_SAMPLES:
                pairs = zip(load[rows].tolist(), volts[:, mine][rows, columns].tolist(), strict=True)
                samples += list(pairs)[: _MOST_SAMPLES - len(samples)]

    # Results

    def finish(self) -> tuple[Trend, ...]:
        """Return the trends in the order of the joints."""
        used = int(np.max(np.nonzero(self._count.sum(axis=(0, 2)))[0], initial=-1)) + 1
        found = []
        for index, joint in enumerate(self._joints):
            parts = []
            for row in range(len(_QUANTITIES)):
                bins = (row, slice(used), index)
                count = self._count[bins]
                with np.errstate(invalid="ignore", divide="ignore"):
                    mean = self._sum[bins] / count
                values = (self._least[bins], mean, self._most[bins])
                parts.append(Series(*(_shown(each, count) for each in values)))
            found.append(Trend(joint.name, self._begin_ns / 1e9, self._bin_ns / 1e9, *parts))
        return tuple(found)

    def findings(self) -> Iterable[Finding]:
        """Name hot, blocked, weak and overloaded joints, and supplies that are too low or sag."""
        for index, joint in enumerate(self._joints):
            yield from self._joint(index, joint)
        by_bus: dict[str, list[int]] = {}
        for index, joint in enumerate(self._joints):
            by_bus.setdefault(joint.bus, []).append(index)
        for bus, members in by_bus.items():
            yield from self._power(bus, members)

    def _joint(self, index: int, joint: _Joint) -> Iterable[Finding]:
        error, hottest = int(self._errors[index]), float(self._hottest[index])
        where = f"{joint.name} ({joint.servos})"
        limit = f" of {joint.hottest:.0f} deg C that it may have" if math.isfinite(joint.hottest) else ""
        if error & _HEAT or hottest >= joint.hottest - _NEAR_LIMIT_C:
            shut = ", and reported overheating" if error & _HEAT else ""
            measured = f"was at {hottest:.0f} deg C{limit}" if math.isfinite(hottest) else "was too hot"
            yield Finding(
                "hot_joint",
                joint.name,
                f"{where} {measured}{shut}.",
                "Let it cool; give it less load, pauses or air, and look for what makes it work at rest.",
                Rank.CAUSE,
                1.0,
            )
        strength = float(self._stuck_effort[index]) / joint.top_effort
        if self._weak(index) and not error & _VOLTAGE:
            most = quantile(*self._efforts.of(index), 0.9) / 10
            yield Finding(
                "torque_limit",
                joint.name,
                f"{where} exerts no more than {most:.0f} % of its torque, although it stays far behind its "
                "goal: its torque is limited.",
                "Compare Torque Limit, Goal Current or Goal PWM with the model's: "
                "`dxlrun servo PORT ID get` prints them.",
                Rank.CAUSE,
                2.0,
            )
        elif self._stuck_s[index]:
            at = f", at {strength:.0%} of its torque" if math.isfinite(strength) else ""
            yield Finding(
                "jammed_joint",
                joint.name,
                f"{where} stood still for {self._stuck_s[index]:.1f} s while its goal was "
                f"{joint.logged.position_text(self._stuck_at[index] * joint.share)} away{at}.",
                "Look for what blocks it: an obstacle, a cable in the joint, a broken gear.",
                Rank.CAUSE,
                2.0,
            )
        elif error & _OVERLOAD:
            yield Finding(
                "overload",
                joint.name,
                f"{where} reported overload: its load is more than its torque.",
                "Take load off the joint, or move it slower; a reboot clears the error.",
                Rank.CAUSE,
                1.0,
            )

    def _weak(self, index: int) -> bool:
        """Return whether a joint that stays far behind exerts the same then, and less than its model can."""
        values, counts = self._efforts.of(index)
        if self._away_s[index] < _STUCK_S or not len(values):
            return False
        limit = quantile(values, counts, 0.9)
        same = np.abs(values - limit) <= max(1.0, 0.05 * limit)
        return limit < _WEAK * 1000 and bool(counts[same].sum() >= _WEAK * counts.sum())

    def _power(self, bus: str, members: list[int]) -> Iterable[Finding]:
        low = [self._joints[index].name for index in members if self._errors[index] & _VOLTAGE]
        least = self._least[1][:, members].min(initial=np.inf)
        samples = np.array(self._load.get(bus, [])).reshape(-1, 2)
        if len(samples) >= _FEWEST_VOLTAGES and samples[:, 0].std() > 0 and samples[:, 1].std() > 0:
            highest = samples[:, 1].max()
            falls = [
                index
                for index in members
                if self._least[1][:, index].min() < (1 - _SAG) * self._most[1][:, index].max()
            ]
            together = float(np.corrcoef(samples.T)[0, 1])
            if 2 * len(falls) > len(members) > 1 and together <= _SAGS_WITH_LOAD:
                yield Finding(
                    "sagging_supply",
                    bus,
                    f"The supply of bus {bus} sags under load: from {highest:.1f} V at rest to "
                    f"{least:.1f} V.",
                    "Use a stronger supply or a fresh battery, thicker and shorter cables, and feed the bus "
                    "at more than one end.",
                    Rank.CAUSE,
                    2.0,
                )
                return
        if low:
            alone = len(low) == 1 < len(members)
            yield Finding(
                "undervoltage",
                low[0] if alone else bus,
                f"The voltage at {', '.join(low)} is out of its limits"
                + (f": {least:.1f} V at least." if math.isfinite(least) else "."),
                "Check its plug and cable." if alone else "Check the supply or the battery of the bus.",
                Rank.CAUSE,
                1.5,
            )


def _shown(values: Floats, count: NDArray[np.int64]) -> tuple[float | None, ...]:
    """Return the values of bins to six digits: sums depend on the slices in the last ones."""
    pairs = zip(values.tolist(), count.tolist(), strict=True)
    return tuple(round(value, 6) if number else None for value, number in pairs)


def _joints(log: Log) -> list[_Joint]:
    plan = plan_of(log)
    found = {name: _Joint(name) for name in log.joints}
    for name, movers in plan.movers.items():
        if name not in found:
            continue
        joint = plan.joint(name)
        speeds = [each for each in (joint.velocity, joint.top_speed) if each]
        share = sum(one.share for one in movers) if joint.linear else 1.0
        found[name] = _Joint(
            name,
            movers[0].bus.name,
            ", ".join(f"servo {one.servo.servo_id} on bus {one.bus.name}" for one in movers),
            np.fmin.reduce([_hottest(one.bus, one.servo) for one in movers]).item(),
            1.0 if joint.top_effort is None else joint.top_effort,
            min(speeds, default=_TOP_RAD_S * share),
            joint,
            share,
        )
    return list(found.values())


_LIMITS = ("temperature_limit", "motor_temperature_limit")


def _hottest(bus: LoggedBus, servo: LoggedServo) -> float:
    """Return the temperature limit of a servo, deg C: the robot file's, or its model's as shipped."""
    declared: Mapping[str, int] = {each.name: each.value for each in servo.registers}
    try:
        items = control_table(servo.model, bus.protocol).items
    except LookupError:  # a plug-in's model that is not installed here
        return math.nan
    for name in _LIMITS:
        value = declared.get(name, items[name].initial if name in items else None)
        if value:
            return value * items[name].scale
    return math.nan
