"""Devices on links: lets a simulated device, such as an IMU, measure the motion of a link of the robot's
URDF."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from dxlsim.device.device_quantities import STANDARD_GRAVITY, DeviceQuantities
from dxlsim.device.simulated_device import SimulatedDevice
from dxlsim.geometry.transform import rotated
from dxlsim.motion.body import SimulatedBody
from dxlsim.motion.link_motion import LinkMotion, Shafts
from dxlsim.motion.mechanics import Mechanics
from dxlsim.simulation_plan import UrdfBodies


def fix_to_links(devices: Iterable[SimulatedDevice], mechanics: Mechanics, sensed: UrdfBodies) -> None:
    """Connect each device that names a link to the motion of that link; every reading measures it.

    Raises:
        KeyError: The URDF does not have the link.
    """
    body, count = SimulatedBody(sensed), sensed.servos
    for device in devices:
        if device.link:
            body.motion(device.link)
            device.world.update = _feeling(device, body, lambda t_ns: mechanics.shafts(t_ns, count))


def _feeling(
    device: SimulatedDevice, body: SimulatedBody, shafts: Callable[[int], Shafts]
) -> Callable[[], None]:
    """Return a function that updates a device's measurements to its time, once for all items of a reading."""
    at_ns = -1

    def update() -> None:
        nonlocal at_ns
        if device.now_ns != at_ns:
            at_ns = device.now_ns
            body.set_shafts(shafts(at_ns))
            feel(device.world, body.motion(device.link))

    return update


def feel(world: DeviceQuantities, motion: LinkMotion) -> None:
    """Set a device's measurements to the motion of its link; a link at rest measures gravity upward."""
    x, y, z, w = motion.orientation.tolist()
    pull = np.array(rotated((-x, -y, -z, w), (0.0, 0.0, STANDARD_GRAVITY)))
    ax, ay, az = (motion.linear_acceleration + pull).tolist()
    gx, gy, gz = motion.angular_velocity.tolist()
    world.linear_acceleration, world.angular_velocity = (ax, ay, az), (gx, gy, gz)
    world.orientation = (x, y, z, w)
