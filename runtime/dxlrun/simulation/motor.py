"""The motor of a simulated servo with its gear, from the figures of the e-Manual's Specifications."""

from __future__ import annotations

from dataclasses import dataclass

from dxlrun.control_table import ControlTable

TIME_CONSTANT_S = 0.01
"""How fast an unloaded motor takes up speed: its inertia times no-load speed over stall torque.

The manual gives no inertia; small motors of this kind have 5 to 20 ms [i].
"""

STALL_POWER_W = 20.0
"""Stall torque times no-load speed where the manual gives no stall torque: as an XM430-W350 [i]."""

STALL_CURRENT_A = 1.5
"""Where the manual gives none and the model measures none: as an AX-12A [i]."""


@dataclass(frozen=True, slots=True)
class Motor:
    """A direct-current motor with its gear, as felt at the shaft: torque falls with speed in a line."""

    max_speed: float
    """No-load speed, rad/s, at `voltage`"""
    stall_torque: float
    """Nm at `voltage`"""
    stall_current: float
    """A at `stall_torque`"""
    voltage: float
    """V at which the three hold; 0: whatever it is supplied with"""
    inertia: float
    """kg m^2 of rotor and gear"""

    @property
    def damping(self) -> float:
        """Torque that a motor with closed terminals loses to its own voltage, Nm s/rad."""
        return self.stall_torque / self.max_speed

    @property
    def torque_per_ampere(self) -> float:
        """Nm/A."""
        return self.stall_torque / self.stall_current


def motor_of(table: ControlTable) -> Motor:
    """Return a model's motor: the table's figures, and estimates where the manual gives none."""
    torque = table.stall_torque or STALL_POWER_W / table.max_speed
    limit = table.items.get("current_limit")
    measured = limit.maximum * limit.scale if limit is not None else STALL_CURRENT_A
    return Motor(
        max_speed=table.max_speed,
        stall_torque=torque,
        stall_current=table.stall_current or measured,
        voltage=table.nominal_voltage,
        inertia=TIME_CONSTANT_S * torque / table.max_speed,
    )
