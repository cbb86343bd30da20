"""Simulated body for sensors: messages about shafts between processes, and the motion of a link."""

from __future__ import annotations

from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LinkMotion(msgspec.Struct, frozen=True):
    """Pose and motion of a link of the robot's URDF.

    The world's z axis points up; the URDF's first link is fixed at its origin.
    """

    position: Floats
    """m, of the link's origin in the world, shape (3,)."""
    orientation: Floats
    """Unit quaternion x, y, z, w: rotates from the link's frame into the world's; w is not negative."""
    linear_velocity: Floats
    """m/s, of the link's origin in the world."""
    angular_velocity: Floats
    """rad/s, in the link's own frame, as a gyroscope on it measures."""
    linear_acceleration: Floats
    """m/s^2, of the link's origin in the link's own frame, without gravity."""


class Body(Protocol):
    """Simulated body at the time of a sample."""

    def motion(self, link: str) -> LinkMotion:
        """Return the current motion of a link. Raises KeyError if the URDF does not have the link."""


class Shafts(msgspec.Struct, frozen=True):
    """Shafts of the simulated servos at a time, in the order of the simulation's servos."""

    t_ns: int
    angle: Floats
    """rad from the servo's raw 0."""
    velocity: Floats
    """rad/s."""
    acceleration: Floats
    """rad/s^2."""
