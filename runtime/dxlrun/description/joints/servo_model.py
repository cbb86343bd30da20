"""Servo model: a joint's servo figures from its manual and control table."""

from __future__ import annotations

import msgspec

from dxlwire.modes import EffortUnit


class ServoModel(msgspec.Struct, frozen=True):
    """Manual figures of a joint's servo, converted to the joint by its gear; None: not known."""

    model: str
    label: str  # ID and bus, for messages
    effort_unit: EffortUnit
    """Unit of the effort that the servo measures; `1`: a fraction of its highest load."""
    stall_torque: float | None = None  # Nm at `voltage`
    stall_current: float | None = None  # A at `voltage`
    voltage: float | None = None  # V; supply for which the manual gives the figures
    no_load_speed: float | None = None  # rad/s at `voltage`
    temperature_limit: float | None = None
    """Temperature above which the servo cuts its torque, degrees C: from the file's `registers`, else the
    factory's value."""
