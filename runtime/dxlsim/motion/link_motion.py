"""Link motion: types by which sensors learn the motion of simulated shafts and of a robot's links."""

from __future__ import annotations

from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LinkMotion(msgspec.Struct, frozen=True):
    """Pose, velocity and acceleration of a link of the robot's URDF.

    The world's z axis points up; the URDF's first link is fixed at its origin."""

    position: Floats
    """Position of the link's origin in the world, m, shape (3,)."""
    orientation: Floats
    """Unit quaternion x, y, z, w that rotates from the link's frame into the world's; w is not negative."""
    linear_velocity: Floats
    """Velocity of the link's origin in the world, m/s, shape (3,)."""
    angular_velocity: Floats
    """Angular velocity in the link's own frame, rad/s, as a gyroscope on the link measures."""
    linear_acceleration: Floats
    """Acceleration of the link's origin in the link's own frame, m/s^2, without gravity."""


class Body(Protocol):
    """Simulated body of a robot, which a sensor asks for the motion of a link."""

    def motion(self, link: str) -> LinkMotion:
        """Return the present motion of a link. Raises KeyError if the URDF does not have the link."""


class Shafts(msgspec.Struct, frozen=True):
    """Motion of all shafts of the simulated servos at a time, in the order of the simulation's servos."""

    t_ns: int
    angle: Floats
    """Angle of each shaft from the servo's raw 0, rad."""
    velocity: Floats
    """Velocity of each shaft, rad/s."""
    acceleration: Floats
    """Acceleration of each shaft, rad/s^2."""
