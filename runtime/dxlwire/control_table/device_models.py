"""Device models: finds the control table of a device by name or number, among shipped data files and those
of plug-ins."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path

from msgspec.structs import replace

from dxlwire.control_table.device_table import (
    DeviceTable,
    read_device_table,
)
from dxlwire.control_table.servo_models import beginning_or_near, models_by_number, protocols_of

_TABLES = Path(__file__).parent / "tables" / "devices"
_ADDED: list[DeviceTable] = []  # Tables of plug-ins


def device_table(model: str, protocol: float | None = None) -> DeviceTable:
    """Return the control table of a device model by its name or alias; case and punctuation are ignored.

    Raises:
        LookupError: No device has the name, or none of them speaks the protocol.
    """
    found = [table for table in device_tables() if _key(model) in map(_key, (table.model, *table.aliases))]
    if not found:
        names = ", ".join(table.model for table in device_tables()) or "none"
        raise LookupError(f"no control table for the device {model!r}; known devices: {names}")
    for table in found:
        if protocol in (None, table.protocol):
            return table
    raise LookupError(f"{model} uses Protocol {found[0].protocol}, not Protocol {protocol}")


def device_tables() -> tuple[DeviceTable, ...]:
    """Return the control tables of all device models, shipped ones first, then those of plug-ins."""
    return (*_shipped(), *_ADDED)


def devices_by_number(number: int, protocol: float) -> tuple[DeviceTable, ...]:
    """Return the control tables of devices with this model number; empty if the number is unknown."""
    return tuple(
        table for table in device_tables() if (table.model_number, table.protocol) == (number, protocol)
    )


def perhaps_meant_device(name: str) -> str:
    """Return a hint for an unknown device model name, such as `did you mean ...?`."""
    known = (each for table in device_tables() for each in (table.model, *table.aliases))
    return beginning_or_near(name, known)


def add_device_table(text: str) -> DeviceTable:
    """Register a device model from a plug-in, and return its table.

    Args:
        text: TOML text of a data file.

    Raises:
        ValueError: The text is not a device table, or one of its names is taken.
    """
    try:
        table = read_device_table(text)
    except KeyError as error:
        raise ValueError(f"the entry {error} is missing") from error
    for known in device_tables():
        if replace(known, text="") == table:
            return known  # A process may load its plug-ins twice
    _refuse_twins(table, device_tables())
    table = replace(table, text=text)
    _ADDED.append(table)
    return table


def _key(name: str) -> str:
    return "".join(filter(str.isalnum, name.upper()))


def _refuse_twins(table: DeviceTable, known: Iterable[DeviceTable]) -> None:
    """Raise ValueError if a known servo or device model has one of the table's names or its model number."""
    names = (table.model, *table.aliases)
    keys = set(map(_key, names))
    for each in known:
        if keys & set(map(_key, (each.model, *each.aliases))):
            raise ValueError(f"a name of {table.model} is already used by the device {each.model}")
        if table.model_number is not None and _number(table) == _number(each):
            raise ValueError(
                f"model number {table.model_number} of {table.model} is already used by the device "
                f"{each.model}"
            )
    for name in names:
        if protocols_of(name):
            raise ValueError(f"{name} is already the name of a servo model")
    if table.model_number is not None:
        for servo in models_by_number(table.model_number, table.protocol):
            raise ValueError(
                f"model number {table.model_number} of {table.model} is already used by the servo "
                f"{servo.model}"
            )


def _number(table: DeviceTable) -> tuple[int | None, float]:
    return table.model_number, table.protocol


@functools.cache
def _shipped() -> tuple[DeviceTable, ...]:
    return tuple(read_device_table(path.read_text("utf-8")) for path in sorted(_TABLES.glob("*.toml")))
