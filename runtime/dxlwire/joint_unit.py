"""Units of joints: what the positions, speeds and efforts of a joint are in, and how people read them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import TypeAlias

_Texts: TypeAlias = tuple[str, float, int, str, str, str, str]
_TEXTS: Mapping[str, _Texts] = {
    "rad": ("deg", math.degrees(1.0), 1, "", "Nm", "turns", "an angle"),
    "m": ("mm", 1e3, 2, " mm", "N", "is linear", "a length"),
}
"""Attributes of the units, in the order in which `JointUnit` declares them."""


class JointUnit(Enum):
    """Unit of a joint's positions: an angle of a joint that turns, a length of a linear one.

    The value is the SI unit, which plans, logs and answers name: `JointUnit("m") is LINEAR`. A module that
    needs something else of each kind of joint, such as a threshold, has a table with units as keys.
    """

    ROTARY = "rad"
    LINEAR = "m"

    si: str  # SI unit of positions, which is the value
    shown: str  # Unit that people read
    factor: float  # A position as people read it, for 1 in SI
    digits: int  # After the decimal point of a position that a servo measures
    suffix: str  # After a number in a table whose title says that numbers are in deg
    torque: str  # SI unit of what a servo's torque becomes at the joint
    verb: str  # What the joint does, in sentences
    quantity: str  # What a position is, in sentences

    def __init__(self, si: str) -> None:
        self.si = si
        texts = _TEXTS[si]
        self.shown, self.factor, self.digits, self.suffix, self.torque, self.verb, self.quantity = texts

    @property
    def speed(self) -> str:
        """SI unit of speeds."""
        return f"{self.si}/s"

    @property
    def acceleration(self) -> str:
        """SI unit of accelerations."""
        return f"{self.si}/s^2"

    def effort_unit(self, measured: str) -> str:
        """Return the unit of a joint's effort, by the unit in which its servo measures: N in place of Nm."""
        return self.torque if measured == "Nm" else measured

    def number(self, position: float, *, digits: int = 2, trim: bool = True, signed: bool = False) -> str:
        """Write a position as people read it, without its unit: `30`.

        Args:
            position: rad or m.
            digits: Digits after the decimal point.
            trim: Omit zeros after the last digit that counts: `30`, not `30.00`.
            signed: Write the sign of a number above 0: `+30`.
        """
        value = round(position * self.factor, digits) + 0.0  # + 0.0: no minus sign before zero
        text = f"{value:.{digits}f}"
        if trim and "." in text:
            text = text.rstrip("0").rstrip(".")
        return f"+{text}" if signed and value > 0 else text

    def text(self, position: float, *, digits: int = 2, trim: bool = False) -> str:
        """Write a position or a distance as people read it: `12.30 deg`, `4.56 mm`. Arguments as `number`."""
        return f"{self.number(position, digits=digits, trim=trim)} {self.shown}"

    def speed_text(self, speed: float) -> str:
        """Write a speed, rad/s or m/s, as people read it: `12.30 deg/s`."""
        return f"{self.text(speed)}/s"

    def exact_text(self, position: float) -> str:
        """Write a position with six significant digits: `12.3457 deg`."""
        return f"{position * self.factor:.6g} {self.shown}"

    @classmethod
    def find_by_quantity(cls, si_unit: str) -> JointUnit:
        """Return the kind of joint that has a position, speed, acceleration or torque in an SI unit.

        Raises:
            LookupError: No joint has a quantity in this unit.
        """
        for unit in cls:
            if si_unit in {unit.si, unit.speed, unit.acceleration, unit.torque}:
                return unit
        raise LookupError(f"no joint has a quantity in {si_unit}")


ROTARY, LINEAR = JointUnit.ROTARY, JointUnit.LINEAR
