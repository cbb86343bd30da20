"""Control tables of devices: what is on a servo bus and is no servo, such as an IMU or a power board.

A data file of ours or of a plug-in describes one model, in the form of servo models (see AX-12A.toml) with
`kind = "device"`, and for each item, where they apply: `encoding` may be float32, `offset` (with its unit) is
added to what the ticks mean, `state` is the name of the state that the item makes (that of the item without
it), and `safe` is the integer that is written to the item at the end of a run. `cyclic` lists the items that
are read each cycle where a robot file names none.
"""

from __future__ import annotations

import difflib
import functools
import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

from dxlrun.dynamixel.control_table.sources import Entry, quantity, section, whole, words
from dxlrun.dynamixel.control_table.table import Access, Area

DeviceEncoding = Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
"""As of servos, and IEEE 754's binary32, little-endian."""
CAPABILITIES = frozenset({"bulk_read", "fast_sync_read", "reboot", "sync_read", "sync_write"})
"""What a data file may say that a device can do, in the words of `table.CAPABILITIES`."""
_TABLES = Path(__file__).parent / "tables" / "devices"
_ADDED: list[DeviceTable] = []
"""Tables of plug-ins."""
_SIZES = (1, 2, 4)


@dataclass(frozen=True, slots=True)
class DeviceItem:
    """One control item of a device: 1, 2 or 4 bytes, little-endian; its value is ticks * scale + offset."""

    name: str
    address: int
    size: int
    access: Access
    area: Area
    minimum: int
    """Of the number on the wire; of a float32 0, as is `maximum`: it has no range."""
    maximum: int
    initial: int | None
    """After a reset; None: not documented."""
    encoding: DeviceEncoding
    unit: str
    """SI unit of `scale` and `offset`; empty for flags, counts and numbers."""
    scale: float
    """SI units per tick."""
    offset: float
    """SI units at tick 0."""
    page: str
    """Where the item is documented."""
    state: str
    """Name of the state that it makes: `angular_velocity.x`."""
    safe: int | None = None
    """Number on the wire that is written at the end of a run; None: nothing is."""

    def value(self, data: bytes | memoryview) -> float:
        """Return the value, SI units, of the item's own bytes."""
        return decoded(data, self.encoding) * self.scale + self.offset


@dataclass(frozen=True, slots=True)
class DeviceTable:
    """The control items of one model of devices."""

    model: str
    aliases: tuple[str, ...]
    model_number: int
    protocol: float
    items: Mapping[str, DeviceItem]
    """By name, in the order of addresses."""
    cyclic: tuple[str, ...]
    """Items that are read each cycle where the robot file names none."""
    capabilities: frozenset[str]
    baud_rates: Mapping[int, int]
    """Value of the baud rate item -> bit/s."""
    fast_sync_read_firmware: int | None = None
    """First firmware version with the fast forms; None where the model has none."""

    @property
    def size(self) -> int:
        """Number of bytes from address 0 to the end of the last item."""
        return max(item.address + item.size for item in self.items.values())

    def readable(self, start: int, end: int) -> bool:
        """Check whether the addresses from `start` up to before `end` all belong to items."""
        known = {
            address
            for item in self.items.values()
            for address in range(item.address, item.address + item.size)
        }
        return known.issuperset(range(start, end))


def decoded(data: bytes | memoryview, encoding: DeviceEncoding) -> float:
    """Return the number on the wire; an integer where it is no float32."""
    if encoding == "float32":
        number: float = struct.unpack("<f", data)[0]
        return number
    if encoding == "sign_magnitude":  # bit 10 is the sign, as of servos (e-Manual AX-12A, Present Speed (38))
        raw = int.from_bytes(data, "little")
        return -(raw & 0x3FF) if raw & 0x400 else raw & 0x3FF
    return int.from_bytes(data, "little", signed=encoding == "twos_complement")


def device_table(model: str, protocol: float | None = None) -> DeviceTable:
    """Return the table of a device by its model's name or alias, in any case.

    Raises LookupError when there is none, or none that speaks the protocol.
    """
    found = [table for table in device_tables() if _key(model) in map(_key, (table.model, *table.aliases))]
    if not found:
        names = ", ".join(table.model for table in device_tables()) or "none"
        raise LookupError(f"no control table of the device {model!r}; known devices: {names}")
    for table in found:
        if protocol in (None, table.protocol):
            return table
    raise LookupError(f"{model} speaks Protocol {found[0].protocol}, not Protocol {protocol}")


def device_tables() -> tuple[DeviceTable, ...]:
    """Return the tables of all devices, ours and those of plug-ins."""
    return (*_shipped(), *_ADDED)


def devices_by_number(number: int, protocol: float) -> tuple[DeviceTable, ...]:
    """Return the tables of a model number; none where it is unknown."""
    return tuple(
        table for table in device_tables() if (table.model_number, table.protocol) == (number, protocol)
    )


def perhaps_meant_device(name: str) -> str:
    """Return a hint for a name that no device has."""
    known = {_key(each): each for table in device_tables() for each in (table.model, *table.aliases)}
    meant = difflib.get_close_matches(_key(name), known, n=1)
    return f"did you mean {known[meant[0]]}?" if meant else "`dxlrun models` lists all"


def add_device_table(text: str) -> DeviceTable:
    """Add a plug-in's table, the TOML text of a data file; return it.

    Raises ValueError when the text is none, or when one of its names is taken.
    """
    try:
        table = read_device_table(text)
    except KeyError as error:
        raise ValueError(f"the entry {error} is missing") from error
    names = set(map(_key, (table.model, *table.aliases)))
    for known in device_tables():
        if known == table:
            return known  # a process may load its plug-ins twice
        if known.protocol == table.protocol and names & set(map(_key, (known.model, *known.aliases))):
            raise ValueError(f"{table.model} has a name of the device {known.model}, which is known already")
    _ADDED.append(table)
    return table


def is_device_table(text: str) -> bool:
    """Check whether a data file says that it describes a device."""
    return tomllib.loads(text).get("kind") == "device"


def read_device_table(text: str) -> DeviceTable:
    """Return the table that the TOML text of a data file describes.

    Raises ValueError (also tomllib.TOMLDecodeError) when it is not one, KeyError when an entry is missing.
    """
    return build_device_table(tomllib.loads(text))


def build_device_table(data: Entry) -> DeviceTable:
    """Return the table of a device's entry; raises ValueError and KeyError as `read_device_table`."""
    if data.get("kind") != "device":
        raise ValueError('the table of a device has kind = "device"')
    entries = section(data["items"])
    items = sorted(
        (_item(name, section(entry)) for name, entry in entries.items()), key=lambda one: one.address
    )
    end = 0
    for item in items:
        if item.address < end:
            raise ValueError(f"{item.name}: address {item.address} lies in the item before it")
        end = item.address + item.size
    by_name = {item.name: item for item in items}
    cyclic = tuple(words(data.get("cyclic", [])))
    for name in cyclic:
        if name not in by_name:
            raise ValueError(f"cyclic: {name} is none of the items")
    capabilities = frozenset(words(data.get("capabilities", [])))
    if wrong := capabilities - CAPABILITIES:
        raise ValueError(f"capabilities that a device cannot have: {', '.join(sorted(wrong))}")
    protocol, firmware = data["protocol"], data.get("fast_sync_read_firmware")
    if protocol not in (1.0, 2.0) or not isinstance(protocol, float):
        raise ValueError(f"protocol is 1.0 or 2.0, not {protocol!r}")
    return DeviceTable(
        model=str(data["model"]),
        aliases=tuple(words(data.get("aliases", []))),
        model_number=whole(data, "model_number"),
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


def _item(name: str, entry: Entry) -> DeviceItem:
    def one_of(key: str, known: tuple[str, ...], default: str) -> str:
        word = entry.get(key, default)
        if word not in known or not isinstance(word, str):
            raise ValueError(f"{name}: {key} is none of {', '.join(known)}")
        return word

    size, encoding = whole(entry, "size"), one_of("encoding", get_args(DeviceEncoding), "unsigned")
    if size not in _SIZES or (encoding == "float32" and size != 4):
        raise ValueError(f"{name}: an item has 1, 2 or 4 bytes, a float32 4, not {size}")
    lowest, highest = _range(encoding, size)
    minimum = whole(entry, "minimum") if "minimum" in entry else lowest
    maximum = whole(entry, "maximum") if "maximum" in entry else highest
    if not lowest <= minimum <= maximum <= highest:
        raise ValueError(f"{name}: {minimum}..{maximum} does not fit into its bytes")
    unit, scale = ("", 1.0) if "tick" not in entry else quantity(str(entry["tick"]))
    offset_unit, offset = (unit, 0.0) if "offset" not in entry else quantity(str(entry["offset"]))
    if offset_unit != unit:
        raise ValueError(f"{name}: its offset is in {offset_unit or 'no unit'}, its tick in {unit or 'none'}")
    return DeviceItem(
        name=name,
        address=whole(entry, "address"),
        size=size,
        access="R" if one_of("access", get_args(Access), "R") == "R" else "RW",
        area="EEPROM" if one_of("area", get_args(Area), "RAM") == "EEPROM" else "RAM",
        minimum=minimum,
        maximum=maximum,
        initial=whole(entry, "initial") if "initial" in entry else None,
        encoding=_encoding(encoding),
        unit=unit,
        scale=scale,
        offset=offset,
        page=str(entry.get("page", "")),
        state=str(entry.get("state", name)),
        safe=whole(entry, "safe") if "safe" in entry else None,
    )


def _range(encoding: str, size: int) -> tuple[int, int]:
    """Return the lowest and the highest number on the wire."""
    if encoding == "float32":
        return 0, 0
    if encoding == "sign_magnitude":
        return -0x3FF, 0x3FF
    bits = 8 * size
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if encoding == "twos_complement" else (0, (1 << bits) - 1)


def _encoding(word: str) -> DeviceEncoding:
    match word:
        case "unsigned" | "sign_magnitude" | "twos_complement" | "float32":
            return word
    raise ValueError(f"{word} is no encoding")


def _key(name: str) -> str:
    """Return a name without case and punctuation."""
    return "".join(filter(str.isalnum, name.upper()))


@functools.cache
def _shipped() -> tuple[DeviceTable, ...]:
    return tuple(read_device_table(path.read_text("utf-8")) for path in sorted(_TABLES.glob("*.toml")))
