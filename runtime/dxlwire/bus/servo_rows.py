"""Servo rows: the values that a reader fills and a writer sends, one row for each servo."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dxlwire.bus.item_values import item_of
from dxlwire.bus.programs import USE_TORQUE, Addressed
from dxlwire.bus.session import OpenLine
from dxlwire.control_table import ControlItem
from dxlwire.exchange.arrays import Floats
from dxlwire.modes import COMMAND_INTERFACES


class ServoStates:
    """Values of one read, with one element for each servo in the order of `ids`.

    An item is an attribute under its name, with or without `present_`: `state.position`,
    `state.goal_position`. A servo that did not answer keeps its last values, NaN before the first."""

    __slots__ = ("_age_ns", "_items", "_values", "alert", "ids", "valid")

    def __init__(  # noqa: PLR0917  the arrays of a state
        self,
        items: dict[str, int],
        ids: tuple[int, ...],
        values: Floats,
        valid: NDArray[np.bool_],
        age_ns: NDArray[np.int64],
        alert: NDArray[np.bool_],
    ) -> None:
        self._items = items
        self._values = values
        self._age_ns = age_ns
        self.ids = ids
        self.valid = valid  # True for each servo that answered
        self.alert = alert
        """True for each servo whose last reply reported an error, such as an overload; the item
        `hardware_error_status` has it."""

    @property
    def age(self) -> Floats:
        """Age of the values, seconds; NaN before the first reply."""
        return np.where(self._age_ns < 0, np.nan, self._age_ns * 1e-9)

    def __getattr__(self, name: str) -> Floats:
        if name.startswith("_"):  # `copy` and `pickle` ask for special methods before there are items
            raise AttributeError(name)
        try:
            values: Floats = self._values[self._items[name]]
        except KeyError:
            raise AttributeError(f"this reader has no item {name!r}") from None
        return values

    def __getitem__(self, item: str) -> Floats:
        return self.__getattr__(item)

    def __repr__(self) -> str:
        return (
            f"ServoStates({', '.join(self._items)}; {np.count_nonzero(self.valid)} of {len(self.ids)} valid)"
        )


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
        self._items |= {name.removeprefix("present_"): index for name, index in self._items.items()}
        self._values: Floats = np.full((len(items), count), np.nan)
        self._arrays = ServoRows(
            self._values.reshape(-1), np.zeros(count, np.bool_), np.full(count, -1, np.int64)
        )
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
        """Return the values of the newest cycle."""
        arrays = self._arrays
        return ServoStates(
            self._items,
            self.ids,
            self._values.copy(),
            arrays.valid.copy(),
            arrays.age_ns.copy(),
            self._alert.copy(),
        )


class WrittenRows(ABC):
    """Goals of one writer, sent by one of the two exchanges; base class of these."""

    def __init__(self, session: OpenLine, servos: Sequence[Addressed], items: Sequence[str]) -> None:
        if not 1 <= len(items) <= len(COMMAND_INTERFACES):
            raise ValueError(f"name one to {len(COMMAND_INTERFACES)} items; {len(items)} were given")
        check_different(items)
        session.cycles += 1
        self._goals: Floats = np.full((len(COMMAND_INTERFACES), len(servos)), np.nan)
        self._count = len(items)

    def send_values(self, values: Sequence[ArrayLike]) -> None:
        """Send one packet for each block of items, which no servo acknowledges.

        Raises:
            ValueError: An argument has more or fewer values than servos, or no numbers.
            PortError: The line is closed or lost.
        """
        if len(values) != self._count:
            raise TypeError(f"this writer takes {self._count} values, one for each item; got {len(values)}")
        for row, value in enumerate(values):
            try:
                self._goals[row] = value
            except ValueError:
                if (given := np.size(value)) in (1, servos := self._goals.shape[1]):
                    raise  # Not numbers
                raise ValueError(f"argument {row + 1}: {given} values for {servos} servos") from None
        goals = self._goals[: self._count]
        if self._count > 1 and math.isnan(goals.sum()):  # Quicker than to look at each goal
            # Half of a servo's values would be sent with zeros or old ones for the rest
            goals[:, np.isnan(goals).any(axis=0)] = np.nan
        self.send_goals()

    @abstractmethod
    def send_goals(self) -> None:
        """Send the goals. Raises PortError if the line is closed or lost."""


def check_different(items: Sequence[str]) -> None:
    """Raise ValueError if an item is named twice."""
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
