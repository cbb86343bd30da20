"""phidget_spatial: acceleration, angular velocity and magnetic field of a Phidget Spatial.

Units (g, degrees per second, gauss) and events are documented on the API page of the class Spatial of
Phidgets. Accelerations are negated for sensor_msgs/Imu, as in ros-drivers/phidgets_drivers.
"""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from dxlrun import Duration, Floats, ParametersModel, Sensor, SensorContext

if TYPE_CHECKING:
    from Phidget22.Devices.Spatial import Spatial

G = 9.80665
"""Standard gravity, m/s^2."""
TESLA_PER_GAUSS = 1e-4
UNKNOWN = 1e300
"""Placeholder of the library for an unknown value (PUNK_DBL of phidget22.h)."""
_AXES = ("x", "y", "z")
_LOOK_S = 0.5
"""Longest wait of one `read`, s, so that the sensor process can stop."""
_FIELD_NS = 100_000_000
"""Time for which the last magnetic field replaces an unknown one, ns.

The magnetometer is slower than the other sensors, and pauses for its internal calibration.
"""


class PhidgetSpatialParameters(ParametersModel):
    """Selection of the unit"""

    serial_number: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="Serial number of the unit, or of its VINT hub. Default: any unit."
    )
    hub_port: Annotated[int, Field(ge=0, le=5)] | None = Field(
        default=None, description="Port of the VINT hub. Default: any port."
    )
    magnetometer: bool = Field(
        default=True, description="If true, also provide the states of the magnetometer."
    )
    attach_timeout: Annotated[Duration, Field(gt=0)] = Field(
        default=5_000_000_000,
        description="Time to wait for the unit at the start.",
        examples=["5 s"],
    )


class PhidgetSpatial(Sensor[PhidgetSpatialParameters]):
    """Sensor that reads the newest sample of a Phidget Spatial, whose library calls handlers in its own
    thread.
    """

    Parameters = PhidgetSpatialParameters
    waits = True
    _channel: Spatial | None = None

    @classmethod
    def states(cls, parameters: PhidgetSpatialParameters) -> tuple[str, ...]:
        """Return the states of the unit: acceleration, angular velocity and, if wanted, magnetic field, in
        SI units.
        """
        groups = ["linear_acceleration", "angular_velocity"]
        groups += ["magnetic_field"] * parameters.magnetometer
        return tuple(f"{group}.{axis}" for group in groups for axis in _AXES)

    def open(self, context: SensorContext) -> None:
        """Open the unit and set its data interval. Raises OSError on an error or a timeout."""
        from Phidget22.Devices.Spatial import Spatial
        from Phidget22.PhidgetException import PhidgetException

        super().open(context)
        self._news = threading.Condition()
        self._sample: tuple[int, list[float]] | None = None
        self._field, self._field_ns = [math.nan] * 3, 0
        self._detached = False
        try:
            self._channel = channel = Spatial()
            if (number := self.parameters.serial_number) is not None:
                channel.setDeviceSerialNumber(number)
            if (port := self.parameters.hub_port) is not None:
                channel.setHubPort(port)
            channel.setOnSpatialDataHandler(self._store_event)
            channel.setOnDetachHandler(self._leave)
            channel.openWaitForAttachment(round(self.parameters.attach_timeout / 1e6))
            channel.setDataInterval(max(channel.getMinDataInterval(), round(context.period_ns / 1e6)))
        except PhidgetException as error:
            unit = "Phidget Spatial" if number is None else f"Phidget Spatial {number}"
            raise OSError(f"{unit}: {error.description or error}") from error

    def read(self, values: Floats) -> int | None:
        """Wait for the next sample, at most 0.5 s, and write it into `values`.

        Returns its time of arrival, ns, or None without one. Raises OSError if the unit is unplugged.
        """
        with self._news:
            self._news.wait_for(lambda: self._sample is not None or self._detached, _LOOK_S)
            sample, self._sample = self._sample, None
            if self._detached:
                raise OSError("the Phidget Spatial was detached; plug it in again")
        if sample is None:
            return None
        t_ns, found = sample
        values[:] = found[: len(values)]
        return t_ns

    def close(self) -> None:
        """Close the connection to the unit."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _store_event(
        self,
        _channel: object,
        acceleration: list[float],
        rate: list[float],
        field: list[float],
        _timestamp: float,
    ) -> None:
        """Handle data of the library: convert them to SI units, and store them as the newest sample with
        their time.
        """
        t_ns = self.context.now_ns()
        found = [-G * _known(value) for value in acceleration]
        found += [math.radians(_known(value)) for value in rate]
        if max(map(abs, field)) < UNKNOWN:
            self._field, self._field_ns = [TESLA_PER_GAUSS * value for value in field], t_ns
        found += self._field if t_ns - self._field_ns <= _FIELD_NS else [math.nan] * 3
        with self._news:
            self._sample = t_ns, found
            self._news.notify()

    def _leave(self, _channel: object) -> None:
        with self._news:
            self._detached = True
            self._news.notify()


def _known(value: float) -> float:
    return math.nan if abs(value) >= UNKNOWN else value
