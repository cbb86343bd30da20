"""Register values: converts a number or a quantity such as `60 deg` into the integer for a control table."""

from __future__ import annotations

import math
import struct

from dxlrun.description.units import quantity
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import BaseControlTable, ControlItem
from dxlwire.control_table.servo_models import perhaps_meant_item


class UnfitRegister(ValueError):
    """Raised if an item of a control table cannot have a value: `what` is the problem, `fix` the remedy."""

    def __init__(self, what: str, fix: str) -> None:
        super().__init__(f"{what}; {fix}")
        self.what = what
        self.fix = fix


def any_value(table: BaseControlTable, name: str, value: int | str) -> RegisterValue:
    """Convert a value for a writable item of a control table, and check its range.

    Args:
        table: Control table of the servo or device.
        name: Name of the item.
        value: Integer on the wire, signed if the item is; or text with a unit of the item's kind, rounded to
            the nearest tick.

    Raises:
        UnfitRegister: There is no such item, or it cannot have the value.
    """
    item = table.items.get(name)
    if item is None:
        names = tuple(each.name for each in table.items.values() if each.access == "RW")
        raise UnfitRegister(
            f"an {table.model} has no register {name}", perhaps_meant_item(name, table, names)
        )
    if item.access == "R":
        raise UnfitRegister(f"{item.title} is read-only", "remove it")
    raw = _raw(item, value)
    if not item.minimum <= raw <= item.maximum:
        raise UnfitRegister(
            f"{item.title} of an {table.model} is {_range(item)}, not {_shown(value, raw)}",
            "write a value in this range",
        )
    return RegisterValue(item.address, item.size, raw, name, item.area == "EEPROM")


def _raw(item: ControlItem, value: int | str) -> int:
    if item.encoding == "float32":
        try:
            return int.from_bytes(struct.pack("<f", (float(value) - item.offset) / item.scale), "little")
        except (ValueError, OverflowError):
            raise UnfitRegister(f"{value!r} is not a number", f"{item.title} is a float32") from None
    if isinstance(value, int):
        return value
    if not item.unit:
        raise UnfitRegister(
            f"{item.title} is a whole number without a unit, not {value!r}", "write a whole number"
        )
    ticks = (quantity(value, item.unit) - item.offset) / item.scale
    if not math.isfinite(ticks):
        raise UnfitRegister(f"{value} is out of the range of {item.title}", f"write {_range(item)}")
    return round(ticks)


def _range(item: ControlItem) -> str:
    ends = f"{item.minimum}..{item.maximum}"
    if not item.unit:
        return ends
    unit = "of the maximum" if item.unit == "1" else item.unit
    lowest, highest = (ticks * item.scale + item.offset for ticks in (item.minimum, item.maximum))
    return f"{ends} ({lowest:.6g}..{highest:.6g} {unit})"


def _shown(value: int | str, raw: int) -> str:
    return str(value) if isinstance(value, int) else f"{value} ({raw})"
