"""Servo: what the e-Manual and the control table say of a joint's servo, beyond what a cycle reads."""

from __future__ import annotations

import msgspec

from dxlwire.modes import EffortUnit


class ServoModel(msgspec.Struct, frozen=True):
    """A joint's servo by its manual, as felt at the joint; a figure that is not known is None."""

    model: str
    label: str  # ID and bus, as sentences name it
    effort_unit: EffortUnit
    """Of the effort that it measures; `1`: a part of its highest load, which is the motor's output"""
    stall_torque: float | None = None  # Nm at `voltage`
    stall_current: float | None = None  # A at `voltage`
    voltage: float | None = None  # V for which the manual gives its figures
    no_load_speed: float | None = None  # rad/s at `voltage`
    temperature_limit: float | None = None
    """degrees C beyond which it cuts its torque: that of the robot file's `registers`, else as shipped"""
