"""Sensor: base class of sensor drivers and the types of its interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, Generic, TypeVar

import msgspec

from dxlrun.channels.slot import Floats
from dxlrun.description.form import ParametersModel
from dxlsim.motion.link_motion import Body

P = TypeVar("P", bound=ParametersModel)


INERTIAL = ("angular_velocity", "linear_acceleration")
"""Quantities of an IMU. Their noise is at least about one unit of resolution: 4 and 8 for an MPU-6050."""


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
"""Units of quantities in messages of ROS 2 (sensor_msgs: Imu, MagneticField, Temperature, BatteryState;
geometry_msgs: Wrench)."""


class SensorContext(msgspec.Struct, frozen=True):
    """Data and functions that a sensor gets in `open`."""

    name: str
    period_ns: int
    """Time between two samples, from `rate` in the robot file."""
    now_ns: Callable[[], int]
    """Clock of the run: CLOCK_MONOTONIC, or virtual time."""
    say: Callable[[str], None]
    """Log a sentence as an event (SENSOR). Of several sentences within 0.1 s, only the last one is logged."""
    body: Body | None = None
    """Simulated body at the time of the sample; None: the sensor has no `links`."""


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
    """Model of the sensor's keys in the robot file (except type, rate, timeout and on_lost)."""
    waits: ClassVar[bool] = False
    """True if `read` waits for the device's next sample; False: `read` is called at the sensor's rate."""
    simulated: ClassVar[bool] = False
    """True if it works on virtual time: `read` never waits, and depends only on the clock, the parameters and
    the body."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @classmethod
    @abstractmethod
    def states(cls, parameters: P) -> tuple[str, ...]:
        """Return the names of its states in the order of a sample: `angular_velocity.x`. Units are SI."""

    @classmethod
    def units(cls, parameters: P) -> Mapping[str, str]:
        """Return the units of states, by state: `{"illuminance": "lx"}`.

        The default has the units of quantities in ROS 2 messages, such as rad/s for `angular_velocity.x`.
        """
        known = {state: UNITS.get(state.partition(".")[0], "") for state in cls.states(parameters)}
        return {state: unit for state, unit in known.items() if unit}

    @classmethod
    def links(cls, parameters: P) -> tuple[str, ...]:
        """Return the links of the robot's URDF whose motion it senses.

        A sensor with links is a simulated one, which requires simulated servos.
        """
        return ()

    @classmethod
    def noisy(cls, parameters: P) -> tuple[str, ...]:
        """Return the states whose noise exceeds their resolution.

        A sensor counts as stuck if all of them stay constant. The default has angular velocity and linear
        acceleration of an IMU that measures both.
        """
        noisy = [state for state in cls.states(parameters) if state.partition(".")[0] in INERTIAL]
        both = {state.partition(".")[0] for state in noisy} == {*INERTIAL}
        return tuple(noisy) if both else ()

    def open(self, context: SensorContext) -> None:
        """Open the device, and store `context`."""
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
        """Close the device, also after an incomplete `open`."""
