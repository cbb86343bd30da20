"""Joint units: SI and display units of the positions, speeds and efforts of rotary and linear joints."""

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
"""Attributes of each unit, in the order of their declarations in `JointUnit`."""


class JointUnit(Enum):
    """Unit of a joint's positions: an angle for a rotary joint, a length for a linear one.

    The value is the SI unit in plans, logs and answers: `JointUnit("m") is LINEAR`. A module that needs
    another property of each kind of joint, such as a threshold, has a table with units as keys."""

    ROTARY = "rad"
    LINEAR = "m"

    si: str  # SI unit of positions, equal to the value
    shown: str  # Display unit
    factor: float  # Display units per SI unit
    digits: int  # Decimal places of a measured position
    suffix: str  # Suffix of a number in a table whose title already states deg
    torque: str  # SI unit of a servo's torque at the joint
    verb: str  # Property of the joint, for sentences
    quantity: str  # Quantity of a position, for sentences

    def __init__(self, si: str) -> None:
        self.si = si
        texts = _TEXTS[si]
        self.shown, self.factor, self.digits, self.suffix, self.torque, self.verb, self.quantity = texts

    @property
    def speed(self) -> str:
        """SI unit of the joint's speeds, such as `rad/s`."""
        return f"{self.si}/s"

    @property
    def acceleration(self) -> str:
        """SI unit of the joint's accelerations, such as `rad/s^2`."""
        return f"{self.si}/s^2"

    def effort_unit(self, measured: str) -> str:
        """Return the unit of a joint's effort if its servo measures effort in `measured`: N in place of Nm
        for a linear joint."""
        return self.torque if measured == "Nm" else measured

    def number(self, position: float, *, digits: int = 2, trim: bool = True, signed: bool = False) -> str:
        """Format a position in display units, without the unit: `30`.

        Args:
            position: rad or m.
            digits: Decimal places.
            trim: Omit trailing zeros: `30`, not `30.00`.
            signed: Write the sign of a positive number: `+30`.
        """
        value = round(position * self.factor, digits) + 0.0  # + 0.0: no minus sign before zero
        text = f"{value:.{digits}f}"
        if trim and "." in text:
            text = text.rstrip("0").rstrip(".")
        return f"+{text}" if signed and value > 0 else text

    def text(self, position: float, *, digits: int = 2, trim: bool = False) -> str:
        """Format a position or a distance (rad or m) in display units with the unit: `12.30 deg`, `4.56
        mm`. Arguments as in `number`."""
        return f"{self.number(position, digits=digits, trim=trim)} {self.shown}"

    def speed_text(self, speed: float) -> str:
        """Format a speed, rad/s or m/s, in display units: `12.30 deg/s`."""
        return f"{self.text(speed)}/s"

    def exact_text(self, position: float) -> str:
        """Format a position (rad or m) in display units with six significant digits: `12.3457 deg`."""
        return f"{position * self.factor:.6g} {self.shown}"

    @classmethod
    def find_by_quantity(cls, si_unit: str) -> JointUnit:
        """Return the joint unit whose positions, speeds, accelerations or torques have this SI unit.

        Raises:
            LookupError: No joint has a quantity in this unit.
        """
        for unit in cls:
            if si_unit in {unit.si, unit.speed, unit.acceleration, unit.torque}:
                return unit
        raise LookupError(f"{si_unit} is not a unit of a joint")


ROTARY, LINEAR = JointUnit.ROTARY, JointUnit.LINEAR
