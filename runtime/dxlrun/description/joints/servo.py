"""Servo: figures of a joint's servo from the e-Manual and the control table."""

from __future__ import annotations

import msgspec

from dxlwire.modes import EffortUnit


class ServoModel(msgspec.Struct, frozen=True):
    """Figures of a joint's servo from its manual, at the joint; None: not known."""

    model: str
    label: str  # ID and bus, for messages
    effort_unit: EffortUnit
    """Unit of the measured effort; `1`: a fraction of the highest load, which is the motor's output."""
    stall_torque: float | None = None  # Nm at `voltage`
    stall_current: float | None = None  # A at `voltage`
    voltage: float | None = None  # V; supply for which the manual gives the figures
    no_load_speed: float | None = None  # rad/s at `voltage`
    temperature_limit: float | None = None
    """degrees C; above it the servo cuts its torque. From the robot file's `registers`, else the factory's
    value."""
