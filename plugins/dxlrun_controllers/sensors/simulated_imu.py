"""simulated_imu: simulated inertial measurement unit on a link of the simulated robot."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from dxlrun import AngularVelocity, Body, Floats, LinearAcceleration, ParametersModel, Sensor, SensorContext

GRAVITY = np.array((0.0, 0.0, -9.81))
"""Gravity in the world frame, m/s^2; the default of MuJoCo."""
_AXES = ("x", "y", "z")

Density = Annotated[float, Field(ge=0)]


class Gyroscope(ParametersModel):
    """Gyroscope model: noise, bias and drift of the bias."""

    noise_density: Density = Field(
        default=0.0, description="Density of the white noise, rad/s/sqrt(Hz).", examples=["1e-4"]
    )
    bias: tuple[AngularVelocity, AngularVelocity, AngularVelocity] = Field(
        default=(0.0, 0.0, 0.0),
        description="Measured angular velocity at rest, rad/s.",
        examples=["[0.2 deg/s, 0 deg/s, 0 deg/s]"],
    )
    random_walk: Density = Field(
        default=0.0, description="Random walk of the bias, rad/s^2/sqrt(Hz).", examples=["1e-5"]
    )


class Accelerometer(ParametersModel):
    """Accelerometer model: noise, bias and drift of the bias."""

    noise_density: Density = Field(
        default=0.0, description="Density of the white noise, m/s^2/sqrt(Hz).", examples=["2e-3"]
    )
    bias: tuple[LinearAcceleration, LinearAcceleration, LinearAcceleration] = Field(
        default=(0.0, 0.0, 0.0),
        description="Measured acceleration at rest in addition to gravity, m/s^2.",
        examples=["[0.05 m/s^2, 0 m/s^2, 0 m/s^2]"],
    )
    random_walk: Density = Field(
        default=0.0, description="Random walk of the bias, m/s^3/sqrt(Hz).", examples=["1e-4"]
    )


class Magnetometer(ParametersModel):
    """Magnetometer model: ambient field, noise and bias."""

    field: tuple[float, float, float] = Field(
        default=(0.0, 2.0e-5, -4.4e-5),
        description="Magnetic field of the Earth in the world frame (x east, y north, z up), T.",
        examples=["[0.0, 2.0e-5, -4.4e-5]"],
    )
    noise_density: Density = Field(
        default=0.0, description="Density of the white noise, T/sqrt(Hz).", examples=["1e-7"]
    )
    bias: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0),
        description="Magnetic field of magnets on the link, in its axes, T.",
        examples=["[1e-6, 0.0, 0.0]"],
    )


class SimulatedImuParameters(ParametersModel):
    """Link of the unit, and models of its sensors"""

    link: str = Field(
        min_length=1,
        examples=["torso_link"],
        description="Link of the URDF that carries the unit. Its frame is the frame of the measurements.",
    )
    gyroscope: Gyroscope = Gyroscope()
    accelerometer: Accelerometer = Accelerometer()
    magnetometer: Magnetometer | None = Field(
        default=None,
        description="Magnetometer. Without this key, there is none.",
        examples=["{noise_density: 1e-7}"],
    )
    seed: int = Field(
        default=0, ge=0, description="Seed of the noise. The same seed results in the same noise."
    )


class _Noise:
    """White noise and random walk of the bias of a sensor with three axes.

    The discrete standard deviations are those of Kalibr's IMU model: density * sqrt(rate) for the noise, and
    walk / sqrt(rate) for the step of the bias per sample.
    """

    def __init__(self, density: float, bias: tuple[float, ...], walk: float, rate: float) -> None:
        self._white = density * math.sqrt(rate)
        self._bias = np.array(bias)
        self._walk = walk / math.sqrt(rate)

    def draw_errors(self, generator: np.random.Generator) -> Floats:
        """Return the errors of the next sample on the three axes, and move the bias by a random step."""
        draws = generator.standard_normal((2, 3))
        self._bias = self._bias + self._walk * draws[0]
        errors: Floats = self._bias + self._white * draws[1]
        return errors


class SimulatedImu(Sensor[SimulatedImuParameters]):
    """Simulated unit that measures angular velocity, specific force and magnetic field in the frame of its
    link.

    At rest the accelerometer measures +9.81 m/s^2 upwards (sensor_msgs/Imu; REP 145).
    """

    Parameters = SimulatedImuParameters
    simulated = True
    _body: Body

    @classmethod
    def states(cls, parameters: SimulatedImuParameters) -> tuple[str, ...]:
        """Return the states: those of ros2_control's IMU sensors, and with a magnetometer the magnetic
        field.
        """
        groups = ["angular_velocity", "linear_acceleration"]
        groups += ["magnetic_field"] if parameters.magnetometer is not None else []
        return tuple(f"{group}.{axis}" for group in groups for axis in _AXES)

    @classmethod
    def noisy(cls, parameters: SimulatedImuParameters) -> tuple[str, ...]:
        """Return the states with noise; the others are constant while the link is at rest."""
        gyroscope, accelerometer = parameters.gyroscope, parameters.accelerometer
        groups = ["angular_velocity"] if gyroscope.noise_density or gyroscope.random_walk else []
        groups += ["linear_acceleration"] if accelerometer.noise_density or accelerometer.random_walk else []
        return tuple(f"{group}.{axis}" for group in groups for axis in _AXES)

    @classmethod
    def links(cls, parameters: SimulatedImuParameters) -> tuple[str, ...]:
        """Return the link that carries the unit, whose motion the simulation provides."""
        return (parameters.link,)

    def open(self, context: SensorContext) -> None:
        """Restart the noise from its seed. Raises RuntimeError without a simulated body."""
        super().open(context)
        if context.body is None:
            raise RuntimeError(f"link {self.parameters.link} has no simulated body")
        self._body = context.body
        own, rate = self.parameters, 1e9 / context.period_ns
        self._generator = np.random.default_rng(own.seed)
        self._rate_noise = _Noise(
            own.gyroscope.noise_density, own.gyroscope.bias, own.gyroscope.random_walk, rate
        )
        force = own.accelerometer
        self._force_noise = _Noise(force.noise_density, force.bias, force.random_walk, rate)
        magnet = own.magnetometer
        self._magnet_noise = None if magnet is None else _Noise(magnet.noise_density, magnet.bias, 0.0, rate)

    def read(self, values: Floats) -> int:
        """Write the measurements of the link's present motion, with noise, into `values`; return their
        time, ns.
        """
        t_ns = self.context.now_ns()
        motion = self._body.motion(self.parameters.link)
        generator = self._generator
        values[0:3] = motion.angular_velocity + self._rate_noise.draw_errors(generator)
        pull = turned_back(motion.orientation, GRAVITY)
        values[3:6] = motion.linear_acceleration - pull + self._force_noise.draw_errors(generator)
        if self._magnet_noise is not None and self.parameters.magnetometer is not None:
            field = turned_back(motion.orientation, np.array(self.parameters.magnetometer.field))
            values[6:9] = field + self._magnet_noise.draw_errors(generator)
        return t_ns


def turned_back(orientation: Floats, vector: Floats) -> Floats:
    """Return a vector of the world frame in the frame of a body whose orientation is the quaternion x, y,
    z, w.
    """
    axis, w = -orientation[:3], orientation.item(3)
    twice = 2.0 * np.cross(axis, vector)
    turned: Floats = vector + w * twice + np.cross(axis, twice)
    return turned
