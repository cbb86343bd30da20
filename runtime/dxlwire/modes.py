"""Modes: the command interfaces of a joint, which of them go together, and what a servo then does.

Without numpy: the guardian reads a bus' plan and is light.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import IntEnum, unique
from typing import Literal

CommandName = Literal["position", "velocity", "effort", "pwm"]

EffortUnit = Literal["Nm", "A", "1"]
"""Of an effort, as in the control tables; `1`: the fraction of the maximum."""

COMMAND_INTERFACES: tuple[CommandName, ...] = ("position", "velocity", "effort", "pwm")


@unique
class Mode(IntEnum):
    """What a servo does with its goals; the number is in the log."""

    UNKNOWN = 0  # Not known, or changing now: the joint gets no goals
    POSITION = 1  # Goes to a position, as fast as it can or at a speed; of a continuous joint over many turns
    VELOCITY = 2  # Turns at a speed, for ever
    EFFORT = 3  # Exerts a torque, or draws a current
    PWM = 4  # Gets a fraction of the full voltage
    EFFORT_POSITION = 5  # Goes to a position with no more effort than is commanded


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
    """Return the mode in which a joint follows these command interfaces together.

    Raises ValueError for interfaces that no mode has together, and for none.
    """
    mode = _MODES.get(frozenset(names))
    if mode is None:
        raise ValueError(f"no servo follows {' and '.join(names) or 'nothing'} together")
    return mode
