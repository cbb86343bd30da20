"""The simulated body as sensors see it: shafts on their way between processes, and how a link moves."""

from __future__ import annotations

from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LinkMotion(msgspec.Struct, frozen=True):
    """How a link of the robot's URDF is and moves.

    The world's z axis points up; the URDF's first link stands still in it, at its origin.
    """

    position: Floats
    """m, of the link's origin in the world, shape (3,)"""
    orientation: Floats
    """Unit quaternion x, y, z, w: turns what is given in the link's frame into the world's; w is not
    negative."""
    linear_velocity: Floats
    """m/s, of the link's origin in the world"""
    angular_velocity: Floats
    """rad/s, in the link's own frame, as a gyroscope on it measures"""
    linear_acceleration: Floats
    """m/s^2, of the link's origin in the link's own frame, without gravity"""


class Body(Protocol):
    """The simulated body at the time of a sample."""

    def motion(self, link: str) -> LinkMotion:
        """Return how a link of the URDF moves now. Raises KeyError for one that it does not have."""


class Shafts(msgspec.Struct, frozen=True):
    """The shafts of the simulated servos at a time, in the order of the simulation's servos."""

    t_ns: int
    angle: Floats
    """rad from the servo's raw 0"""
    velocity: Floats
    """rad/s"""
    acceleration: Floats
    """rad/s^2"""
