"""Item values: converts between the values of control items, in SI units, and integers or bytes on the
wire."""

from __future__ import annotations

from msgspec.structs import replace

from dxlwire.control_table import ControlItem, ControlTable
from dxlwire.control_table.control_items import SIGN_BIT
from dxlwire.control_table.servo_models import perhaps_meant_item
from dxlwire.exceptions import suggestion
from dxlwire.plan.mode_plan import mode_numbers, position_reach

MODE_ITEMS = ("operating_mode", "control_mode")
"""Items whose values have names: `position`, `wheel`."""
_POSITIONS = ("goal_position", "present_position")


def item_of(table: ControlTable, name: str) -> ControlItem:
    """Return an item by its name in the control table.

    The range of the goal position is that of all modes: in extended position control and multi-turn mode it
    is many turns, and a goal that is limited to one turn would turn the servo back. In the other modes the
    servo refuses a goal beyond its limits.

    Raises:
        LookupError: The model has no such item.
    """
    if name not in table.items:
        # A script of another library names an item by its address.
        at_address = {str(item.address): item.name for item in table.items.values()}
        meant = at_address.get(str(name), str(name))
        hint = perhaps_meant_item(meant, table) if meant not in table.items else f"did you mean {meant}?"
        raise LookupError(f"{table.model} has no item {name!r}; {hint}")
    item = table.items[name]
    if name not in _POSITIONS:
        return item
    if "multi_turn_offset" in table.items:  # Negative turns (e-Manual MX-28, Goal Position (30))
        item = replace(item, encoding="twos_complement")
    lowest, highest = position_reach(table, continuous=True)
    return replace(item, minimum=min(item.minimum, lowest), maximum=max(item.maximum, highest))


def tick_range(item: ControlItem) -> tuple[int, int]:
    """Return the lowest and highest signed number of ticks of an item in its manual."""
    if item.encoding == "sign_magnitude":
        most = min(item.maximum, (1 << SIGN_BIT) - 1)
        return (-most if item.maximum >> SIGN_BIT else 0), most
    return item.minimum, item.maximum


def ticks_of(table: ControlTable, item: ControlItem, value: float | str, *, raw: bool) -> int:
    """Return the signed number of ticks for a value.

    Args:
        table: Control table of the model.
        item: The item.
        value: In SI units, or the name of a mode.
        raw: The value is a number of ticks already.

    Raises:
        ValueError: The value is outside the range of the item, or no mode has this name.
    """
    if value is None or isinstance(value, str | dict):
        numbers = mode_numbers(table) if item.name in MODE_ITEMS else {}
        if value not in [*numbers]:
            hint = suggestion(str(value), numbers, "the item takes a number" if not numbers else "")
            raise ValueError(f"{item.name} of {table.model}: {value!r} is not a value; {hint}")
        return numbers[value]
    exact = float(value) if raw else (value - item.offset) / item.scale
    lowest, highest = tick_range(item)
    if not lowest <= exact <= highest:  # NaN as well
        unit = "" if raw or not item.unit or item.unit == "1" else f" {item.unit}"
        ends = (lowest, highest) if raw else (lowest * item.scale, highest * item.scale)
        raise ValueError(
            f"{item.title} of {table.model}: {value:g}{unit} is outside {ends[0]:g} to {ends[1]:g}{unit}"
        )
    return round(exact)


def nearest_ticks(item: ControlItem, value: float, *, raw: bool) -> int:
    """Return the signed number of ticks that is nearest to a value, within the range of the item."""
    exact = value if raw else (value - item.offset) / item.scale
    lowest, highest = tick_range(item)
    return round(min(max(exact, lowest), highest))


def value_in(item: ControlItem, data: bytes | memoryview, *, raw: bool) -> float:
    """Return the value in the bytes of an item: SI units, or with `raw` its signed number of ticks."""
    return float(item.decode(data)) if raw else item.value(data)
