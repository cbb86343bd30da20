"""Sources: reads the TOML data files of servo models and builds control tables from them."""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias, get_args, get_type_hints

import msgspec

from dxlwire.control_table.control_items import (
    CAPABILITIES,
    DERIVED,
    SIGN_BIT,
    ControlItem,
    ControlTable,
    EffortUnit,
    derived_capabilities,
)
from dxlwire.control_table.deviation import deviation_of
from dxlwire.control_table.hardware_errors import STATUS_BYTE, HardwareErrors, error_item

Entry: TypeAlias = Mapping[str, object]  # One table of a data file: an item, or a whole model


class Listing(msgspec.Struct, frozen=True):
    """One servo model whose control table is built on the first call of `build`."""

    names: tuple[str, ...]  # The model's own name first
    model_number: int
    firmware: int
    build: Callable[[], ControlTable]
    """Returns the control table, the same object at each call. Raises ValueError or KeyError if its data
    file is invalid."""


_SI = {
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "rad/s": ("rad/s", 1.0),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "rpm2": ("rad/s^2", 2 * math.pi / 3600),
    "deg/s": ("rad/s", math.pi / 180),
    "deg/s2": ("rad/s^2", math.pi / 180),
    "us": ("s", 1e-6),
    "ms": ("s", 1e-3),
    "V": ("V", 1.0),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "Nm": ("Nm", 1.0),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "Pa": ("Pa", 1.0),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "m/s2": ("m/s^2", 1.0),
    "g": ("m/s^2", 9.80665),
    "degC": ("degC", 1.0),
    "fraction": ("1", 1.0),
}
"""SI unit and factor for each unit of a data file; `rpm2` is revolutions per minute per minute, `g` is
standard gravity (3rd CGPM, 1901)."""


_TABLES = Path(__file__).parent / "tables"
"""Folder of the shipped data files: one folder per protocol, with subfolders for large series; one TOML
file per model."""


def listings(protocol: float) -> tuple[Listing, ...]:
    """Return the models of all shipped data files of a protocol; their control tables are built on demand.

    Raises:
        ValueError: A data file is invalid.
        KeyError: A data file lacks an entry.
    """
    folder = _TABLES / f"protocol{protocol:.0f}"
    texts = {
        path.stem: path.read_text("utf-8")
        for path in sorted(folder.rglob("*.toml"), key=lambda path: path.stem)
    }
    # Only the keys before the first table are parsed here: a process needs few of the models.
    heads = {name: tomllib.loads(text.partition("\n[")[0]) for name, text in texts.items()}
    # Several models extend one file.
    parsed = functools.cache(lambda name: tomllib.loads(texts[name]))
    return tuple(_listing(name, heads, parsed) for name in texts)


def _listing(name: str, heads: Mapping[str, Entry], parsed: Callable[[str], Entry]) -> Listing:
    """Return one model from the keys at the start of its files. Whole files are parsed when the table is
    built."""
    chain = _chain(name, heads)
    head: dict[str, object] = {}
    for each in reversed(chain):
        head |= heads[each]
    return Listing(
        names=(str(head["model"]), *words(heads[name].get("aliases", []))),
        model_number=whole(head, "model_number"),
        firmware=whole(head, "firmware") if "firmware" in head else 0,
        build=functools.cache(lambda: build_table(resolve(name, {each: parsed(each) for each in chain}))),
    )


def _chain(name: str, entries: Mapping[str, Entry]) -> list[str]:
    """Return the names of a model's file and of the files that it extends directly or indirectly, in that
    order."""
    chain = [name]
    while (parent := entries[chain[-1]].get("extends")) is not None:
        if not isinstance(parent, str) or parent not in entries or parent in chain:
            raise ValueError(f"{chain[-1]}: extends = {parent!r} is not another control table")
        chain.append(parent)
    return chain


def resolve(name: str, entries: Mapping[str, Entry]) -> Entry:
    """Return the data of a model, merged with the data files that it `extends`.

    Items are merged key by key. `left_out` names items that the model does not have. Baud rates are
    inherited as a whole, aliases not at all.

    Raises:
        ValueError: The chain of `extends` ends at an unknown model or is circular.
        KeyError: `left_out` names an unknown item.
    """
    merged: dict[str, object] = {}
    items: dict[str, dict[str, object]] = {}
    for each in reversed(_chain(name, entries)):
        entry = entries[each]
        for left_out in words(entry.get("left_out", [])):
            del items[left_out]
        for item, new in section(entry.get("items", {})).items():
            items.setdefault(item, {}).update(section(new))
        merged.update(entry)
    in_order = sorted(items.items(), key=lambda pair: whole(pair[1], "address"))
    return {**merged, "aliases": entries[name].get("aliases", []), "items": dict(in_order)}


def read_control_table(text: str) -> ControlTable:
    """Return the control table of a servo model from the TOML text of its data file.

    Raises:
        ValueError: The text is not a control table (also tomllib.TOMLDecodeError).
        KeyError: An entry is missing.
    """
    return build_table(tomllib.loads(text))


def build_table(data: Entry) -> ControlTable:
    """Return the control table of a servo model from its data, with `extends` resolved.

    Raises:
        ValueError: The entry is invalid.
        KeyError: An entry is missing.
    """
    entries = dict(section(data["items"]))
    number = whole(data, "model_number")
    if "model_number" in entries:
        entries["model_number"] = {"initial": number, **section(entries["model_number"])}
    items = tuple(_items(entries))
    _check(items)
    by_name = {item.name: item for item in items}
    goal_speed = _first(by_name, "moving_speed", "profile_velocity", "goal_velocity")
    present_speed = _first(by_name, "present_speed", "present_velocity")
    effort = _first(by_name, "present_load", "present_current")
    position, speed = by_name["goal_position"], by_name[goal_speed]
    firmware = data.get("fast_sync_read_firmware")
    return ControlTable(
        model=str(data["model"]),
        aliases=tuple(words(data.get("aliases", []))),
        model_number=number,
        protocol=protocol_in(data["protocol"]),
        items=MappingProxyType(by_name),
        baud_rates=MappingProxyType(
            {int(value): whole({"rate": rate}, "rate") for value, rate in section(data["baud_rates"]).items()}
        ),
        capabilities=_capabilities(data) | derived_capabilities(by_name, goal_speed, present_speed, effort),
        goal_speed_item=goal_speed,
        present_speed_item=present_speed,
        effort_item=effort,
        rad_per_tick=position.scale,
        min_tick=position.minimum,
        max_tick=position.maximum,
        rad_s_per_tick=by_name[present_speed].scale,
        max_speed_tick=(1 << SIGN_BIT) - 1 if speed.encoding == "sign_magnitude" else speed.maximum,
        effort_per_tick=by_name[effort].scale,
        effort_unit=_effort_unit(by_name[effort]),
        errors=_hardware_errors(data, by_name),
        max_speed=_figure(data, "no_load_speed", "rad/s"),
        stall_torque=_figure(data, "stall_torque", "Nm"),
        fast_sync_read_firmware=firmware if isinstance(firmware, int) else None,
        firmware=whole(data, "firmware") if "firmware" in data else 0,
        gear_ratio=_ratio(data.get("gear_ratio", 0)),
        stall_current=_figure({"stall_current": "0 A", **data}, "stall_current", "A"),
        nominal_voltage=_figure({"nominal_voltage": "0 V", **data}, "nominal_voltage", "V"),
    )


def _hardware_errors(data: Entry, items: Mapping[str, ControlItem]) -> HardwareErrors:
    """Return the hardware errors of a model from its data file. Raises ValueError for values that are not
    distinct bits or codes."""
    item = error_item(items)
    entries = section(data.get("errors", STATUS_BYTE if not item else {}))
    values = {name: whole(entries, name) for name in entries}
    errors = HardwareErrors(item, MappingProxyType(values))
    for name, value in values.items():
        if not 0 < value < 0x100 or (not errors.has_codes and value & (value - 1)):
            kind = "a code from 1 to 255" if errors.has_codes else "a single bit from 1 to 128"
            raise ValueError(f"errors: {name} = {value} is not {kind}")
    if len(set(values.values())) < len(values):
        raise ValueError("errors: two errors have the same value")
    return errors


def _figure(data: Entry, key: str, unit: str) -> float:
    """Return a property of the motor, such as `stall_torque`, in an SI unit. Raises ValueError if it is
    negative or has another unit."""
    found, value = quantity(str(data[key]))
    if found != unit or not value >= 0:
        raise ValueError(f"{key}: {data[key]!r} is not a quantity in {unit}, 0 or more")
    return value


def _ratio(value: object) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not value >= 0:
        raise ValueError(f"gear_ratio must be a number, 0 or more, not {value!r}")
    return float(value)


def section(value: object) -> Entry:
    """Return a value of a data file that must be a table. Raises ValueError otherwise."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{value!r} is not a table")
    return value


def whole(entry: Entry, key: str) -> int:
    """Return a value of a table that must be an integer. Raises ValueError if it is not an integer,
    KeyError if it is missing."""
    value = entry[key]
    if type(value) is not int:
        raise ValueError(f"{key} is not a whole number")
    return value


def words(value: object) -> list[str]:
    """Return a value of a data file that must be a list of strings. Raises ValueError otherwise."""
    if not isinstance(value, list) or not all(isinstance(word, str) for word in value):
        raise ValueError(f"{value!r} is not a list of strings")
    return value


def quantity(text: str, own: Collection[str] = ()) -> tuple[str, float]:
    """Convert a text such as `59 rpm` or `300/1023 deg` to (SI unit, value in that unit).

    Args:
        text: Number, or ratio of two numbers, and unit.
        own: Additional units, which are not converted.

    Raises:
        ValueError: The text is not a quantity.
    """
    number, _, unit = text.partition(" ")
    if unit not in _SI and unit not in own:
        raise ValueError(f"{text!r}: the unit is not one of {', '.join((*_SI, *own))}")
    numerator, _, denominator = number.partition("/")
    si, factor = _SI.get(unit, (unit, 1.0))
    if not float(denominator or "1"):
        raise ValueError(f"{text!r} divides by 0")
    value = float(numerator) * factor / float(denominator or "1")
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a finite number")
    return si, value


def parse_quantity(name: str, entry: Entry, key: str, own: Collection[str] = ()) -> tuple[str, float]:
    """Convert a quantity in an item's entry, such as `tick`, to (SI unit, value). Raises ValueError, with
    the item's name, if it is not one."""
    try:
        return quantity(str(entry[key]), own)
    except ValueError as error:
        raise ValueError(f"{name}: {key}: {error}") from None


def _items(entries: Entry) -> Iterator[ControlItem]:
    """Yield the control items of a data file. An item with `repeat` is the first of a series:
    `indirect_address_1` to 28."""
    for name, value in entries.items():
        entry = section(value)
        if entry.get("access") == "RW":
            entry = {"deviation": deviation_of(name), **entry}
        if "repeat" not in entry:
            yield read_item(name, entry)
            continue
        stem, _, first = name.rpartition("_")
        for step in range(whole(entry, "repeat")):
            one = {**entry, "address": whole(entry, "address") + step * whole(entry, "size")}
            if "initial_from" in entry:
                one["initial"] = whole(entry, "initial_from") + step
            yield read_item(f"{stem}_{int(first) + step}", one)


def read_item(name: str, entry: Entry, own: Collection[str] = ()) -> ControlItem:
    """Return a control item from its entry in a data file, where `tick` is a quantity. Raises ValueError
    for an invalid entry."""
    unit, scale = parse_quantity(name, entry, "tick", own) if "tick" in entry else ("", 1.0)
    try:
        entry = {"initial": None, **entry, "name": name, "unit": unit, "scale": scale}
        return msgspec.convert(entry, ControlItem)
    except msgspec.ValidationError as error:
        what, _, key = str(error).removeprefix("Object ").partition(" - at `$.")
        key = key.rstrip("`")
        known = get_args(get_type_hints(ControlItem)[key]) if what.startswith("Invalid enum") else ()
        more = f"; known are {', '.join(known)}" if known else ""
        raise ValueError(f"{name}: {key}{': ' if key else ''}{what}{more}") from None


def _first(items: Mapping[str, ControlItem], *names: str) -> str:
    for name in names:
        if name in items:
            return name
    raise ValueError(f"one of the items {', '.join(names)} is missing")


def _effort_unit(item: ControlItem) -> EffortUnit:
    if item.unit == "A":
        return "A"
    if item.unit == "Nm":
        return "Nm"
    if item.unit == "1":
        return "1"
    raise ValueError(f"{item.name}: the unit must be a fraction, A or Nm, not {item.unit or 'none'}")


def protocol_in(value: object) -> float:
    """Return the value of the key `protocol`. Raises ValueError if it is neither 1.0 nor 2.0."""
    if value not in (1.0, 2.0) or not isinstance(value, float):
        raise ValueError(f"protocol must be 1.0 or 2.0, not {value!r}")
    return value


def _capabilities(data: Entry) -> frozenset[str]:
    named = frozenset(words(data.get("capabilities", [])))
    if wrong := named - (CAPABILITIES.keys() - DERIVED):
        raise ValueError(f"capabilities not allowed in a data file: {', '.join(sorted(wrong))}")
    return named


def _check(items: tuple[ControlItem, ...]) -> None:
    end = 0
    for item in items:
        if item.address < end:
            raise ValueError(f"{item.name}: address {item.address} overlaps the previous item")
        if item.size not in (1, 2, 4):
            raise ValueError(f"{item.name}: the size must be 1, 2 or 4, not {item.size}")
        if item.encoding == "float32":
            raise ValueError(f"{item.name}: float32 is not possible in a servo")
        bits = 8 * item.size - item.signed
        if not -item.signed << bits <= item.minimum <= item.maximum < 1 << bits:
            raise ValueError(f"{item.name}: {item.minimum}..{item.maximum} does not fit into its bytes")
        if item.initial is not None and not item.minimum <= item.initial <= item.maximum:
            raise ValueError(f"{item.name}: the initial value {item.initial} is outside its range")
        end = item.address + item.size
