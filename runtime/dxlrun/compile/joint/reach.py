"""Reach: what angles a servo can take, seen in the coordinate of its joint."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dxlrun.dynamixel.control_table import ControlTable

_TOLERANCE = 1e-6
"""rad; far below a tick (5e-3 rad on an AX-12), far above the rounding of degrees."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Closed interval of joint angles, rad."""

    lower: float
    upper: float

    def contains(self, other: Interval) -> bool:
        """Say whether `other` lies inside, but for rounding."""
        return other.lower >= self.lower - _TOLERANCE and other.upper <= self.upper + _TOLERANCE

    def meet(self, other: Interval) -> Interval | None:
        """Return what both have in common; None when that is not more than a point."""
        lower, upper = max(self.lower, other.lower), min(self.upper, other.upper)
        return Interval(lower, upper) if lower < upper else None

    def __str__(self) -> str:
        return f"{degrees(self.lower, signed=True)}..{degrees(self.upper, signed=True)} deg"


MANY_TURNS = {1.0: 7, 2.0: 256}
"""Turns that a goal position can be away from raw 0, by protocol: Multi-turn Mode of MX (e-Manual MX-64, Goal
Position (30): -28,672..28,672), Extended Position Control Mode (e-Manual XM430-W350, Goal Position (116):
-1,048,575..1,048,575)."""


def many_turns(protocol: float, reference: float, direction: int) -> Interval:
    """Return the reach of a continuous joint, rad: how far its goal positions go."""
    turns = 2 * math.pi * MANY_TURNS[protocol]
    middle = -direction * reference
    return Interval(middle - turns, middle + turns)


def servo_travel(table: ControlTable) -> Interval:
    """Return the angles that a servo's goal positions reach, rad from raw 0.

    From 0 on in Protocol 1.0 and on X and MX, to both sides of 0 on P, PRO and Y (e-Manual, Goal Position).
    """
    return Interval(table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick)


def joint_reach(travel: Interval, reference: float, direction: int) -> Interval:
    """Return the reach of a joint, rad, of a servo that turns within `travel`, rad from raw 0.

    q = direction * (theta - reference), theta in `travel` (thesis of M. Amarante Araujo, 2017, JointID).
    """
    ends = (direction * (travel.lower - reference), direction * (travel.upper - reference))
    return Interval(min(ends), max(ends))


def degrees(angle: float, *, signed: bool = False) -> str:
    """Write an angle of `angle` rad in degrees, with as many digits as it needs, at most two."""
    value = round(math.degrees(angle), 2) + 0.0  # + 0.0: no minus sign before zero
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return f"+{text}" if signed and value > 0 else text
