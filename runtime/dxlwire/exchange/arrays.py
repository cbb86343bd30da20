"""Protocols of the caller's arrays, which the exchange fills and reads without a copy."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class JointArrays(Protocol):
    """States of all joints, filled from replies; each array is contiguous and has one element per joint.

    A joint without a plausible reply in this cycle keeps its last values, is marked invalid, and its age
    grows.
    """

    @property
    def position(self) -> Floats:
        """rad, or m where the joint is linear."""
        ...

    @property
    def velocity(self) -> Floats:
        """rad/s or m/s; in wheel mode of some models the fraction of full output."""
        ...

    @property
    def effort(self) -> Floats:
        """Nm, A, or the fraction of the maximum, depending on the quantity that the servo measures."""
        ...

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where this cycle's reply arrived intact."""
        ...

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """Age of the reply that the values come from; -1 before the first reply."""
        ...

    @property
    def mode(self) -> NDArray[np.uint8]:
        """A `Mode` by which raw velocities are converted; read here, written by the caller."""
        ...


class SourceArrays(Protocol):
    """States of devices, filled from replies; the plans of the devices have the indices."""

    @property
    def values(self) -> Floats:
        """One element per state, SI units; NaN before the first reply."""
        ...

    @property
    def valid(self) -> NDArray[np.bool_]:
        """One element per source: True where all of its states arrived in this cycle."""
        ...

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """One element per source: age of its states; -1 before the first reply."""
        ...
