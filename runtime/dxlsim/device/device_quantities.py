"""Measurements of a simulated device: chooses the quantity that each item shows by the name of its state."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from random import Random

import msgspec

from dxlsim.geometry.transform import (
    NO_TURN,
    Quaternion,
    Transform,
    Vector,
    product,
    rotated,
    rotation_about,
)
from dxlsim.simulation_plan import DeviceReadings
from dxlwire.control_table.control_items import ControlItem

STANDARD_GRAVITY = 9.80665  # m/s^2 (3rd CGPM, 1901)
ROOM_CELSIUS = 25.0
_AXES = "xyzw"
_UNIT: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_VECTORS = {"angular_velocity": 3, "linear_acceleration": 3, "orientation": 4}
_TURNS = ("roll", "pitch", "yaw")


class DeviceQuantities(msgspec.Struct):
    """Physical quantities that one simulated device can measure, SI units."""

    volts: float
    angular_velocity: Vector = (0.0, 0.0, 0.0)  # rad/s, in the device's own axes
    linear_acceleration: Vector = (0.0, 0.0, STANDARD_GRAVITY)
    """Acceleration in the device's own axes, m/s^2. Gravity counts as upward, as in every accelerometer at
    rest."""
    orientation: Quaternion = NO_TURN  # Quaternion x, y, z, w of the device in the world
    celsius: float = ROOM_CELSIUS
    update: Callable[[], None] = lambda: None  # Updates the motion to the time of the device

    def tip(self, axis: str, angle: Callable[[], tuple[float, float]]) -> None:
        """Rotate the device from now on about an axis of its own, in addition to its other motion.

        Args:
            axis: x, y or z.
            angle: Returns the angle, rad, and its speed, rad/s.
        """
        update, about = self.update, _UNIT[axis]
        upright = self.angular_velocity, self.linear_acceleration, self.orientation

        def tipped() -> None:
            self.angular_velocity, self.linear_acceleration, self.orientation = upright
            update()
            turned, speed = angle()
            back = rotation_about(about, -turned)
            x, y, z = rotated(back, self.angular_velocity)
            self.angular_velocity = x + speed * about[0], y + speed * about[1], z + speed * about[2]
            self.linear_acceleration = rotated(back, self.linear_acceleration)
            self.orientation = product(self.orientation, rotation_about(about, turned))

        self.update = tipped

    @property
    def roll_pitch_yaw(self) -> Vector:
        """Orientation as angles about the fixed axes x, y, z, rad (ROS REP 103)."""
        return Transform(rotation=self.orientation).rpy


def make_readers(
    items: Mapping[str, ControlItem], config: DeviceReadings, world: DeviceQuantities, random: Random
) -> dict[str, Callable[[], int]]:
    """Return, by item name, functions that return the integer on the wire which a measuring item shows now.

    The configured value or state of an item comes first, then the name of its own state. A writable item
    without a configured state keeps its written value. An unknown quantity is 0."""
    live: dict[str, Callable[[], int]] = {}
    for name, item in items.items():
        value = _value(config.states.get(name, item.state), world)
        if (fixed := config.values.get(name)) is not None:
            value = _constant(fixed)
        elif item.access == "RW" and name not in config.states:
            continue
        elif value is None and item.unit and item.access == "R" and item.initial is None:
            value = _constant(0.0)
        noise = config.noise.get(name, 0.0)
        if value is not None or noise:
            live[name] = _reading(item, value or _constant(0.0), noise, random)
    return live


def _constant(value: float) -> Callable[[], float]:
    return lambda: value


def _value(state: str, world: DeviceQuantities) -> Callable[[], float] | None:
    """Return a function that returns the quantity of a state name, or None if the simulation does not
    model it."""
    what, _, axis = state.partition(".")
    index = _AXES.find(axis) if axis else -1
    if 0 <= index < _VECTORS.get(what, 0):
        return _moving(world, lambda: getattr(world, what)[index])
    if state in _TURNS:
        return _moving(world, lambda: world.roll_pitch_yaw[_TURNS.index(state)])
    if what == "voltage":
        return lambda: world.volts
    return (lambda: world.celsius) if state == "temperature" else None


def _moving(world: DeviceQuantities, show: Callable[[], float]) -> Callable[[], float]:
    def value() -> float:
        world.update()
        return show()

    return value


def _reading(
    item: ControlItem, value: Callable[[], float], noise: float, random: Random
) -> Callable[[], int]:
    def read_value() -> int:
        measured = value()
        if noise:
            measured += random.gauss(0.0, noise)
        return on_the_wire(item, measured)

    return read_value


def on_the_wire(item: ControlItem, value: float) -> int:
    """Return the integer on the wire for a value in SI units, clamped to the item's range."""
    if item.bit is not None:
        return int(value != 0)
    number = (value - item.offset) / item.scale
    if item.encoding == "float32":
        return int.from_bytes(struct.pack("<f", number), "little")
    if math.isnan(number):
        return 0
    return round(max(item.minimum, min(number, item.maximum)))
