"""imu_sensor_broadcaster: the orientation of an inertial measurement unit as states and as sensor_msgs/Imu.

The filter is own code (`laws/madgwick.py`) and not the package imufusion: that one has Madgwick's revised
algorithm in single precision, which is another filter than the published one. It would be one more compiled
dependency for some 80 lines without a loop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from dxlrun import (
    LIVE,
    Angle,
    AngularVelocity,
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Mistake,
    ParametersModel,
)
from dxlrun.messages import Header, Imu
from dxlrun_controllers.laws.madgwick import Madgwick, Vector
from dxlrun_controllers.sensing.samples import SampleTimes

AXES = ("x", "y", "z")
ORIENTATION = tuple(f"orientation.{axis}" for axis in (*AXES, "w"))
RATE = tuple(f"angular_velocity.{axis}" for axis in AXES)
ACCELERATION = tuple(f"linear_acceleration.{axis}" for axis in AXES)
_ZERO = (0.0, 0.0, 0.0)
_BIAS_TIME_CONSTANT = 2.0
"""s, of the low-pass that follows the rate of a body at rest."""
_BIAS_AFTER = 2.0
"""s; a body is at rest when it turned so slowly for so long."""

Diagonal = Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=3, max_length=3)]
"""Variances about x, y and z."""


class ImuCovariance(ParametersModel):
    """Variances as the data sheet has them; left out: not known, which ROS writes as zeros."""

    orientation: Diagonal | None = None
    """rad^2"""
    angular_velocity: Diagonal | None = None
    """(rad/s)^2"""
    linear_acceleration: Diagonal | None = None
    """(m/s^2)^2"""


class ImuParameters(ParametersModel):
    """Keys of an imu_sensor_broadcaster in the robot file."""

    sensor: str
    """Name of the sensor or device: it has angular_velocity and linear_acceleration."""
    orientation: Literal["madgwick", "sensor", "none"] = "madgwick"
    """By the filter; the sensor's own one is passed on; or none is provided."""
    gain: Annotated[float, Field(ge=0, le=10), LIVE] = 0.1
    """beta, rad/s"""
    magnetometer: str | None = None
    """Name of the sensor or device with magnetic_field in the same axes; without it the heading drifts."""
    declination: Annotated[Angle, Field(ge=-math.pi, le=math.pi)] = 0.0
    """rad; of magnetic north from true north, positive to the east."""
    mounting: Annotated[tuple[Angle, ...], Field(min_length=3, max_length=3)] = (0.0, 0.0, 0.0)
    """rad; roll, pitch and yaw of the sensor in its link, as in a URDF's `rpy`."""
    rest: Annotated[AngularVelocity, Field(gt=0)] | None = None
    """rad/s; slower than this for 2 s counts as standing still: what the gyroscope then measures is its bias.
    Left out: the bias is not corrected."""
    timeout: Annotated[Duration, Field(gt=0)] = 500_000_000
    """ns; after so long without a sample the filter begins anew."""
    frame: str = "imu_link"
    """Link of the URDF in whose axes the measurements are."""
    covariance: ImuCovariance = ImuCovariance()

    def mistakes(self) -> Iterator[Mistake]:
        """Yield keys that count only beside another one."""
        yield from super().mistakes()
        if self.orientation != "madgwick" and (self.magnetometer is not None or self.rest is not None):
            key = "rest" if self.magnetometer is None else "magnetometer"
            yield (key,), "magnetometer and rest are for orientation: madgwick; write that, or take them out"
        if self.declination and self.magnetometer is None:
            what = "declination is the angle from the magnetometer's north"
            yield ("declination",), f"{what}; name a magnetometer, or take it out"


class ImuSensorBroadcaster(Controller[ImuParameters]):
    """Provides orientation, angular velocity and linear acceleration of the link, and publishes them.

    The orientation is that of the link in a frame whose z axis points upwards. With a magnetometer its x axis
    points to the east (REP 103 and 145); without it the heading is 0 where the filter began.

    - Each sample is taken once, by the true time since the one before, which its age tells. So a lost sample
      makes a longer step. Without a new sample nothing is provided or published: the states keep their values
      and become older.
    - A sample with NaN or infinity counts as lost; one of the magnetometer leaves that step to the others.
    - After `timeout` without a sample the filter begins anew: roll and pitch from the accelerometer, heading
      as before or from the magnetometer. It is so too when the controller is activated.
    """

    Parameters = ImuParameters
    Topics: ClassVar = {"imu": Imu}

    @classmethod
    def interfaces(cls, parameters: ImuParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the sensor's states, and perhaps the magnetometer's."""
        names = (*RATE, *ACCELERATION, *(ORIENTATION if parameters.orientation == "sensor" else ()), "age")
        reads = [f"{parameters.sensor}/{name}" for name in names]
        if parameters.magnetometer is not None:
            fields = (*(f"magnetic_field.{axis}" for axis in AXES), "age")
            reads += [f"{parameters.magnetometer}/{name}" for name in fields]
        provided = () if parameters.orientation == "none" else ORIENTATION
        return Interfaces((), reads=tuple(reads), provides=(*provided, *RATE, *ACCELERATION))

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
        super().on_configure(context)
        parameters = self.parameters
        self._filter = Madgwick(parameters.gain)
        self._times = SampleTimes(context.period_ns)
        self._axes = _matrix(*parameters.mounting) if any(parameters.mounting) else None
        self._mounting = _quaternion(*parameters.mounting)
        # of the filter's frame, whose x axis is magnetic north, in one whose x axis is the true east
        north = 0.0 if parameters.magnetometer is None else math.pi / 2 - parameters.declination
        self._east = (0.0, 0.0, math.sin(north / 2), math.cos(north / 2))
        self._bias = _ZERO
        self._resting_s = 0.0
        self._message = Imu(header=Header(frame_id=parameters.frame))
        covariance, message = parameters.covariance, self._message
        _fill(message.orientation_covariance, covariance.orientation)
        _fill(message.angular_velocity_covariance, covariance.angular_velocity)
        _fill(message.linear_acceleration_covariance, covariance.linear_acceleration)
        if parameters.orientation == "none":
            message.orientation_covariance[0] = -1.0

    def on_activate(self, time_ns: int) -> None:
        """Begin anew: what happened meanwhile is not known."""
        self._times.forget()
        self._silent = self._wrong = False

    def on_parameters(self, time_ns: int) -> None:
        """Take over a changed gain."""
        self._filter.gain = self.parameters.gain

    def update(self, time_ns: int, period_ns: int) -> None:
        """Take a new sample, if there is one."""
        provided = self.context.provided
        provided.fill(np.nan)  # nothing new
        values = self.context.reads.tolist()
        own = 10 if self.parameters.orientation == "sensor" else 6
        # one that is left out takes no time: the next step is from the good one before
        if not self._is_finite(values, own) or not self._times.take(time_ns, values[own]):
            self._look_for_silence(time_ns)
            return
        self._silent = self._wrong = False
        rate, acceleration = self._turned(values[0:3]), self._turned(values[3:6])
        place = 0
        if self.parameters.orientation != "none":
            orientation = self._orientation(rate, acceleration, values)
            provided[0], provided[1], provided[2], provided[3] = orientation
            to = self._message.orientation
            to.x, to.y, to.z, to.w = orientation
            place = 4
        provided[place : place + 3] = rate
        provided[place + 3 :] = acceleration
        turn, force = self._message.angular_velocity, self._message.linear_acceleration
        turn.x, turn.y, turn.z = rate
        force.x, force.y, force.z = acceleration
        self.context.publish("imu", self._message)

    # Inside

    def _turned(self, values: list[float]) -> Vector:
        x, y, z = values
        if self._axes is None:
            return x, y, z
        (a, b, c), (d, e, f), (g, h, i) = self._axes
        return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z

    def _orientation(self, rate: Vector, acceleration: Vector, values: list[float]) -> tuple[float, ...]:
        """Return x, y, z, w of the link."""
        if self.parameters.orientation == "sensor":
            x, y, z, w = self._mounting
            return _product((values[6], values[7], values[8], values[9]), (-x, -y, -z, w))
        law, elapsed_s = self._filter, self._times.elapsed_s
        field = self._field(values)
        if elapsed_s * 1e9 <= self.parameters.timeout:  # not for the first one, where it is NaN
            law.update(self._unbiased(rate, elapsed_s), acceleration, field, elapsed_s)
        else:
            law.begin(acceleration, field, law.heading)
            self._resting_s = 0.0
        return _product(self._east, (law.x, law.y, law.z, law.w))

    def _field(self, values: list[float]) -> Vector | None:
        """Return the magnetic field, if it is there and no older than the timeout."""
        if self.parameters.magnetometer is None:
            return None
        x, y, z, age_s = values[7:11]
        if not (math.isfinite(x + y + z) and age_s * 1e9 <= self.parameters.timeout):
            return None
        return self._turned([x, y, z])

    def _unbiased(self, rate: Vector, dt: float) -> Vector:
        """Return the rate without the gyroscope's bias, and learn that while the body rests."""
        rest = self.parameters.rest
        if rest is None:
            return rate
        self._resting_s = self._resting_s + dt if math.hypot(*rate) < rest else 0.0
        x, y, z = self._bias
        if self._resting_s > _BIAS_AFTER:
            share = -math.expm1(-dt / _BIAS_TIME_CONSTANT)
            x, y, z = x + share * (rate[0] - x), y + share * (rate[1] - y), z + share * (rate[2] - z)
            self._bias = x, y, z
        return rate[0] - x, rate[1] - y, rate[2] - z

    def _look_for_silence(self, time_ns: int) -> None:
        """Report, once, that samples stay out."""
        timeout = self.parameters.timeout
        if not self._silent and self._times.age_s(time_ns) * 1e9 > timeout:
            self._silent = True
            self.context.say(
                f"no new sample of {self.parameters.sensor} for {timeout * 1e-9:g} s: "
                "the states stay as they were and become older"
            )

    def _is_finite(self, values: list[float], own: int) -> bool:
        """Return whether a sample has numbers only; report, once, that it has not."""
        if all(map(math.isfinite, values[:own])):
            return True
        if not (self._wrong or math.isnan(values[own])):  # without an age there was never one
            self._wrong = True
            self.context.say(f"{self.parameters.sensor} measured NaN or infinity: such samples are left out")
        return False


Quaternion = tuple[float, float, float, float]
"""x, y, z, w"""


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    about_x = (math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2))
    about_y = (0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2))
    about_z = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return _product(about_z, _product(about_y, about_x))


def _matrix(roll: float, pitch: float, yaw: float) -> tuple[Vector, Vector, Vector]:
    x, y, z, w = _quaternion(roll, pitch, yaw)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _fill(matrix: Floats, variances: tuple[float, ...] | None) -> None:
    """Write variances into the diagonal of a covariance, shape (9,)."""
    if variances is not None:
        matrix[[0, 4, 8]] = variances
