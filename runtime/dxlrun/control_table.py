"""Control tables: what stands where in a servo's memory, in which unit; one data file a model."""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

Access = Literal["R", "RW"]
Area = Literal["EEPROM", "RAM"]
Encoding = Literal["unsigned", "sign_magnitude", "twos_complement"]

SIGN_BIT = 10
"""Direction bit of sign-magnitude items: 0 counter-clockwise, 1 clockwise (e-Manual, Present Speed (38))."""

_FOLDER = Path(__file__).parent / "control_tables"
_SI = {
    "deg": ("rad", math.pi / 180),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "us": ("s", 1e-6),
    "V": ("V", 1.0),
    "Nm": ("Nm", 1.0),
    "degC": ("degC", 1.0),
    "fraction": ("1", 1.0),
}


@dataclass(frozen=True, slots=True)
class ControlItem:
    """One control item: an integer of 1, 2 or 4 bytes, little-endian, and what it means."""

    name: str
    address: int
    size: int
    access: Access
    area: Area
    minimum: int
    """Of the integer on the wire, as the e-Manual gives it: a direction bit counts as a bit."""
    maximum: int
    initial: int | None
    """Value of the integer on the wire after a factory reset or at power-up; None: the manual gives none."""
    encoding: Encoding
    unit: str
    """SI unit of `scale`; empty for flags, numbers and steps; `1` for a fraction of the maximum."""
    scale: float
    """SI units per tick."""
    page: str
    """Section of the manual's page of this model."""

    def encode(self, raw: int) -> bytes:
        """Return the bytes of a signed number of ticks; raises ValueError when they do not hold it."""
        wire = raw
        if self.encoding == "sign_magnitude":
            if abs(raw) >= 1 << SIGN_BIT:
                raise ValueError(f"{self.name}: {raw} does not fit into {SIGN_BIT} bits and a direction")
            wire = abs(raw) | (raw < 0) << SIGN_BIT
        try:
            return wire.to_bytes(self.size, "little", signed=self.encoding == "twos_complement")
        except OverflowError:
            raise ValueError(f"{self.name}: {raw} does not fit into {self.size} bytes") from None

    def decode(self, data: bytes | bytearray | memoryview) -> int:
        """Return the signed number of ticks; raises ValueError when `data` has not `size` bytes."""
        if len(data) != self.size:
            raise ValueError(f"{self.name}: {self.size} bytes are needed, {len(data)} were given")
        wire = int.from_bytes(data, "little", signed=self.encoding == "twos_complement")
        if self.encoding == "sign_magnitude":
            magnitude = wire & ((1 << SIGN_BIT) - 1)
            return -magnitude if wire >> SIGN_BIT & 1 else magnitude
        return wire


@dataclass(frozen=True, slots=True)
class ControlTable:
    """The control items of one model, and its exact units."""

    model: str
    """The model's own name, also when it was asked for by another one."""
    aliases: tuple[str, ...]
    """Names of models with the same table."""
    model_number: int
    protocol: float
    items: Mapping[str, ControlItem]
    """By the e-Manual's name in snake_case, in the order of addresses."""
    baud_rates: Mapping[int, int]
    """Value of the baud rate item -> bit/s."""
    rad_per_tick: float
    max_tick: int
    """Highest value of goal and present position; the reach is `max_tick * rad_per_tick`."""
    rad_s_per_tick: float
    max_speed_tick: int
    """Highest value of a speed without its direction."""
    effort_per_tick: float
    """Fraction of the maximum per tick of present load."""
    max_speed: float
    """No-load speed, rad/s, at the voltage that the data file names."""
    stall_torque: float
    """Nm, at the voltage that the data file names."""

    @property
    def size(self) -> int:
        """Number of bytes from address 0 to the end of the last item."""
        return max(item.address + item.size for item in self.items.values())


def control_table(model: str) -> ControlTable:
    """Return the control table of a model or of one of its aliases; raises LookupError when it is unknown."""
    try:
        return _tables()[model]
    except KeyError:
        known = ", ".join(sorted(_tables()))
        raise LookupError(f"no control table of the model {model!r}; known models: {known}") from None


def model_names() -> tuple[str, ...]:
    """Return every name that `control_table` knows, aliases too, sorted."""
    return tuple(sorted(_tables()))


@functools.cache
def _tables() -> Mapping[str, ControlTable]:
    tables: dict[str, ControlTable] = {}
    for path in sorted(_FOLDER.glob("*.toml")):
        table = read_control_table(path.read_text(encoding="utf-8"))
        for name in (table.model, *table.aliases):
            if name in tables:
                raise ValueError(f"{path.name}: the model {name!r} stands in two control tables")
            tables[name] = table
    return MappingProxyType(tables)


def read_control_table(text: str) -> ControlTable:
    """Return the control table that the TOML text of a data file describes.

    Raises ValueError (also tomllib.TOMLDecodeError) when it is not one, KeyError when an entry is missing.
    """
    data = tomllib.loads(text)
    items = tuple(_item(name, entry) for name, entry in data["items"].items())
    _check(items)
    by_name = {item.name: item for item in items}
    position, speed, load = by_name["goal_position"], by_name["present_speed"], by_name["present_load"]
    return ControlTable(
        model=data["model"],
        aliases=tuple(data["aliases"]),
        model_number=data["model_number"],
        protocol=data["protocol"],
        items=MappingProxyType(by_name),
        baud_rates=MappingProxyType({int(value): rate for value, rate in data["baud_rates"].items()}),
        rad_per_tick=position.scale,
        max_tick=position.maximum,
        rad_s_per_tick=speed.scale,
        max_speed_tick=(1 << SIGN_BIT) - 1,
        effort_per_tick=load.scale,
        max_speed=_quantity(data["no_load_speed"])[1],
        stall_torque=_quantity(data["stall_torque"])[1],
    )


def _item(name: str, entry: Mapping[str, object]) -> ControlItem:
    def number(key: str) -> int:
        value = entry[key]
        if type(value) is not int:
            raise ValueError(f"{name}: {key} is not a whole number")
        return value

    def word(key: str, words: tuple[str, ...]) -> str:
        value = entry[key]
        if value not in words or not isinstance(value, str):
            raise ValueError(f"{name}: {key} is none of {', '.join(words)}")
        return value

    tick = entry.get("tick")
    unit, scale = ("", 1.0) if tick is None else _quantity(str(tick))
    return ControlItem(
        name=name,
        address=number("address"),
        size=number("size"),
        access="R" if word("access", get_args(Access)) == "R" else "RW",
        area="RAM" if word("area", get_args(Area)) == "RAM" else "EEPROM",
        minimum=number("minimum"),
        maximum=number("maximum"),
        initial=number("initial") if "initial" in entry else None,
        encoding=_encoding(word("encoding", get_args(Encoding))),
        unit=unit,
        scale=scale,
        page=str(entry["page"]),
    )


def _encoding(word: str) -> Encoding:
    if word == "sign_magnitude":
        return "sign_magnitude"
    return "unsigned" if word == "unsigned" else "twos_complement"


def _quantity(text: str) -> tuple[str, float]:
    """Return SI unit and value of `59 rpm` or `300/1023 deg`: the manual's ratio, rounded only once."""
    number, _, unit = text.partition(" ")
    if unit not in _SI:
        raise ValueError(f"{text!r}: the unit is none of {', '.join(_SI)}")
    numerator, _, denominator = number.partition("/")
    si, factor = _SI[unit]
    return si, float(numerator) * factor / float(denominator or "1")


def _check(items: tuple[ControlItem, ...]) -> None:
    end = 0
    for item in items:
        if item.address < end:
            raise ValueError(f"{item.name}: address {item.address} lies in the item before it")
        if item.size not in (1, 2, 4):
            raise ValueError(f"{item.name}: an item has 1, 2 or 4 bytes, not {item.size}")
        if not item.minimum <= item.maximum < 1 << 8 * item.size:
            raise ValueError(f"{item.name}: {item.minimum}..{item.maximum} does not fit into its bytes")
        if item.initial is not None and not item.minimum <= item.initial <= item.maximum:
            raise ValueError(f"{item.name}: the initial value {item.initial} lies outside its range")
        end = item.address + item.size
