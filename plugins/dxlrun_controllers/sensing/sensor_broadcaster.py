"""sensor_broadcaster: publish states of devices, sensors and joints as a standard message of ROS 2."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from operator import attrgetter
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from dxlrun import (
    Context,
    Controller,
    Duration,
    Floats,
    Interfaces,
    Length,
    Mistake,
    ParametersModel,
)
from dxlrun.tooling.topics import messages
from dxlrun_controllers.sensing.sample_times import SampleTimes

MessageName = Literal[
    "BatteryState", "FluidPressure", "MagneticField", "Range", "Temperature", "WrenchStamped"
]
MESSAGES: Mapping[MessageName, tuple[str, type]] = {
    "BatteryState": ("battery_state", messages.BatteryState),
    "FluidPressure": ("fluid_pressure", messages.FluidPressure),
    "MagneticField": ("magnetic_field", messages.MagneticField),
    "Range": ("range", messages.Range),
    "Temperature": ("temperature", messages.Temperature),
    "WrenchStamped": ("wrench", messages.WrenchStamped),
}
"""Name of each message -> its topic, as the broadcasters of ROS 2 call it, and its type."""
Cell = Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)]
"""Position of a force sensor in the frame of the sole, m: x forward and y to the left."""


class SensorParameters(ParametersModel):
    """Keys of a sensor_broadcaster in the robot file."""

    message: MessageName = Field(examples=["Range"])
    """Type of the message."""
    fields: dict[str, str | float | dict[str, float]] = Field(default_factory=dict)
    """Fields of the message. The value is a state (`sonar/range`), a number, or a weighted sum: a mapping of
    states to factors."""
    cells: dict[str, Cell] = Field(default_factory=dict)
    """Force sensors of a WrenchStamped: states with upward forces on a sole, N, and their positions."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Force per unit of the states of `cells`, N."""
    frame: str = ""
    """Name of the frame in the messages."""
    timeout: Annotated[Duration, Field(gt=0)] = 500_000_000
    """Age of a value above which nothing is published."""

    def mistakes(self) -> Iterator[Mistake]:
        """Yield unknown fields of the message, values of the wrong type, and invalid names of states."""
        yield from super().mistakes()
        if self.cells and self.message != "WrenchStamped":
            yield ("cells",), f"cells are only for WrenchStamped, not {self.message}; remove cells"
        kinds = _numbers(self.message)
        for path, value in self.fields.items():
            if path not in kinds:
                yield (
                    ("fields", path),
                    f"{self.message} has no numeric field {path}; use one of {', '.join(kinds)}",
                )
            elif kinds[path] is int and not (isinstance(value, float) and value.is_integer()):
                yield (
                    ("fields", path),
                    f"{path} of {self.message} must be a whole number, such as 1",
                )
        states = self.weights
        if not any(states.values()):
            yield (), "no field or cell names a state; write one, such as {range: sonar/range}"
        for path, weights in states.items():
            for name in weights:
                if "/" not in name:
                    yield (
                        ("fields", path),
                        f"{name} is not a state; write OWNER/STATE, such as sonar/range",
                    )
            if self.cells and path in self.fields and path in _OF_CELLS:
                yield ("fields", path), f"{path} is computed from the cells; remove it from the fields"

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Field of the message -> state -> factor of its weighted sum; fields with a constant are not
        included.

        An upward force F at (x, y) has the torque (y F, -x F, 0) about the origin.
        """
        found = {
            path: {value: 1.0} if isinstance(value, str) else value
            for path, value in self.fields.items()
            if not isinstance(value, float)
        }
        if self.cells:
            found |= {
                "wrench.force.z": dict.fromkeys(self.cells, self.scale),
                "wrench.torque.x": {name: self.scale * y for name, (_, y) in self.cells.items()},
                "wrench.torque.y": {name: -self.scale * x for name, (x, _) in self.cells.items()},
            }
        return found


_OF_CELLS = ("wrench.force.z", "wrench.torque.x", "wrench.torque.y")


class SensorBroadcaster(Controller[SensorParameters]):
    """Controller that publishes a message when at least one of its states has a new value.

    Nothing is published while a state is NaN, infinite, or older than `timeout`. An event reports that once.
    """

    Parameters = SensorParameters

    @classmethod
    def interfaces(cls, parameters: SensorParameters, joints: tuple[str, ...]) -> Interfaces:
        """Read the states and their ages."""
        states = _states(parameters)
        return Interfaces((), reads=(*states, *(f"{owner}/age" for owner in _owners(states))))

    @classmethod
    def topics(cls, parameters: SensorParameters) -> Mapping[str, type]:
        """Return the topic of the message and its type."""
        topic, message = MESSAGES[parameters.message]
        return {topic: message}

    def on_configure(self, context: Context) -> None:
        """Allocate the message, and the matrix that computes its fields from the states."""
        super().on_configure(context)
        parameters = self.parameters
        states, weights = _states(parameters), parameters.weights
        self._count = len(states)
        self._matrix: Floats = np.array([[row.get(name, 0.0) for name in states] for row in weights.values()])
        self._topic, kind = MESSAGES[parameters.message]
        self._message = kind()
        self._message.header.frame_id = parameters.frame
        self._places = [_place(self._message, path) for path in weights]
        kinds = _numbers(parameters.message)
        for path, value in parameters.fields.items():
            if isinstance(value, float):
                owner, name = _place(self._message, path)
                setattr(owner, name, kinds[path](value))
        self._times = [SampleTimes(context.period_ns) for _ in _owners(states)]

    def on_activate(self, time_ns: int) -> None:
        """Discard all previous samples."""
        for times in self._times:
            times.discard_sample()
        self._silent = False

    def update(self, time_ns: int, period_ns: int) -> None:
        """Publish the message if a state has a new sample and all are fresh and finite."""
        reads = self.context.reads
        ages = reads[self._count :].tolist()
        new = False
        for times, age_s in zip(self._times, ages, strict=True):
            new |= times.accept_sample(time_ns, age_s)
        if math.isnan(sum(ages)):  # a sensor has no sample yet
            return
        values = (self._matrix @ reads[: self._count]).tolist()
        if not all(map(math.isfinite, values)) or max(ages) * 1e9 > self.parameters.timeout:
            self._report_silence(ages)
            return
        if not new:
            return
        self._silent = False
        for (owner, name), value in zip(self._places, values, strict=True):
            setattr(owner, name, value)
        self.context.publish(self._topic, self._message)

    def _report_silence(self, ages: list[float]) -> None:
        if not self._silent:
            self._silent = True
            old = max(ages) * 1e9 > self.parameters.timeout
            what = f"are older than {self.parameters.timeout * 1e-9:g} s" if old else "are not finite numbers"
            self.context.say(f"states {what}: nothing is published")


def _states(parameters: SensorParameters) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for row in parameters.weights.values() for name in row))


def _owners(states: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.rpartition("/")[0] for name in states))


def _numbers(message: MessageName) -> dict[str, type[int] | type[float]]:
    """Return path -> type of all numeric fields of a message, except those of the header."""
    found: dict[str, type[int] | type[float]] = {}

    def add(value: object, path: str) -> None:
        if type(value) in {int, float}:
            found[path] = int if isinstance(value, int) else float
        for name in getattr(type(value), "__struct_fields__", ()):
            if name != "header":
                add(getattr(value, name), f"{path}.{name}" if path else name)

    add(MESSAGES[message][1](), "")
    return found


def _place(message: object, path: str) -> tuple[object, str]:
    """Return the object within a message that contains the field of a path, and the field's name there."""
    outer, _, name = path.rpartition(".")
    return attrgetter(outer)(message) if outer else message, name
