"""Goals in SI units -> ticks of the wire, for the servos of one bus that are in one mode; prepared once.

Number by number: a bus has so few servos that this takes half of the time of arrays, less when the processor
has just waked up.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dxlrun.dynamixel.bus_plan import Field, GoalLayout, ModePlan, Scale, ServoPlan
from dxlrun.interfaces import COMMAND_INTERFACES, CommandName
from dxlrun.mode import Mode

_CLOCKWISE = 0x400
"""Direction bit of sign-magnitude goals: bit 10 (e-Manual AX-12A, Moving Speed (32))."""
_LEADS: Mapping[Mode, CommandName] = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}

Ceiling = Sequence[float] | None
"""The highest speed of each servo toward a position, rad/s, NaN: none; None: nobody has one."""
_Signed = tuple[float, float, float, int, int]
"""(sign * goal + offset) / unit is the tick, from the lowest to the highest."""
_Magnitude = tuple[float, int, int, int]
"""|goal| / unit is the tick, from the lowest to the highest; what it is where nothing is wanted."""


class Item(NamedTuple):
    """One goal of several servos: where it stands, and how it becomes ticks."""

    place: Field
    """In a servo's block on the wire."""
    span: slice
    """Of the goals' bytes: what is elsewhere does not concern it."""
    slowed: bool
    """A ceiling holds for it."""
    ticks: Callable[[bytes, Ceiling], list[int]]
    """The ticks of each servo; what they are of one that gets no goal does not matter."""


@dataclass(frozen=True, slots=True)
class Group:
    """The servos of one bus that are in one mode and have one layout of its goals."""

    mode: Mode
    servos: Sequence[ServoPlan]
    members: Sequence[int]
    """Their numbers on the bus."""
    count: int
    """How many servos the bus has: so long is each row of its goals."""
    limits: Sequence[Mapping[str, int]]
    """The own limits of each, ticks, by what they limit."""
    fraction: float
    """So much of an effort's or a PWM's limit may be used."""

    @property
    def lead(self) -> CommandName:
        """The goal by which the mode goes."""
        return _LEADS.get(self.mode, "position")

    @property
    def layouts(self) -> tuple[GoalLayout, ...]:
        """The blocks of goals, in the order in which they are sent."""
        return self.servos[0].mode_plan(self.mode).goals

    def unpack(self, name: CommandName) -> Callable[[bytes], tuple[float, ...]]:
        """Return what takes one kind of goal of these servos out of the goals of the bus."""
        form, at, row = "=", 0, COMMAND_INTERFACES.index(name) * self.count
        for member in self.members:
            form += f"{8 * (row + member - at)}xd"
            at = row + member + 1
        return struct.Struct(form).unpack_from

    def items(self, layout: GoalLayout) -> list[Item]:
        """Return the goals that stand in a block, in the order of the wire."""
        found: list[Item] = []
        if layout.position is not None:
            found.append(self._signed(layout.position, "position", self._positions()))
            if layout.speed is not None:
                found.append(self._magnitudes(layout.speed, "velocity", self._speeds()))
        elif layout.speed is not None:
            found.append(self._signed(layout.speed, self.lead, self._both_ways("speed")))
        elif layout.pwm is not None:
            found.append(self._signed(layout.pwm, self.lead, self._both_ways("pwm")))
        elif layout.effort is not None and self.mode is Mode.EFFORT:
            found.append(self._signed(layout.effort, self.lead, self._both_ways("effort")))
        elif layout.effort is not None:
            found.append(self._magnitudes(layout.effort, "effort", self._efforts()))
        return sorted(found, key=lambda item: item.place.offset)

    def _signed(self, place: Field, name: CommandName, scales: Sequence[_Signed]) -> Item:
        unpack, mirrored = self.unpack(name), place.encoding == "sign_magnitude"

        def ticks(goals: bytes, _: Ceiling) -> list[int]:
            found = [
                round(tick)
                if low <= (tick := (sign * goal + offset) / unit) <= high
                # NaN, too, is somewhere
                else low
                if tick < low
                else high
                for goal, (sign, offset, unit, low, high) in zip(unpack(goals), scales, strict=True)
            ]
            return [tick if tick >= 0 else _CLOCKWISE - tick for tick in found] if mirrored else found

        return Item(place, self._span(name), False, ticks)

    def _magnitudes(self, place: Field, name: CommandName, scales: Sequence[_Magnitude]) -> Item:
        unpack = self.unpack(name)

        def ticks(goals: bytes, ceiling: Ceiling) -> list[int]:
            values: Sequence[float] = unpack(goals)
            if ceiling is not None and name == "velocity":
                values = [_slower(value, most) for value, most in zip(values, ceiling, strict=True)]
            return [
                round(tick)
                if low <= (tick := abs(value) / unit) <= high
                else low
                if tick < low
                else high
                if tick > high
                else free
                for value, (unit, low, high, free) in zip(values, scales, strict=True)
            ]

        return Item(place, self._span(name), name == "velocity", ticks)

    def _span(self, name: CommandName) -> slice:
        row = 8 * self.count
        return slice(row * COMMAND_INTERFACES.index(name), row * (COMMAND_INTERFACES.index(name) + 1))

    def _positions(self) -> list[_Signed]:
        """Counted from the servo's raw 0, to the nearest tick, inside the joint's limits."""
        return [
            (float(servo.direction), servo.reference, servo.rad_per_tick, plan.lower_tick, plan.upper_tick)
            for servo, plan in self._modes()
        ]

    def _both_ways(self, of: str) -> list[_Signed]:
        return [
            (float(servo.direction), 0.0, unit, -most, most)
            for (servo, _), (unit, most) in zip(self._modes(), self._reach(of), strict=True)
        ]

    def _speeds(self) -> list[_Magnitude]:
        """0 rad/s is 1 tick, because 0 ticks mean as fast as it can: that is what NaN becomes."""
        return [(unit, 1, max(most, 1), 0) for unit, most in self._reach("speed")]

    def _efforts(self) -> list[_Magnitude]:
        """Nothing wanted: all that the limit lets the servo take."""
        return [(unit, 0, most, most) for unit, most in self._reach("effort")]

    def _modes(self) -> list[tuple[ServoPlan, ModePlan]]:
        return [(servo, servo.mode_plan(self.mode)) for servo in self.servos]

    def _reach(self, of: str) -> list[tuple[float, int]]:
        """Return unit and highest tick of each servo; 1 and 0 where a mode has no such goal."""
        found: list[tuple[float, int]] = []
        for (_, plan), limits in zip(self._modes(), self.limits, strict=True):
            scale: Scale | None = {"speed": plan.speed, "effort": plan.effort, "pwm": plan.pwm}[of]
            if scale is None:
                found.append((1.0, 0))
            else:
                fraction = 1.0 if of == "speed" else self.fraction
                found.append(
                    (scale.per_tick, math.floor(min(scale.most, limits.get(of, scale.most)) * fraction))
                )
        return found


def _slower(velocity: float, most: float) -> float:
    """Return a speed that is no higher than a ceiling; NaN is no ceiling, and no speed."""
    return velocity if math.isnan(most) or abs(velocity) <= most else most
