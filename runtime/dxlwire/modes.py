"""Modes: command interfaces of a joint (position, velocity, effort, PWM), their valid combinations, and the
servo mode for each.

No numpy here: the guardian reads the plan of a bus and must stay small."""

from __future__ import annotations

from collections.abc import Collection
from enum import IntEnum, unique
from typing import Literal

CommandName = Literal["position", "velocity", "effort", "pwm"]

EffortUnit = Literal["Nm", "A", "1"]
"""Unit of an effort, as in the control tables; `1`: the fraction of the maximum."""

COMMAND_INTERFACES: tuple[CommandName, ...] = ("position", "velocity", "effort", "pwm")


@unique
class Mode(IntEnum):
    """Control mode of a servo: the quantity that its goals command. The number is stored in logs."""

    UNKNOWN = 0  # Unknown or changing: the joint gets no goals
    POSITION = 1  # Moves to a position, at full speed or at a given one; counts turns for a continuous joint
    VELOCITY = 2  # Rotates continuously at a speed
    EFFORT = 3  # Applies a torque or a current
    PWM = 4  # Applies a fraction of the full voltage
    EFFORT_POSITION = 5  # Moves to a position with limited effort


_MODES: dict[frozenset[str], Mode] = {
    frozenset({"position"}): Mode.POSITION,
    frozenset({"position", "velocity"}): Mode.POSITION,
    frozenset({"velocity"}): Mode.VELOCITY,
    frozenset({"effort"}): Mode.EFFORT,
    frozenset({"pwm"}): Mode.PWM,
    frozenset({"position", "effort"}): Mode.EFFORT_POSITION,
    frozenset({"position", "velocity", "effort"}): Mode.EFFORT_POSITION,
}


def mode_of(names: Collection[str]) -> Mode:
    """Return the servo mode for a combination of command interfaces, such as position and velocity.

    Raises:
        ValueError: No mode has this combination, or it is empty.
    """
    mode = _MODES.get(frozenset(names))
    if mode is None:
        combined = f"combines {' and '.join(names)}" if names else "is named"
        raise ValueError(f"no servo mode {combined}")
    return mode
