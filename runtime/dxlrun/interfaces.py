"""Names and arrays by which controllers see joints: state, command, goal; SI units, one row a joint."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dxlrun.mode import Mode, mode_of

__all__ = ["COMMAND_INTERFACES", "CommandName", "Commands", "Floats", "Mode", "States", "mode_of"]

CommandName = Literal["position", "velocity", "effort", "pwm"]

COMMAND_INTERFACES: tuple[CommandName, ...] = ("position", "velocity", "effort", "pwm")

LOST_CYCLES = 3
"""A servo that missed so many replies in a row is lost, until it answers again ..."""
LOST_AGE_NS = 50_000_000
"""... and whose last reply is so old: at 50 Hz it is by then, but three cycles at 1 kHz are less than
what hosts, virtual machines and USB adapters stand still for [i]."""

Floats = NDArray[np.float64]
"""Shape (joints,): rad, rad/s, Nm, A, or the fraction of maximum where the servo measures no torque."""


@dataclass(frozen=True, slots=True)
class States:
    """States of the joints: one row a joint; an invalid row keeps its last values and its age grows."""

    motion: Floats
    """Shape (3, joints): position, velocity and effort, for use all at once."""
    position: Floats = field(init=False)
    velocity: Floats = field(init=False)
    effort: Floats = field(init=False)
    valid: NDArray[np.bool_]
    """True where this cycle's reply arrived intact."""
    age_ns: NDArray[np.int64]
    """Time since the reply that the row shows arrived; -1 while none ever did."""
    temperature: Floats
    """deg C, read now and then; NaN until it was."""
    voltage: Floats
    """V at the servo, read now and then; NaN until it was."""
    hardware_error: NDArray[np.uint8]
    """Bits of the e-Manual's Hardware Error Status; Protocol 1.0: those of ERR that are states; 0: none."""
    mode: NDArray[np.uint8]
    """A Mode: in which the servo is known to be; UNKNOWN while that changes."""

    def __post_init__(self) -> None:
        for name, row in zip(("position", "velocity", "effort"), self.motion, strict=True):
            object.__setattr__(self, name, row)

    @classmethod
    def empty(cls, joints: int) -> States:
        """Return arrays of NaN, invalid, of no age and of unknown mode."""
        return cls(
            motion=np.full((3, joints), np.nan),
            valid=np.zeros(joints, dtype=np.bool_),
            age_ns=np.full(joints, -1, dtype=np.int64),
            temperature=np.full(joints, np.nan),
            voltage=np.full(joints, np.nan),
            hardware_error=np.zeros(joints, dtype=np.uint8),
            mode=np.zeros(joints, dtype=np.uint8),
        )


@dataclass(frozen=True, slots=True)
class Commands:
    """Commands of the joints: one row a joint, NaN = not commanded.

    Which of them count depends on the joint's mode, see `mode_of`.
    """

    values: Floats
    """Shape (4, joints): all of them, in the order of COMMAND_INTERFACES, for use all at once."""
    position: Floats = field(init=False)
    """rad"""
    velocity: Floats = field(init=False)
    """rad/s. Beside a position: magnitude of the speed toward it, NaN = as fast as the servo can. Alone: the
    speed at which the joint turns, with its sign."""
    effort: Floats = field(init=False)
    """In the unit of the state's effort: Nm, A, or the fraction of maximum. Beside a position: the most that
    the servo may exert, a magnitude. Alone: with its sign."""
    pwm: Floats = field(init=False)
    """Fraction of the full voltage, -1..1"""

    def __post_init__(self) -> None:
        for name, row in zip(COMMAND_INTERFACES, self.values, strict=True):
            object.__setattr__(self, name, row)

    @classmethod
    def empty(cls, joints: int) -> Commands:
        """Return arrays of NaN."""
        return cls(np.full((len(COMMAND_INTERFACES), joints), np.nan))

    def clear(self) -> None:
        """Command nothing any more."""
        self.values.fill(np.nan)
