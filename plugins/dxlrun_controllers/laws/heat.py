"""Heat: how warm servos become by their currents, and how much torque they may still give.

Each servo is one body that its winding heats and the air cools,

    time constant dT/dt = ambient + thermal resistance * resistance * I^2 - T + correction,

and the temperature that it measures pulls the model after it, as an observer: it comes about once a second,
in whole degrees, and makes up for an ambient and figures that are not known well. After S. Trujillo,
M. Cutkosky, "Thermally constrained motor operation for a climbing robot" (ICRA 2009), with one body, not two.
"""

from __future__ import annotations

import fnmatch
import functools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dxlrun import Floats, MotorModel, ServoModel

_FILE: Final = Path(__file__).with_name("servo_heat.toml")


@dataclass(frozen=True, slots=True)
class ServoHeat:
    """How a servo keeps its heat."""

    thermal_resistance: float
    """K/W between it and the air"""
    time_constant: float
    """s"""


def heat_of(model: str) -> ServoHeat | None:
    """Return how servos of a model keep their heat; None: nothing is known of them."""
    for pattern, known in _series():
        if fnmatch.fnmatchcase(model, pattern):
            return known
    return None


@functools.cache
def _series() -> tuple[tuple[str, ServoHeat], ...]:
    data = tomllib.loads(_FILE.read_text("utf-8"))
    found: list[tuple[str, ServoHeat]] = []
    for series in data["series"]:
        a, b, c = (side * 1e-3 for side in series["dimensions"])
        resistance = 1.0 / (data["transfer"] * 2 * (a * b + b * c + c * a))
        known = ServoHeat(resistance, resistance * data["heat"] * series["weight"] * 1e-3)
        found += [(pattern, known) for pattern in series["models"]]
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Winding:
    """What tells a servo's current from its effort, speed and voltage, and its heat from that."""

    resistance: float
    """ohm"""
    current_per_effort: float
    """A; of a servo that measures its output, at the voltage `supply`"""
    current_per_speed: float = 0.0
    """A s/rad that its own voltage takes off"""
    supply: float = 0.0
    """V; 0: the effort is a current or a torque, whatever the supply"""


def winding_of(servo: ServoModel, motor: MotorModel | None) -> Winding | None:
    """Return a servo's winding by its motor file, else by the manual's stall; None: there is neither."""
    stall, voltage, speed = servo.stall_current, servo.voltage, servo.no_load_speed
    if motor is not None:
        supply, resistance, constant = motor.voltage, motor.resistance, motor.torque_constant
    elif stall is not None and voltage is not None and speed is not None:
        supply, resistance, constant = voltage, voltage / stall, voltage / speed
    else:
        return None
    if servo.effort_unit == "A":
        return Winding(resistance, 1.0)
    if servo.effort_unit == "1":
        return Winding(resistance, supply / resistance, constant / resistance, supply)
    if motor is not None:
        return Winding(resistance, 1.0 / motor.torque_constant)
    if stall is not None and servo.stall_torque is not None:
        return Winding(resistance, stall / servo.stall_torque)
    return None


class Heating:
    """Temperatures of some servos by their windings; all arrays have the shape (joints,)."""

    __slots__ = (
        "_ambient",
        "_backward",
        "_by_output",
        "_correction_s",
        "_forward",
        "_known",
        "_nominal",
        "_rise",
        "_time_constant",
        "_unheard",
        "_work",
        "current",
        "temperature",
    )

    def __init__(
        self, windings: Sequence[Winding], heats: Sequence[ServoHeat], ambient: float, correction_s: float
    ) -> None:
        """`correction_s`: time constant with which the measured temperature pulls the model after it, s."""
        count = len(windings)
        self.temperature = np.full(count, np.nan)
        """degrees C; NaN before `begin`"""
        self.current = np.zeros(count)
        """A, magnitude"""
        self._ambient, self._correction_s = ambient, correction_s
        self._forward = np.array([each.current_per_effort for each in windings])
        self._backward = np.array([each.current_per_speed for each in windings])
        self._nominal = np.array([each.supply or 1.0 for each in windings])
        self._by_output = np.array([each.supply > 0 for each in windings])
        self._rise = np.array(
            [heat.thermal_resistance * each.resistance for heat, each in zip(heats, windings, strict=True)]
        )
        """K for each A^2"""
        self._time_constant = np.array([heat.time_constant for heat in heats])
        self._work = np.zeros(count)
        self._known = np.zeros(count, dtype=np.bool_)
        self._unheard = np.ones(count, dtype=np.bool_)
        """Nothing was measured at the last update"""

    def begin(self, measured: Floats) -> None:
        """Begin where the servos are; where that is not known yet, at the ambient temperature."""
        np.copyto(self.temperature, measured)
        np.isnan(measured, out=self._unheard)
        np.copyto(self.temperature, self._ambient, where=self._unheard)

    def take_current(self, effort: Floats, velocity: Floats, voltage: Floats) -> None:
        """Work out the currents; what is not known (NaN) draws none, and has its nominal voltage."""
        current, work, known = self.current, self._work, self._known
        np.multiply(effort, self._forward, out=current)
        np.divide(voltage, self._nominal, out=work)
        np.isfinite(work, out=known)
        known &= self._by_output
        np.multiply(current, work, out=current, where=known)
        np.multiply(velocity, self._backward, out=work)
        current -= work
        np.isnan(current, out=known)
        np.copyto(current, 0.0, where=known)
        np.abs(current, out=current)

    def update(self, measured: Floats, period_s: float) -> None:
        """Let a time pass at the current, degrees C measured meanwhile; NaN: nothing was."""
        temperature, work, known = self.temperature, self._work, self._known
        np.isfinite(measured, out=known)
        self._unheard &= known  # heard for the first time, or again
        np.copyto(temperature, measured, where=self._unheard)
        np.logical_not(known, out=self._unheard)
        np.subtract(measured, temperature, out=work)
        work *= period_s / (self._correction_s + period_s)
        np.add(temperature, work, out=temperature, where=known)
        np.multiply(self.current, self.current, out=work)
        work *= self._rise
        work += self._ambient
        work -= temperature
        work /= self._time_constant
        work *= period_s
        temperature += work


def torque_scale(temperature: Floats, warn: Floats, limit: Floats, out: Floats) -> None:
    """Write which part of its torque each servo may give: all below `warn`, none from `limit` on."""
    np.subtract(limit, temperature, out=out)
    out /= limit - warn
    np.maximum(out, 0.0, out=out)
    np.minimum(out, 1.0, out=out)
