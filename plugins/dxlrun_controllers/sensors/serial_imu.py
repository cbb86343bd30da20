"""serial_imu: inertial measurement unit that sends lines of text over a serial port.

A line ends with a line feed and has one number for each column, separated by commas or blanks, such as

    0.02,-0.11,9.79,0.001,0.000,-0.002

With a `prefix`, each line must start with it (`$IMU,...`). With `checksum: true`, a line ends with `*` and
two hexadecimal digits: the exclusive or of all bytes before the `*`, without a leading `$`, as in NMEA 0183.
Any other line is garbage, which is counted, reported, and ignored.
"""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Iterator
from functools import reduce
from operator import xor
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from dxlrun import Floats, ParametersModel, Sensor, SensorContext, open_serial

_SIX = (
    "linear_acceleration.x",
    "linear_acceleration.y",
    "linear_acceleration.z",
    "angular_velocity.x",
    "angular_velocity.y",
    "angular_velocity.z",
)
_IGNORED = "-"
_LONGEST_LINE = 4096
"""Length of received bytes without a line feed, above which they are discarded, for example at a wrong
baud rate.
"""
_LOOK_S = 0.5
"""Longest wait of one `read`, s, so that the sensor process can stop."""
_REPORT_NS = 1_000_000_000
"""Shortest time between two reports of garbage, ns."""


class SerialImuParameters(ParametersModel):
    """Serial port and format of the lines"""

    port: str = Field(min_length=1, description="Path of the serial port.", examples=["/dev/ttyACM0"])
    baud_rate: int = Field(default=115_200, gt=0, description="Baud rate, bit/s.", examples=["115_200"])
    columns: tuple[str, ...] = Field(
        default=_SIX,
        min_length=1,
        description="State names for the numbers of a line, from left to right; `-` skips a number.",
        examples=["[angular_velocity.x, '-', linear_acceleration.z]"],
    )
    scale: dict[str, Annotated[float, Field(ge=-1e9, le=1e9)]] = Field(
        default={},
        description="Factors from the numbers of a group to rad/s, m/s^2 or T, by group; 1 by default.",
        examples=["{linear_acceleration: 9.80665, angular_velocity: 0.0174533}"],
    )
    prefix: str = Field(default="", description="Text at the start of each line.", examples=["$IMU,"])
    checksum: bool = Field(
        default=False, description="If true, lines end with `*` and a checksum, as in NMEA 0183."
    )

    @field_validator("columns")
    @classmethod
    def _distinct(cls, columns: tuple[str, ...]) -> tuple[str, ...]:
        states = [column for column in columns if column != _IGNORED]
        if not states:
            raise ValueError("no column is a state; name at least one")
        if wrong := [state for state in states if not state or "/" in state or state == "age"]:
            raise ValueError(f"{wrong[0]!r} is not a valid state; write a name such as angular_velocity.x")
        if twice := [state for state in states if states.count(state) > 1]:
            raise ValueError(f"{twice[0]} occurs twice; name each state once")
        return columns

    @field_validator("scale")
    @classmethod
    def _of_columns(cls, scale: dict[str, float], info: ValidationInfo) -> dict[str, float]:
        groups = {column.partition(".")[0] for column in info.data.get("columns", scale)} - {_IGNORED}
        if unused := [group for group in scale if group not in groups and "columns" in info.data]:
            raise ValueError(f"no column belongs to {unused[0]}; the groups are {', '.join(sorted(groups))}")
        return scale


class SerialImu(Sensor[SerialImuParameters]):
    """Sensor that reads the newest line of the port. The time of a sample is the arrival of its line.

    `read` raises an error if the device is unplugged. The runtime then tries to open it once a second.
    """

    Parameters = SerialImuParameters
    waits = True

    @classmethod
    def states(cls, parameters: SerialImuParameters) -> tuple[str, ...]:
        """Return the states of the columns that are used."""
        return tuple(column for column in parameters.columns if column != _IGNORED)

    def open(self, context: SensorContext) -> None:
        """Open the port for exclusive use. Raises OSError."""
        super().open(context)
        own = self.parameters
        self._places = [index for index, column in enumerate(own.columns) if column != _IGNORED]
        self._scales = [own.scale.get(state.partition(".")[0], 1.0) for state in self.states(own)]
        self._port = open_serial(own.port, own.baud_rate)
        self._received = b""
        self._begun = False  # the first line may be incomplete, so it is skipped
        self._garbage, self._shown = 0, b""
        self._reported_ns = -_REPORT_NS

    def close(self) -> None:
        """Close the port."""
        if (port := getattr(self, "_port", None)) is not None:
            port.close()

    def read(self, values: Floats) -> int | None:
        """Wait for lines, at most 0.5 s, and write the newest one's numbers, in SI units, into `values`.

        Returns the time of its arrival, ns, or None without a valid line. Raises OSError if the device is
        unplugged.
        """
        if not select.select([self._port.fileno()], [], [], _LOOK_S)[0]:
            return None
        data = os.read(self._port.fileno(), 65536)
        t_ns = time.monotonic_ns()
        if not data:
            raise OSError(errno.ENODEV, f"{self.parameters.port} is gone")
        newest: list[float] | None = None
        for line in self._lines(data):
            newest = self._numbers(line) or newest
        self._report_garbage(t_ns)
        if newest is None:
            return None
        for index, (number, scale) in enumerate(zip(newest, self._scales, strict=True)):
            values[index] = number * scale
        return t_ns

    def _lines(self, data: bytes) -> Iterator[bytes]:
        *lines, self._received = (self._received + data).split(b"\n")
        if len(self._received) > _LONGEST_LINE:
            lines.append(self._received[:_LONGEST_LINE])
            self._received = b""
        for line in lines:
            if self._begun and line.strip():
                yield line.strip()
            self._begun = True

    def _numbers(self, line: bytes) -> list[float] | None:
        """Return the used numbers of a line; None for garbage, which is counted."""
        prefix = self.parameters.prefix.encode()
        text: bytes | None = line if line.startswith(prefix) else None
        if text is not None and self.parameters.checksum:
            text = checked(text)
        if text is not None:
            parts = text[len(prefix) :].replace(b",", b" ").split()
            if len(parts) == len(self.parameters.columns):
                try:
                    return [float(parts[place]) for place in self._places]
                except ValueError:
                    pass
        self._garbage, self._shown = self._garbage + 1, line
        return None

    def _report_garbage(self, t_ns: int) -> None:
        if self._garbage and t_ns - self._reported_ns >= _REPORT_NS:
            shown = self._shown[:60].decode("ascii", "backslashreplace")
            count = "a line is not" if self._garbage == 1 else f"{self._garbage} lines are not"
            self.context.say(
                f"{count} a sample of {len(self.parameters.columns)} numbers; last line: {shown}"
            )
            self._garbage, self._reported_ns = 0, t_ns


def checked(line: bytes) -> bytes | None:
    """Return a line without its checksum `*HH`; None if the checksum is missing or wrong."""
    text, star, digits = line.rpartition(b"*")
    try:
        given = int(digits, 16)
    except ValueError:
        return None
    return text if star and given == reduce(xor, text.removeprefix(b"$"), 0) else None
