"""Servo rows: the values that a reader fills and a writer sends, one row for each servo."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from numbers import Real

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dxlwire.bus.item_values import item_of
from dxlwire.bus.programs import USE_TORQUE, Addressed
from dxlwire.bus.session import OpenLine
from dxlwire.control_table import ControlItem
from dxlwire.exchange.arrays import Floats
from dxlwire.modes import COMMAND_INTERFACES

_AGE = ""  # Place of the ages among the numbers; no item has this name


class ServoStates(msgspec.Struct, eq=False):
    """Values of one read, with one element for each servo in the order of `ids`.

    An item is an attribute under its name, with or without `present_`: `state.position`,
    `state.goal_position`. A servo that did not answer keeps its last values, NaN before the first."""

    ids: tuple[int, ...]
    valid: NDArray[np.bool_]  # True for each servo that answered
    alert: NDArray[np.bool_]
    """True for each servo whose last reply reported an error, such as an overload; the item
    `hardware_error_status` has it."""
    _numbers: Floats
    _places: Mapping[str, slice]

    @property
    def age(self) -> Floats:
        """Age of the values, seconds; NaN before the first reply."""
        age_ns = self._numbers[self._places[_AGE]].view(np.int64)
        return np.where(age_ns < 0, np.nan, age_ns * 1e-9)

    def __getattr__(self, name: str) -> Floats:
        if name.startswith("_"):  # `copy` and `pickle` ask for special methods before there are items
            raise AttributeError(name)
        try:
            values: Floats = self._numbers[self._places[name]]
        except KeyError:
            raise AttributeError(f"this reader has no item {name!r}") from None
        return values

    def __getitem__(self, item: str) -> Floats:
        return self.__getattr__(item)

    def __repr__(self) -> str:
        items = ", ".join(name for name in self._places if name != _AGE)
        return f"ServoStates({items}; {np.count_nonzero(self.valid)} of {len(self.ids)} valid)"


class ServoRows(msgspec.Struct):
    """States of the servos of a reader; implements `SourceArrays`."""

    values: Floats
    valid: NDArray[np.bool_]
    age_ns: NDArray[np.int64]


class ReadRows(ABC):
    """Values of the servos of a reader, filled by one of the two exchanges; base class of these."""

    def __init__(self, session: OpenLine, servos: Sequence[Addressed], items: Sequence[str]) -> None:
        if not items:
            raise ValueError("name at least one item")
        check_different(items)
        session.cycles += 1
        count = len(servos)
        self.ids = tuple(servo.servo_id for servo in servos)
        self._items = {name: index for index, name in enumerate(items)}
        self._places = {name: slice(row * count, (row + 1) * count) for name, row in self._items.items()}
        self._places |= {name.removeprefix("present_"): place for name, place in self._places.items()}
        self._places[_AGE] = slice(len(items) * count, None)
        # Values and ages are one array, because each copy takes longer than its bytes. An age is an integer.
        self._numbers: Floats = np.full((len(items) + 1) * count, np.nan)
        age_ns = self._numbers[self._places[_AGE]].view(np.int64)
        age_ns.fill(-1)
        values = self._numbers[: len(items) * count]
        self._arrays = ServoRows(values, np.zeros(count, np.bool_), age_ns)
        self._values: Floats = values.reshape(len(items), count)
        self._alert = np.zeros(count, np.bool_)
        # In Protocol 1.0 each bit of the error byte is a state of the servo.
        self._alert_bits = session.line.dialect.ALERT or 0xFF

    @abstractmethod
    def read_servos(self) -> None:
        """Read every item of every servo once.

        Raises:
            PortError: The line is closed or lost.
        """

    @property
    @abstractmethod
    def read_by(self) -> str:
        """Instructions of one call in the e-Manual's words."""

    def newest_state(self) -> ServoStates:
        """Return a copy of the values of the newest cycle."""
        valid = self._arrays.valid.copy()
        return ServoStates(self.ids, valid, self._alert.copy(), self._numbers.copy(), self._places)


class WrittenRows(ABC):
    """Goals of one writer, sent by one of the two exchanges; base class of these."""

    def __init__(self, session: OpenLine, servos: Sequence[Addressed], items: Sequence[str]) -> None:
        if not 1 <= len(items) <= len(COMMAND_INTERFACES):
            raise ValueError(f"name one to {len(COMMAND_INTERFACES)} items; {len(items)} were given")
        check_different(items)
        session.cycles += 1
        self._goals: Floats = np.full((len(COMMAND_INTERFACES), len(servos)), np.nan)
        self._given = self._goals[: len(items)]
        self._rows = tuple(self._given)
        self._flat = self._given.reshape(-1)
        self._items, self._servos = tuple(items), tuple(servo.servo_id for servo in servos)

    def send_values(self, values: Sequence[ArrayLike]) -> None:
        """Send one packet for each block of items, which no servo acknowledges.

        Raises:
            ValueError: An argument has more or fewer values than servos, or a value is not a finite number or
                NaN.
            PortError: The line is closed or lost.
        """
        rows = self._rows
        if len(values) != len(rows):
            raise TypeError(f"this writer takes {len(rows)} values, one for each item; got {len(values)}")
        index = 0
        try:
            for value in values:
                np.copyto(rows[index], value)  # an assignment makes numbers of texts
                index += 1  # `enumerate` takes longer
        except TypeError:
            self._refuse_values(values)
            raise
        except ValueError:
            if (given := np.size(values[index])) in (1, servos := self._goals.shape[1]):
                raise  # Not numbers
            raise ValueError(f"argument {index + 1}: {given} values for {servos} servos") from None
        if not math.isfinite(sum(self._flat.tolist())):  # numpy takes ten times as long for so few numbers
            self._refuse_values(values)
        self.send_goals()

    def _refuse_values(self, values: Sequence[ArrayLike]) -> None:
        """Raise ValueError for a value that is infinite or not a number."""
        for item, value in zip(self._items, values, strict=True):
            given = np.broadcast_to(np.asarray(value, object), len(self._servos))
            for servo_id, number in zip(self._servos, given, strict=True):
                if not isinstance(number, Real) or math.isinf(number):
                    raise ValueError(f"{item} of ID {servo_id} is {number!r}; give a number, or NaN for none")

    @abstractmethod
    def send_goals(self) -> None:
        """Send the goals of each servo that has one for every item.

        Raises:
            PortError: The line is closed or lost.
        """


def check_different(items: Sequence[object]) -> None:
    """Raise ValueError if an item is named twice, or if the names are in a list."""
    if listed := next((name for name in items if isinstance(name, list | tuple)), None):
        raise ValueError(f"{listed} is a list; give {', '.join(map(repr, listed))} without brackets")
    if twice := next((name for name in items if items.count(name) > 1), None):
        raise ValueError(f"{twice} is named twice")


def writable_item(servo: Addressed, name: str) -> ControlItem:
    """Return an item that a writer may write.

    Raises:
        LookupError: The model has no such item.
        ValueError: The item is read-only or in the EEPROM.
    """
    item = item_of(servo.table, name)
    if item.access == "R":
        raise ValueError(f"{item.title} of {servo.table.model} is read-only")
    if item.area == "EEPROM":
        raise ValueError(
            f"{item.title} of {servo.table.model} is in the EEPROM, which wears out; use `servos.write`"
        )
    if item.name == "torque_enable":
        raise ValueError(USE_TORQUE)
    return item
