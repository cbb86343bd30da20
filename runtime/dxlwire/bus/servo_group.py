"""Group: the servos of a script, with the programs that work on all of them one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import SupportsIndex

import numpy as np
from numpy.typing import NDArray

from dxlwire.bus.item_values import item_of, ticks_of, value_in
from dxlwire.bus.kernel_exchange import Reading, Writing
from dxlwire.bus.programs import (
    USE_TORQUE,
    Addressed,
    Failures,
    ServoFailed,
    identify,
    read_item,
    switch_torque,
    write_item,
)
from dxlwire.bus.sdk_exchange import SdkReading, SdkWriting
from dxlwire.bus.session import SdkSession, Session
from dxlwire.control_table import ControlItem, find_table
from dxlwire.exceptions import ServoError
from dxlwire.exchange.arrays import Floats
from dxlwire.transaction import Program

Value = float | str
Values = Value | Sequence[Value] | Floats
Switch = bool | Sequence[bool] | NDArray[np.bool_]


class ServoGroup:
    """Servos of one line, in the order in which they were given."""

    def __init__(self, session: Session | SdkSession, servos: Sequence[Addressed]) -> None:
        self.session = session
        self.servos = tuple(servos)

    @property
    def ids(self) -> tuple[int, ...]:
        """IDs of the servos."""
        return tuple(servo.servo_id for servo in self.servos)

    @property
    def models(self) -> tuple[str, ...]:
        """Models of the servos."""
        return tuple(servo.table.model for servo in self.servos)

    def part(self, ids: int | Sequence[int]) -> ServoGroup:
        """Return a group of one or some of these servos, in the order of `ids`.

        Raises:
            LookupError: The group has no servo with one of these IDs.
        """
        ids = [ids] if isinstance(ids, SupportsIndex | str) else ids
        known = {servo.servo_id: servo for servo in self.servos}
        if unknown := [each for each in ids if each not in known]:
            raise LookupError(f"no servo with ID {unknown[0]!r} here; there are {list(known)}")
        return ServoGroup(self.session, [known[each] for each in ids])

    def read_values(self, item: str, *, raw: bool) -> Program[tuple[Floats, Failures]]:
        """Read an item of every servo; return the values, NaN for each failure."""
        items = [item_of(servo.table, item) for servo in self.servos]
        values = np.full(len(items), np.nan)
        failures: Failures = {}
        for row, (servo, one) in enumerate(zip(self.servos, items, strict=True)):
            try:
                data = yield from read_item(self.session.line, servo.servo_id, one)
                values[row] = value_in(one, data, raw=raw)
            except ServoFailed as error:
                failures[servo.servo_id] = error.failure
        return values, failures

    def write_values(self, item: str, values: Values, *, raw: bool) -> Program[Failures]:
        """Write an item of every servo. All values are checked before the first one is sent."""
        given = self._one_each(item, values)
        if item == "id" and len(set(given)) < len(given):
            raise ValueError("id: two servos of one line cannot have the same ID")
        wanted: list[tuple[Addressed, ControlItem, bytes]] = []
        for servo, value in zip(self.servos, given, strict=True):
            one = item_of(servo.table, item)
            if one.access == "R":
                raise ValueError(f"{one.title} of {servo.table.model} is read-only")
            if one.name == "torque_enable":
                raise ValueError(USE_TORQUE)
            wanted.append((servo, one, one.encode(ticks_of(servo.table, one, value, raw=raw))))
        line = self.session.line
        return _all((servo.servo_id, write_item(line, servo, one, data)) for servo, one, data in wanted)

    def switch_all(self, on: Switch) -> Program[Failures]:
        """Switch the torque of every servo on or off.

        Raises:
            ValueError: A value is neither true nor false.
        """
        given = self._one_each("torque", on)
        if not all(isinstance(each, (bool, np.bool_)) for each in given):
            raise ValueError("torque: use True or False")
        line = self.session.line
        return _all(
            (servo.servo_id, switch_torque(line, servo, bool(each)))
            for servo, each in zip(self.servos, given, strict=True)
        )

    def _one_each(self, name: str, values: Values | Switch) -> list[Value]:
        """Return one value for each servo. Raises ValueError if there are more or fewer."""
        if isinstance(values, str) or np.ndim(values) == 0:
            return [values] * len(self.servos)  # type: ignore[list-item]  # it is not a sequence
        given: list[Value] = list(values)  # type: ignore[arg-type]
        if len(given) != len(self.servos):
            raise ValueError(f"{name}: {len(given)} values for {len(self.servos)} servos")
        return given

    def make_reading(self, items: Sequence[str], *, raw: bool) -> Reading | SdkReading:
        """Return the exchange of a reader of these servos."""
        if isinstance(self.session, SdkSession):
            return SdkReading(self.session, self.servos, items, raw=raw)
        return Reading(self.session, self.servos, items, raw=raw)

    def make_writing(self, items: Sequence[str], *, raw: bool) -> Writing | SdkWriting:
        """Return the exchange of a writer of these servos."""
        if isinstance(self.session, SdkSession):
            return SdkWriting(self.session, self.servos, items, raw=raw)
        return Writing(self.session, self.servos, items, raw=raw)

    def raise_failures(self, failures: Failures) -> None:
        """Raise ServoError if there are failures."""
        if failures:
            raise ServoError(self.session.name, failures)


def _all(programs: Iterable[tuple[int, Program[None]]]) -> Program[Failures]:
    """Run the programs of servos, given with their IDs, one after the other; return the failures."""
    failures: Failures = {}
    for servo_id, program in programs:
        try:
            yield from program
        except ServoFailed as error:
            failures[servo_id] = error.failure
    return failures


def found_group(session: Session | SdkSession, found: tuple[list[Addressed], Failures]) -> ServoGroup:
    """Return the group of the servos that were identified. Raises ServoError if one was not."""
    servos, failures = found
    group = ServoGroup(session, servos)
    group.raise_failures(failures)
    return group


def named_servos(
    session: Session | SdkSession, models: Mapping[int, str]
) -> Program[tuple[list[Addressed], Failures]]:
    """Return the program that identifies servos of known models.

    Raises:
        LookupError: A model is unknown in this protocol.
        ValueError: No servo is named, one has no model, or an ID does not exist in the protocol.
    """
    if not models:
        raise ValueError("name at least one servo")
    try:
        named = dict(models)
    except (TypeError, ValueError):
        raise ValueError("give each ID its model, such as {1: 'XM430-W350'}; `scan` finds both") from None
    highest = session.line.dialect.HIGHEST_ID
    for servo_id in named:
        if servo_id not in range(highest + 1):
            raise ValueError(f"ID {servo_id!r} does not exist; IDs are 0 to {highest}")
    protocol = session.plan.protocol
    return identify(session.line, {each: find_table(model, protocol) for each, model in named.items()})
