"""Names and arrays by which controllers see joints: state, command, goal; SI units, one row a joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

CommandName = Literal["position", "velocity"]

COMMAND_INTERFACES: tuple[CommandName, ...] = ("position", "velocity")

Floats = NDArray[np.float64]
"""Shape (joints,): rad, rad/s, Nm, or the fraction of maximum where the servo measures no torque."""


@dataclass(frozen=True, slots=True)
class States:
    """What the servos said: one row a joint; an invalid row keeps its last values and its age grows."""

    position: Floats
    velocity: Floats
    effort: Floats
    valid: NDArray[np.bool_]
    """True where this cycle's reply arrived intact."""
    age_ns: NDArray[np.int64]
    """Time since the reply that the row shows arrived; -1 while none ever did."""

    @classmethod
    def empty(cls, joints: int) -> States:
        """Return arrays of NaN, invalid, of no age."""
        return cls(
            position=np.full(joints, np.nan),
            velocity=np.full(joints, np.nan),
            effort=np.full(joints, np.nan),
            valid=np.zeros(joints, dtype=np.bool_),
            age_ns=np.full(joints, -1, dtype=np.int64),
        )


@dataclass(frozen=True, slots=True)
class Commands:
    """What somebody wants of the joints: one row a joint, NaN = not commanded."""

    position: Floats
    """rad"""
    velocity: Floats
    """rad/s, magnitude of the speed toward the position; NaN = as fast as the servo can"""

    @classmethod
    def empty(cls, joints: int) -> Commands:
        """Return arrays of NaN."""
        return cls(position=np.full(joints, np.nan), velocity=np.full(joints, np.nan))
