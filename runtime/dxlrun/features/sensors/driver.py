"""Sensor driver: base class of sensors of plug-ins, and what dxlrun passes to them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, Generic, TypeVar

import msgspec

from dxlrun.channels.slot import Floats
from dxlrun.description.base_form import ParametersModel
from dxlsim.motion.link_motion import Body

P = TypeVar("P", bound=ParametersModel)


INERTIAL = ("angular_velocity", "linear_acceleration")
"""Quantities of an IMU; their noise is about one unit of resolution or more: 4 and 8 for an MPU-6050."""


UNITS: Mapping[str, str] = MappingProxyType(
    {
        "angular_velocity": "rad/s",
        "current": "A",
        "force": "N",
        "linear_acceleration": "m/s^2",
        "magnetic_field": "T",
        "temperature": "degC",
        "torque": "Nm",
        "voltage": "V",
    }
)
"""Unit of each quantity, the first word of a state's name, as in ROS 2 (sensor_msgs: Imu, MagneticField,
Temperature, BatteryState; geometry_msgs: Wrench)."""


class SensorContext(msgspec.Struct, frozen=True):
    """Argument of a sensor's `open`: its name and period, the clock, event output, simulated body."""

    name: str
    period_ns: int
    """Time between two samples, ns, from `rate` in the robot file."""
    now_ns: Callable[[], int]
    """Returns the time of the run in ns: CLOCK_MONOTONIC, or virtual time."""
    say: Callable[[str], None]
    """Writes a sentence into the log as an event. Of several within 0.1 s, only the last one is logged."""
    body: Body | None = None
    """Motion of the simulated robot at the time of a sample; None if the sensor has no `links`."""


class Sensor(ABC, Generic[P]):
    """Base class of sensors that are not on a servo bus.

    A sensor has its own process, so it cannot delay a cycle.

    Life cycle: `open` -> `read` ... -> `close`. An exception in `open` or `read` is reported as an event. The
    sensor is then closed, and opened again after a second. If the first `open` fails, the run does not start.

    Example:

        class Thermometer(Sensor[ParametersModel]):
            @classmethod
            def states(cls, parameters):
                return ("temperature",)

            def read(self, values):
                values[0] = 23.5  # degrees C
                return self.context.now_ns()
    """

    Parameters: ClassVar[type[ParametersModel]] = ParametersModel
    """Class that validates the sensor's keys in the robot file (except type, rate, timeout and on_lost)."""
    waits: ClassVar[bool] = False
    """True if `read` blocks until the device's next sample; False if dxlrun calls `read` at the sensor's
    rate."""
    simulated: ClassVar[bool] = False
    """True if it works on virtual time: `read` never blocks, and depends only on the clock, the parameters
    and the simulated body."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @classmethod
    @abstractmethod
    def states(cls, parameters: P) -> tuple[str, ...]:
        """Return the names of a sample's states, such as `angular_velocity.x`, in SI units."""

    @classmethod
    def units(cls, parameters: P) -> Mapping[str, str]:
        """Return the unit of each state that has one: `{"illuminance": "lx"}`.

        The default has the units of quantities in ROS 2 messages, such as rad/s for `angular_velocity.x`.
        """
        known = {state: UNITS.get(state.partition(".")[0], "") for state in cls.states(parameters)}
        return {state: unit for state, unit in known.items() if unit}

    @classmethod
    def links(cls, parameters: P) -> tuple[str, ...]:
        """Return the URDF links whose simulated motion the sensor measures; empty for a real sensor.

        A sensor with links is a simulated one, which requires simulated servos.
        """
        return ()

    @classmethod
    def noisy(cls, parameters: P) -> tuple[str, ...]:
        """Return the states that always change because of noise; if all stay equal, the sensor is stuck.

        The default has angular velocity and linear acceleration of an IMU that measures both.
        """
        noisy = [state for state in cls.states(parameters) if state.partition(".")[0] in INERTIAL]
        both = {state.partition(".")[0] for state in noisy} == {*INERTIAL}
        return tuple(noisy) if both else ()

    def open(self, context: SensorContext) -> None:
        """Open the device; an override stores `context` or calls this method."""
        self.context = context

    @abstractmethod
    def read(self, values: Floats) -> int | None:
        """Read a sample. A sample with values that are not finite is reported and ignored.

        Args:
            values: Receives the states, shape (states,); NaN before the call.

        Returns:
            Time of the measurement, ns of the run's clock; None without a sample.
        """

    def close(self) -> None:
        """Close the device; also called after `open` failed."""
