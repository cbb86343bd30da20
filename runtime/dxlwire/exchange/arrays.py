"""Arrays of the caller, which the exchange fills with states and reads without a copy, as protocols."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class JointArrays(Protocol):
    """States of all joints, which the exchange fills from replies; each array is contiguous and has one
    element per joint.

    A joint without a plausible reply in this cycle keeps its last values, is marked invalid, and its age
    grows."""

    @property
    def position(self) -> Floats:
        """Position of each joint: rad, or m where the joint is linear."""
        ...

    @property
    def velocity(self) -> Floats:
        """Velocity of each joint: rad/s or m/s; in wheel mode of some models the fraction of full output."""
        ...

    @property
    def effort(self) -> Floats:
        """Effort of each joint: Nm, A, or the fraction of the maximum, depending on the quantity that the
        servo measures."""
        ...

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True for each joint whose reply of this cycle arrived intact and was plausible."""
        ...

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """Age of the reply that each joint's values come from, ns; -1 before the first reply."""
        ...

    @property
    def mode(self) -> NDArray[np.uint8]:
        """`Mode` of each joint, by which raw velocities are converted; written by the caller, only read
        here."""
        ...


class SourceArrays(Protocol):
    """States of all devices, which the exchange fills from replies; the plans of the devices have the
    indices."""

    @property
    def values(self) -> Floats:
        """Value of each device state, SI units; NaN before the first reply."""
        ...

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True for each device whose states all arrived in this cycle."""
        ...

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """Age of each device's states, ns; -1 before the first reply."""
        ...
