"""Control tables of devices: units on a servo bus that are not servos, such as an IMU or a power board.

A data file, shipped or from a plug-in, describes one model. It has the form of servo models (see AX-12A.toml)
with `kind = "device"`. `cyclic` lists the items that are read in each cycle if a robot file names none.
`units` lists additional units. Model number, firmware version and ID have the addresses of servos, unless the
file says otherwise. Without a `model_number` the number of the device is not checked.

Additional keys of an item:

- `encoding` may be float32.
- `offset` (with its unit) is added to ticks * scale.
- `state` is the name of the item's state (default: the name of the item).
- `bit` is the index of a single bit, such as a button; other items have the other bits.
- `safe` is the integer that is written to the item at the end of a run.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

from msgspec.structs import replace

from dxlwire.control_table.control_items import CAPABILITIES as SERVO_CAPABILITIES
from dxlwire.control_table.control_items import BaseControlTable, ControlItem
from dxlwire.control_table.table_files import (
    Entry,
    parse_quantity,
    protocol_in,
    read_item,
    section,
    whole,
    words,
)

WAITS = "waits_in_chain"
"""Capability of a board that must be read alone: in a chain of replies after a missing servo it would
never answer again (protocol.md)."""
CAPABILITIES: Mapping[str, str] = {
    **{
        name: SERVO_CAPABILITIES[name]
        for name in ("bulk_read", "bulk_write", "fast_sync_read", "reboot", "sync_read", "sync_write")
    },
    "broadcast_ping": "a reply to a ping to all IDs",
    WAITS: "no reply in a sync or bulk read after a device that does not reply",
}
"""Words that a device's data file may list under `capabilities`, with their meaning. Every device supports
ping, read and write."""
_SIZES = (1, 2, 4)
_HIGHEST_ADDRESS = 0xFFFF - 4
_MODEL_NUMBER = (0, 2)  # Address and size from which a model number is read before the model is known
_IDENTITY: Mapping[float, Mapping[str, Entry]] = {
    protocol: {
        "model_number": {"address": 0, "size": 2, "area": "EEPROM", "page": "Model Number (0)"},
        "firmware_version": {"address": firmware, "size": 1, "area": "EEPROM", "page": "Firmware Version"},
        "id": {
            "address": servo_id,
            "size": 1,
            "access": "RW",
            "area": "EEPROM",
            "maximum": highest,
            "page": "ID",
        },
    }
    for protocol, firmware, servo_id, highest in ((1.0, 2, 3, 253), (2.0, 6, 7, 252))
}
STATE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*", re.ASCII)
"""Pattern that the names of device states must match, such as `angular_velocity.x`."""


_KEYS = {*ControlItem.__struct_fields__, "tick"} - {"name", "unit", "scale", "firmware", "deviation"}


class DeviceTable(BaseControlTable, frozen=True, kw_only=True):
    """Control table of one device model."""

    model_number: int | None
    """Model number; None if the device reports any number or none. It is then not checked, and a scan
    cannot identify the device."""
    cyclic: tuple[str, ...]  # Items that are read in each cycle if the robot file names none
    fast_sync_read_firmware: int | None = None
    """First firmware version that supports fast sync and bulk read; None if the model does not."""
    text: str = ""  # Text of the data file, for processes that do not read it; empty for a shipped file


def is_device_table(text: str) -> bool:
    """Return True if the TOML text of a data file describes a device instead of a servo."""
    return tomllib.loads(text).get("kind") == "device"


def read_device_table(text: str) -> DeviceTable:
    """Return the control table of a device from the TOML text of its data file.

    Raises:
        ValueError: The text is not a device table (also tomllib.TOMLDecodeError).
        KeyError: An entry is missing.
    """
    return build_device_table(tomllib.loads(text))


def build_device_table(data: Entry) -> DeviceTable:
    """Return the control table of a device from its parsed data file; raises as `read_device_table`."""
    if data.get("kind") != "device":
        raise ValueError('kind must be "device"')
    written = section(data["items"])
    protocol, firmware = protocol_in(data["protocol"]), data.get("fast_sync_read_firmware")
    entries = _with_identity(written, protocol)
    units = words(data.get("units", []))
    items = sorted(
        (_item(name, section(entry), units) for name, entry in entries.items()), key=lambda one: one.address
    )
    _check_places(items)
    by_name = {item.name: item for item in items}
    cyclic = tuple(words(data.get("cyclic", [])))
    for name in cyclic:
        if name not in by_name:
            raise ValueError(f"cyclic: unknown item {name}")
    capabilities = frozenset(words(data.get("capabilities", [])))
    if wrong := capabilities - CAPABILITIES.keys():
        raise ValueError(f"capabilities not allowed for a device: {', '.join(sorted(wrong))}")
    if "model_number" in data and _place(by_name["model_number"]) != _MODEL_NUMBER:
        raise ValueError("model_number: a checked model number must be at address 0 with 2 bytes")
    return DeviceTable(
        model=str(data["model"]),
        aliases=tuple(words(data.get("aliases", []))),
        model_number=whole(data, "model_number") if "model_number" in data else None,
        protocol=protocol,
        items=MappingProxyType(by_name),
        cyclic=cyclic,
        capabilities=capabilities,
        baud_rates=MappingProxyType(
            {
                int(code): whole({"rate": rate}, "rate")
                for code, rate in section(data.get("baud_rates", {})).items()
            }
        ),
        fast_sync_read_firmware=firmware if isinstance(firmware, int) else None,
    )


def _with_identity(entries: Entry, protocol: float) -> Entry:
    """Add the items that every device has, unless the file has them, at the addresses that servos of its
    protocol use.

    e-Manual, Protocol 1.0 and 2.0 models, Control Table: Model Number, Firmware Version, ID."""
    places = _IDENTITY[protocol]
    return {**{name: entry for name, entry in places.items() if name not in entries}, **entries}


def _check_places(items: Sequence[ControlItem]) -> None:
    """Raise ValueError if items overlap, except different bits of the same bytes. Items are sorted by
    address."""
    for before, item in pairwise(items):
        if item.address >= before.address + before.size:
            continue
        if before.bit is None or item.bit is None or _place(before) != _place(item):
            raise ValueError(
                f"{item.name}: address {item.address} overlaps {before.name} (only bits may share an address)"
            )
        if any(each.bit == item.bit for each in items if each is not item and _place(each) == _place(item)):
            raise ValueError(f"{item.name}: bit {item.bit} of address {item.address} is defined twice")


def _place(item: ControlItem) -> tuple[int, int]:
    return item.address, item.size


def _item(name: str, entry: Entry, units: Collection[str]) -> ControlItem:
    if wrong := entry.keys() - _KEYS:
        raise ValueError(f"{name}: keys not allowed in an item of a device: {', '.join(sorted(wrong))}")
    unit, offset = parse_quantity(name, entry, "offset", units) if "offset" in entry else ("", 0.0)
    defaults = {"access": "R", "area": "RAM", "encoding": "unsigned", "page": "", "state": name}
    ends = {key: entry.get(key, 0) for key in ("minimum", "maximum")}
    item = read_item(name, {**defaults, **ends, **entry, "offset": offset}, units)
    if item.size not in _SIZES or (item.encoding == "float32" and item.size != 4):
        raise ValueError(f"{name}: the size must be 1, 2 or 4 (float32: 4), not {item.size}")
    if item.encoding == "float32" and entry.keys() & {"minimum", "maximum"}:
        raise ValueError(f"{name}: a float32 cannot have minimum and maximum")
    lowest, highest = _range(item.encoding, item.size)
    item = replace(
        item,
        minimum=item.minimum if "minimum" in entry else lowest,
        maximum=item.maximum if "maximum" in entry else highest,
    )
    if not lowest <= item.minimum <= item.maximum <= highest:
        raise ValueError(f"{name}: {item.minimum}..{item.maximum} does not fit into its bytes")
    if "offset" in entry and unit != item.unit:
        raise ValueError(
            f"{name}: offset and tick have different units, {unit or 'none'} and {item.unit or 'none'}"
        )
    _check_item(item)
    return item


def _check_item(item: ControlItem) -> None:
    if not 0 <= item.address <= _HIGHEST_ADDRESS:
        raise ValueError(f"{item.name}: the address must be 0..{_HIGHEST_ADDRESS}, not {item.address}")
    for key, value in (("initial value", item.initial), ("safe value", item.safe)):
        if value is not None and not item.minimum <= value <= item.maximum:
            raise ValueError(f"{item.name}: the {key} {value} is outside its range")
    if item.safe is not None and (item.access == "R" or item.area == "EEPROM"):
        raise ValueError(f"{item.name}: a safe value needs a writable item in RAM")
    if item.encoding == "float32" and (item.initial or item.safe):
        raise ValueError(f"{item.name}: initial and safe value of a float32 must be 0")
    if item.state == "age":
        raise ValueError(f"{item.name}: the state name `age` is reserved")
    if item.scale == 0:
        raise ValueError(f"{item.name}: the tick must not be 0")
    if not STATE_NAME.fullmatch(item.state):
        raise ValueError(
            f"{item.name}: {item.state!r} is not a state name (letters, digits and _ after a letter, "
            "such as angular_velocity.x)"
        )
    if item.bit is None:
        return
    if not 0 <= item.bit < 8 * item.size:
        raise ValueError(f"{item.name}: the bit must be 0..{8 * item.size - 1}, not {item.bit}")
    if item.access != "R" or item.unit or item.encoding != "unsigned":
        raise ValueError(f"{item.name}: a bit must be unsigned, read-only and without unit")


def _range(encoding: str, size: int) -> tuple[int, int]:
    if encoding == "float32":
        return 0, (1 << 32) - 1
    if encoding == "sign_magnitude":
        return -0x3FF, 0x3FF
    bits = 8 * size
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if encoding == "twos_complement" else (0, (1 << bits) - 1)
