"""Sensor: the contract between dxlrun and the author of a sensor's driver."""

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
"""Quantities of an IMU. Their noise is about one unit of the last digit or more: of an MPU-6050 4 and 8."""


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
    """What a sensor gets when it is opened."""

    name: str
    period_ns: int
    """Between two samples, as the robot file has it by `rate`."""
    now_ns: Callable[[], int]
    """The run's clock: CLOCK_MONOTONIC, or virtual time."""
    say: Callable[[str], None]
    """Leave a sentence in the log (event SENSOR); for rare things: of several in 0.1 s the last is kept."""
    body: Body | None = None
    """The simulated body at the time of the sample; None: the sensor names no `links`."""


class Sensor(ABC, Generic[P]):
    """Something that measures beside the buses, in a process of its own: what it does delays no cycle.

    Life: `open` -> `read` ... -> `close`. Whatever `open` or `read` raise becomes an event; the sensor is
    closed, and opened again after a second. Only the first `open` of a run must not fail: the run does not
    start then. A whole one:

        class Thermometer(Sensor[ParametersModel]):
            @classmethod
            def states(cls, parameters):
                return ("temperature",)

            def read(self, values):
                values[0] = 23.5  # degrees C
                return self.context.now_ns()
    """

    Parameters: ClassVar[type[ParametersModel]] = ParametersModel
    """The model of the sensor's keys in the robot file (all but type, rate, timeout and on_lost)."""
    waits: ClassVar[bool] = False
    """`read` waits for the device's next sample; False: it is called at the sensor's rate."""
    simulated: ClassVar[bool] = False
    """It can be stepped on virtual time: `read` never waits, and depends on nothing but the clock, the
    parameters and the body."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @classmethod
    @abstractmethod
    def states(cls, parameters: P) -> tuple[str, ...]:
        """Return the names of its states, in the order of a sample: `angular_velocity.x`; SI units."""

    @classmethod
    def units(cls, parameters: P) -> Mapping[str, str]:
        """Return the units of states that have one, by state: `{"illuminance": "lx"}`.

        Unless overridden: those of the quantities in messages of ROS 2, such as rad/s of
        `angular_velocity.x`.
        """
        known = {state: UNITS.get(state.partition(".")[0], "") for state in cls.states(parameters)}
        return {state: unit for state, unit in known.items() if unit}

    @classmethod
    def links(cls, parameters: P) -> tuple[str, ...]:
        """Return the links of the robot's URDF whose motion it senses: it is then a simulated sensor, and
        needs simulated servos."""
        return ()

    @classmethod
    def noisy(cls, parameters: P) -> tuple[str, ...]:
        """Return the states whose noise is above their resolution: a sensor is stuck while all of them stay.

        Unless overridden: the angular velocity and the linear acceleration of an IMU that measures both.
        """
        noisy = [state for state in cls.states(parameters) if state.partition(".")[0] in INERTIAL]
        both = {state.partition(".")[0] for state in noisy} == {*INERTIAL}
        return tuple(noisy) if both else ()

    def open(self, context: SensorContext) -> None:
        """Open the device; keep `context`."""
        self.context = context

    @abstractmethod
    def read(self, values: Floats) -> int | None:
        """Fill `values`, shape (states,), all NaN before; return when they were true, ns of the run's clock.

        None: there is no sample. One with a value that is not finite is reported and not used.
        """

    def close(self) -> None:
        """Close the device, also one whose `open` failed half-way."""
