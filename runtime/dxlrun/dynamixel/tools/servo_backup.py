"""Servo backup: a file with all writable registers of a servo, its model, ID and rate. Selects the registers
to restore.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec

from dxlrun.errors import InputError
from dxlrun.output.target import write_target
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import ControlTable

FORMAT: Literal["dxlrun servo backup 1"] = "dxlrun servo backup 1"
_ADDRESSED = ("id", "secondary_id", "secondary_shadow_id", "baud_rate", "baud_rate_bus", "protocol_type")
_MOMENTARY = frozenset(
    ("torque_enable", "bus_watchdog", "lock", "hybrid_save", "moving_speed", "registered_instruction")
)
_MODES = ("operating_mode", "control_mode")
"""Mode registers, which are restored before gains and profile, because a mode resets these."""
_LAST = "status_return_level"  # restored last, because a servo may not answer reads afterwards


class ServoBackup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a backup file of one servo."""

    format: Literal["dxlrun servo backup 1"]
    model: str
    model_number: int
    firmware: int
    protocol: float
    id: int
    baud_rate: int  # bit/s
    registers: dict[str, int]  # by name, in the order of addresses; integers on the wire


def kept_items(table: ControlTable) -> tuple[str, ...]:
    """Return the names of the items that a backup of a model contains: every writable item except indirect
    data.
    """
    return tuple(
        item.name
        for item in table.items.values()
        if item.access == "RW" and not item.name.startswith("indirect_data_")
    )


def write_backup(path: Path, backup: ServoBackup) -> None:
    """Write a backup to a new file; raise InputError if the file exists already or cannot be written."""
    text = msgspec.json.format(msgspec.json.encode(backup), indent=2) + b"\n"
    write_target(path, text)


def read_backup(path: Path) -> ServoBackup:
    """Read a backup file; raise InputError if it cannot be read or is not a backup."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=ServoBackup)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the path") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # also bytes that are not UTF-8
        raise InputError(
            f"{path} is not a backup of a servo: {error}; `dxlrun servo backup` writes one"
        ) from None


def registers_to_restore(path: Path, backup: ServoBackup, table: ControlTable) -> tuple[RegisterValue, ...]:
    """Return the registers of a backup file that are written to a servo, EEPROM first. ID, rate, goals and
    torque are omitted.

    Raises:
        InputError: Registers do not fit the model; a sentence for each.
    """
    wrong: list[str] = []
    if (backup.model_number, backup.protocol) != (table.model_number, table.protocol):
        raise InputError(
            f"{path} is a backup of {backup.model}, Protocol {backup.protocol}, not of {table.model}, "
            f"Protocol {table.protocol}; give a backup of the same model"
        )
    found: list[RegisterValue] = []
    for name, value in backup.registers.items():
        item = table.items.get(name)
        if item is None or item.access != "RW":
            wrong.append(f"{path}: a {table.model} has no writable register {name}; remove it")
        elif _stays(name):
            continue
        elif not item.minimum <= value <= item.maximum and value != item.initial:
            wrong.append(f"{path}: {name} is {value}, not in {item.minimum}..{item.maximum}; correct it")
        else:
            found.append(RegisterValue(item.address, item.size, value, name, item.area == "EEPROM"))
    if wrong:
        raise InputError("\n".join(wrong))
    return tuple(sorted(found, key=_order))


def stamped(
    table: ControlTable, firmware: int, address: tuple[int, int], values: Mapping[str, int]
) -> ServoBackup:
    """Return the content of a backup file for a servo; `address` is its ID and its rate, bit/s."""
    servo_id, rate = address
    number, protocol = table.model_number, table.protocol
    return ServoBackup(FORMAT, table.model, number, firmware, protocol, servo_id, rate, dict(values))


def _order(one: RegisterValue) -> tuple[bool, bool, bool, int]:
    return one.name == _LAST, one.name not in _MODES, not one.eeprom, one.address


def _stays(name: str) -> bool:
    return name in _ADDRESSED or name in _MOMENTARY or name.startswith(("goal_", "indirect_data_"))
