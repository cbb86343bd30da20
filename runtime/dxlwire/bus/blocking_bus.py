"""Blocking bus: servos of one serial line in a script, each call of which waits for the replies."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dxlwire.bus.programs import Addressed, Failures, find_ids, identify
from dxlwire.bus.servo_group import ServoGroup, Switch, Values, found_group, named_servos
from dxlwire.bus.servo_rows import ReadRows, ServoStates, WrittenRows
from dxlwire.bus.session import OpenLine, Session, open_session
from dxlwire.exceptions import ServoError
from dxlwire.exchange.arrays import Floats

RATE = 57_600  # Factory setting of most servos, bit/s


class Bus:
    """A serial line with servos, opened exclusively; close it, or use it as a context manager.

    Torque stays as it is when the line is closed, unless `limp_at_exit` is true. Threads may share a bus:
    each call holds a lock."""

    def __init__(
        self, port: str, baud_rate: int = RATE, protocol: float = 2.0, *, limp_at_exit: bool = False
    ) -> None:
        """Open a line.

        Args:
            port: Device: `/dev/ttyUSB0`.
            baud_rate: bit/s.
            protocol: 1.0 or 2.0.
            limp_at_exit: Switch torque off on all servos of this bus that were used, before it is closed.

        Raises:
            PortError: The port cannot be opened, or the adapter does not support the baud rate.
            ValueError: The protocol is unknown.
        """
        self._session = open_session(port, baud_rate, protocol)
        self._limp_at_exit = limp_at_exit
        self._groups: list[ServoGroup] = []

    @classmethod
    def on_session(cls, session: Session, *, limp_at_exit: bool = False) -> Bus:
        """Return a bus on a line that is open already, such as a simulated one on virtual time."""
        bus = cls.__new__(cls)
        bus._session, bus._limp_at_exit, bus._groups = session, limp_at_exit, []
        return bus

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the line; with `limp_at_exit` switch torque off first.

        Raises:
            ServoError: A servo did not confirm that its torque is off.
        """
        groups, self._groups = self._groups, []
        failures: Failures = {}
        try:
            for group in groups if self._limp_at_exit else ():
                failures |= self._session.run_program(group.switch_all(False))
        finally:
            self._session.close()
        if failures:
            raise ServoError(self._session.name, failures)

    def reopen(self) -> None:
        """Open the line again after its adapter was unplugged; servos, readers and writers stay usable.

        The servos may have had no power, so read them before they move. Does nothing if the line is not lost.

        Raises:
            PortError: The adapter is still missing, or the bus is closed.
        """
        self._session.reopen_line()

    def record(self, path: str | os.PathLike[str]) -> None:
        """Record all packets from now on in a new log, which `dxlrun analyze` reads.

        Raises:
            InputError: The file exists or cannot be written.
            ValueError: A reader or writer exists already.
        """
        self._session.record(Path(path))

    def scan(self, ids: Iterable[int] | None = None) -> ServoSet:
        """Find the servos that answer at this baud rate, in the order of their IDs; None: all IDs.

        Raises:
            ServoError: A servo has an unknown model.
        """
        session = self._session
        looked_for = range(session.line.dialect.HIGHEST_ID + 1) if ids is None else ids
        with session.lock:
            answered = session.log.answered
            there = session.run_program(find_ids(session.line, list(looked_for), answered))
            return self._use(session.run_program(identify(session.line, dict.fromkeys(there))))

    def servos(self, models: Mapping[int, str]) -> ServoSet:
        """Return servos by ID and model; each one is asked for its model and firmware.

        Raises:
            ServoError: A servo does not answer, or has another model.
            LookupError: A model is unknown.
        """
        return self._use(self._session.run_program(named_servos(self._session, models)))

    def _use(self, found: tuple[list[Addressed], Failures]) -> ServoSet:
        group = found_group(self._session, found)
        self._groups.append(group)
        return ServoSet(group)


class ServoSet:
    """Servos of one bus. Values are arrays with one element for each servo, in the order of `ids`.

    `servos[1]` and `servos[[1, 2]]` are sets of some of them; iteration yields the IDs."""

    __slots__ = ("_group", "_session")  # A misspelled `torque` must not become a new attribute

    def __init__(self, group: ServoGroup) -> None:
        self._group = group
        self._session = group.session

    @property
    def ids(self) -> tuple[int, ...]:
        """IDs of the servos."""
        return self._group.ids

    @property
    def models(self) -> tuple[str, ...]:
        """Models of the servos."""
        return self._group.models

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, ids: int | Sequence[int]) -> ServoSet:
        return ServoSet(self._group.part(ids))

    def __iter__(self) -> Iterator[int]:
        return iter(self.ids)

    def __repr__(self) -> str:
        return f"ServoSet({dict(zip(self.ids, self.models, strict=True))})"

    def read(self, item: str, *, raw: bool = False) -> Floats:
        """Read an item of every servo once.

        Args:
            item: Name in the control table: `present_temperature`.
            raw: Integers of the wire instead of SI units.

        Raises:
            ServoError: Servos did not answer, three times each.
            LookupError: A model has no such item.
        """
        values, failures = self._session.run_program(self._group.read_values(item, raw=raw))
        self._group.raise_failures(failures)
        return values

    def write(self, item: str, value: Values, *, raw: bool = False) -> None:
        """Write an item of every servo once, acknowledged by each. An EEPROM item is written only if it
        differs, and only while torque is off.

        Args:
            item: Name in the control table: `operating_mode`.
            value: One for all servos, or one for each; the operating mode has names: `position`.
            raw: The values are integers of the wire instead of SI units.

        Raises:
            ServoError: Servos did not answer, refused, or have torque.
            ValueError: A value is outside the range of the item.
            LookupError: A model has no such item.
        """
        self._group.raise_failures(self._session.run_program(self._group.write_values(item, value, raw=raw)))

    @property
    def torque(self) -> NDArray[np.bool_]:
        """True for each servo that has torque; read from the servos. Set it to switch torque.

        The value is one for all servos, or one for each. Before torque is switched on, the goal of each
        servo becomes its present position."""
        return self.read("torque_enable").astype(np.bool_)

    @torque.setter
    def torque(self, on: Switch) -> None:
        self._group.raise_failures(self._session.run_program(self._group.switch_all(on)))

    def reader(self, *items: str, raw: bool = False) -> ServoReader:
        """Prepare to read items again and again, by the fastest instruction that all servos have.

        Raises:
            LookupError: A model has no such item.
        """
        with self._session.lock:
            reading = self._group.make_reading(items, raw=raw)
            return ServoReader(self._session, reading)

    def writer(self, *items: str, raw: bool = False) -> ServoWriter:
        """Prepare to write items in RAM again and again, by sync write.

        Raises:
            LookupError: A model has no such item.
            ValueError: An item is read-only or in the EEPROM.
        """
        with self._session.lock:
            writing = self._group.make_writing(items, raw=raw)
            return ServoWriter(self._session, writing)


class ServoReader:
    """Reads the same items of the same servos in each call."""

    def __init__(self, session: OpenLine, reading: ReadRows) -> None:
        self._reading = reading
        self._lock = session.lock

    def __call__(self) -> ServoStates:
        """Read all items of all servos; a lost reply makes its servo invalid and raises nothing.

        Raises:
            PortError: The line is lost.
        """
        with self._lock:
            self._reading.read_servos()
            return self._reading.newest_state()

    @property
    def instructions(self) -> str:
        """Instructions of one call in the e-Manual's words: `fast sync read`."""
        return self._reading.read_by


class ServoWriter:
    """Writes the same items of the same servos in each call."""

    def __init__(self, session: OpenLine, writing: WrittenRows) -> None:
        self._writing = writing
        self._lock = session.lock

    def __call__(self, *values: ArrayLike) -> None:
        """Send the values, one argument for each item: a number for all servos, or one for each. Values are
        limited to the item's range; a servo with a NaN among its values gets nothing.

        No servo acknowledges a sync write.

        Raises:
            ValueError: A value is infinite or None, or the number of values is wrong.
            PortError: The line is lost.
        """
        with self._lock:
            self._writing.send_values(values)
