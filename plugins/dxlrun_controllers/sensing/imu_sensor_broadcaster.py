"""imu_sensor_broadcaster: orientation of an inertial measurement unit as states and as sensor_msgs/Imu.

The filter is implemented in `laws/madgwick.py` instead of using the package imufusion. imufusion has
Madgwick's revised algorithm in single precision, which differs from the published filter, and it would be a
compiled dependency in place of some 80 lines without a loop.
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
from dxlrun.tooling.topics import messages
from dxlrun_controllers.laws.madgwick import Madgwick, Vector
from dxlrun_controllers.sensing.sample_times import SampleTimes

AXES = ("x", "y", "z")
ORIENTATION = tuple(f"orientation.{axis}" for axis in (*AXES, "w"))
RATE = tuple(f"angular_velocity.{axis}" for axis in AXES)
ACCELERATION = tuple(f"linear_acceleration.{axis}" for axis in AXES)
_ZERO = (0.0, 0.0, 0.0)
_BIAS_TIME_CONSTANT = 2.0
"""Time constant of the low-pass filter that estimates the gyroscope bias at rest, s."""
_BIAS_AFTER = 2.0
"""Time of slow rotation after which a body counts as at rest, s."""

Diagonal = Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=3, max_length=3)]
"""Variances about x, y and z."""


class ImuCovariance(ParametersModel):
    """Variances from the data sheet. Unknown ones are omitted, and published as zeros, as ROS defines."""

    orientation: Diagonal | None = None
    """Variances of the orientation about x, y and z, rad^2."""
    angular_velocity: Diagonal | None = None
    """Variances of the angular velocity about x, y and z, (rad/s)^2."""
    linear_acceleration: Diagonal | None = None
    """Variances of the linear acceleration along x, y and z, (m/s^2)^2."""


class ImuBroadcasterParameters(ParametersModel):
    """Keys of an imu_sensor_broadcaster in the robot file."""

    sensor: str = Field(examples=["imu"])
    """Name of the sensor or device that provides angular_velocity and linear_acceleration."""
    orientation: Literal["madgwick", "sensor", "none"] = "madgwick"
    """Source of the orientation: the Madgwick filter, the sensor itself, or none."""
    gain: Annotated[float, Field(ge=0, le=10), LIVE] = 0.1
    """Gain beta of the filter, rad/s."""
    magnetometer: str | None = None
    """Name of the sensor or device with magnetic_field in the same axes. Without it the heading drifts."""
    declination: Annotated[Angle, Field(ge=-math.pi, le=math.pi)] = 0.0
    """Angle from true north to magnetic north, rad, positive to the east."""
    mounting: Annotated[tuple[Angle, ...], Field(min_length=3, max_length=3)] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the sensor in its link, rad, as `rpy` in a URDF."""
    rest: Annotated[AngularVelocity, Field(gt=0)] | None = None
    """Rate below which the body counts as at rest after 2 s, rad/s. The gyroscope bias is then estimated.
    Without this key the bias is not corrected."""
    timeout: Annotated[Duration, Field(gt=0)] = 500_000_000
    """Time without a sample after which the filter restarts."""
    frame: str = "imu_link"
    """Link of the URDF in whose axes the measurements are expressed."""
    covariance: ImuCovariance = ImuCovariance()

    def mistakes(self) -> Iterator[Mistake]:
        """Yield keys that have no effect without another key."""
        yield from super().mistakes()
        if self.orientation != "madgwick" and (self.magnetometer is not None or self.rest is not None):
            key = "rest" if self.magnetometer is None else "magnetometer"
            yield (
                (key,),
                "magnetometer and rest need orientation: madgwick; write that value, or remove the keys",
            )
        if self.declination and self.magnetometer is None:
            what = "declination needs a magnetometer"
            yield ("declination",), f"{what}; name a magnetometer, or remove declination"


class ImuSensorBroadcaster(Controller[ImuBroadcasterParameters]):
    """Controller that provides and publishes orientation, angular velocity and linear acceleration of a link.

    The orientation is that of the link in a frame whose z axis points up. With a magnetometer, the x axis of
    this frame points east (REP 103 and 145). Without one, the heading is 0 where the filter started.

    - Each sample is used once, with the time since the last sample, which is computed from their ages. After
      a lost sample the step is longer. Without a new sample nothing is provided or published: the states keep
      their values, and their ages grow.
    - A sample with NaN or infinity counts as lost. If only the magnetic field is not finite, the step uses
      the gyroscope and the accelerometer alone.
    - The filter restarts on activation and after `timeout` without a sample: roll and pitch come from the
      accelerometer, and the heading from the magnetometer. Without a magnetometer the heading is kept.
    """

    Parameters = ImuBroadcasterParameters
    Topics: ClassVar = {"imu": messages.Imu}

    @classmethod
    def interfaces(cls, parameters: ImuBroadcasterParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the states of the sensor and, with a magnetometer, its field; provide the states of the
        link.
        """
        names = (*RATE, *ACCELERATION, *(ORIENTATION if parameters.orientation == "sensor" else ()), "age")
        reads = [f"{parameters.sensor}/{name}" for name in names]
        if parameters.magnetometer is not None:
            fields = (*(f"magnetic_field.{axis}" for axis in AXES), "age")
            reads += [f"{parameters.magnetometer}/{name}" for name in fields]
        provided = () if parameters.orientation == "none" else ORIENTATION
        return Interfaces((), reads=tuple(reads), provides=(*provided, *RATE, *ACCELERATION))

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        parameters = self.parameters
        self._filter = Madgwick(parameters.gain)
        self._times = SampleTimes(context.period_ns)
        self._axes = _matrix(*parameters.mounting) if any(parameters.mounting) else None
        self._mounting = _quaternion(*parameters.mounting)
        # Rotation from the filter's frame, whose x axis is magnetic north, to a frame with x to true east.
        north = 0.0 if parameters.magnetometer is None else math.pi / 2 - parameters.declination
        self._east = (0.0, 0.0, math.sin(north / 2), math.cos(north / 2))
        self._bias = _ZERO
        self._resting_s = 0.0
        self._message = messages.Imu(header=messages.Header(frame_id=parameters.frame))
        covariance, message = parameters.covariance, self._message
        _fill(message.orientation_covariance, covariance.orientation)
        _fill(message.angular_velocity_covariance, covariance.angular_velocity)
        _fill(message.linear_acceleration_covariance, covariance.linear_acceleration)
        if parameters.orientation == "none":
            message.orientation_covariance[0] = -1.0

    def on_activate(self, time_ns: int) -> None:
        """Restart the filter, because the motion since the last activation is unknown."""
        self._times.discard_sample()
        self._silent = self._wrong = False

    def on_parameters(self, time_ns: int) -> None:
        """Set the gain of the filter, which may have changed in the run."""
        self._filter.gain = self.parameters.gain

    def update(self, time_ns: int, period_ns: int) -> None:
        """Filter, provide and publish a new sample, if there is one."""
        provided = self.context.provided
        provided.fill(np.nan)  # NaN: no new value
        values = self.context.reads.tolist()
        own = 10 if self.parameters.orientation == "sensor" else 6
        # A discarded sample does not advance the time, so the next step starts at the last valid sample.
        if not self._is_finite(values, own) or not self._times.accept_sample(time_ns, values[own]):
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
        """Return the orientation of the link as quaternion x, y, z, w, from the filter or from the sensor."""
        if self.parameters.orientation == "sensor":
            x, y, z, w = self._mounting
            return _product((values[6], values[7], values[8], values[9]), (-x, -y, -z, w))
        law, elapsed_s = self._filter, self._times.elapsed_s
        field = self._field(values)
        if elapsed_s * 1e9 <= self.parameters.timeout:  # False for the first sample (NaN)
            law.update(self._unbiased(rate, elapsed_s), acceleration, field, elapsed_s)
        else:
            law.initialize_orientation(acceleration, field, law.heading)
            self._resting_s = 0.0
        return _product(self._east, (law.x, law.y, law.z, law.w))

    def _field(self, values: list[float]) -> Vector | None:
        """Return the magnetic field in the axes of the link, T; None if it is missing or older than the
        timeout.
        """
        if self.parameters.magnetometer is None:
            return None
        x, y, z, age_s = values[7:11]
        if not (math.isfinite(x + y + z) and age_s * 1e9 <= self.parameters.timeout):
            return None
        return self._turned([x, y, z])

    def _unbiased(self, rate: Vector, dt: float) -> Vector:
        """Return the angular velocity without the gyroscope bias, rad/s; at rest, the bias is estimated
        from it.
        """
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
        """Report once that no sample was received for `timeout`."""
        timeout = self.parameters.timeout
        if not self._silent and self._times.age_s(time_ns) * 1e9 > timeout:
            self._silent = True
            self.context.say(
                f"no new sample from {self.parameters.sensor} for {timeout * 1e-9:g} s: "
                "the states keep their last values"
            )

    def _is_finite(self, values: list[float], own: int) -> bool:
        """Return True if the first `own` values of a sample are finite; report once if they are not."""
        if all(map(math.isfinite, values[:own])):
            return True
        if not (self._wrong or math.isnan(values[own])):  # age NaN: the first sample is still to come
            self._wrong = True
            self.context.say(f"{self.parameters.sensor} measured NaN or infinity: these samples are skipped")
        return False


Quaternion = tuple[float, float, float, float]
"""Quaternion x, y, z, w."""


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the quaternion product a b: rotation b followed by rotation a."""
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
    """Write variances about x, y, z into the diagonal of a 3x3 covariance, shape (9,); None changes
    nothing.
    """
    if variances is not None:
        matrix[[0, 4, 8]] = variances
