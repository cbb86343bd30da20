"""Values of registers: the items that a robot file, a client or a tool may write, and those reserved for
dxlrun."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from types import MappingProxyType

from dxlrun.description.units import quantity
from dxlrun.errors import suggestion
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import ControlItem, ControlTable, Table

_COMMANDED = ("controllers command it", "take it out; a controller sends it")
_MODE = ("the interfaces of the active controllers choose the mode", "take it out; claim other interfaces")
_ADDRESS = ("dxlrun finds the servo by it", "take it out; `dxlrun servo` changes it")
_SECOND_ID = ("a servo with a second ID executes the goals of another one", "take it out")
_TICK = ("it changes the size of a tick", "take it out")
_OWN: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "id": _ADDRESS,
        "baud_rate": _ADDRESS,
        "baud_rate_bus": _ADDRESS,
        "protocol_type": _ADDRESS,
        "secondary_id": _SECOND_ID,
        "secondary_shadow_id": _SECOND_ID,
        "torque_enable": ("dxlrun switches the torque, after its checks", "take it out"),
        "operating_mode": _MODE,
        "control_mode": _MODE,
        "torque_ctrl_mode_enable": _MODE,
        "goal_position": _COMMANDED,
        "goal_velocity": _COMMANDED,
        "goal_current": _COMMANDED,
        "goal_pwm": _COMMANDED,
        "goal_torque": _COMMANDED,
        "moving_speed": _COMMANDED,
        "profile_velocity": _COMMANDED,
        "current": ("it is measured", "take it out"),
        "torque_limit": (
            "policies reduce it, and a start restores it",
            "declare max_torque, its value after power-on",
        ),
        "bus_watchdog": ("dxlrun arms it", "take it out; the bus' key `bus_watchdog` is its time"),
        "lock": ("it closes the EEPROM until power-off", "take it out"),
        "hybrid_save": ("it stores RAM values in the EEPROM", "take it out"),
        "electronic_gearratio_numerator": _TICK,
        "electronic_gearratio_denominator": _TICK,
    }
)
"""Items that dxlrun writes itself or relies on, with the reason and the fix."""
_RESTORED = ("profile_velocity", "torque_limit")
"""Items that start-up writes on some models only; on the other models they are reported."""
_ANGLE_LIMITS = ("cw_angle_limit", "ccw_angle_limit")


class UnfitRegister(ValueError):
    """A register value that may not be written: `what` is the problem, `fix` the remedy."""

    def __init__(self, what: str, fix: str) -> None:
        super().__init__(f"{what}; {fix}")
        self.what = what
        self.fix = fix


def register_value(table: ControlTable, name: str, value: int | str) -> RegisterValue:
    """Return the value to write for a declared register.

    Args:
        table: Control table of the servo.
        name: Name of the item.
        value: Integer on the wire, signed if the item is; or text with a unit of the item's kind, rounded to
            the nearest tick.

    Raises:
        UnfitRegister: The register or the value cannot be declared.
    """
    item = table.items.get(name)
    if item is None:
        raise UnfitRegister(f"an {table.model} has no register {name}", suggestion(name, declarable(table)))
    if reason := own_reason(table, item):
        raise UnfitRegister(f"{item.title} cannot be declared: {reason[0]}", reason[1])
    found = any_value(table, name, value)
    _check_meaning(item, found.value)
    return found


def any_value(table: Table, name: str, value: int | str) -> RegisterValue:
    """Return the value that a tool writes into any writable item; raise UnfitRegister.

    `value` is as in `register_value`.
    """
    item = table.items.get(name)
    if item is None:
        names = tuple(each.name for each in table.items.values() if each.access == "RW")
        raise UnfitRegister(f"an {table.model} has no register {name}", suggestion(name, names))
    if item.access == "R":
        raise UnfitRegister(f"{item.title} can only be read", "take it out")
    raw = _raw(item, value)
    if not item.minimum <= raw <= item.maximum:
        raise UnfitRegister(
            f"{item.title} of an {table.model} is {_range(item)}, not {_shown(value, raw)}",
            "write a value in this range",
        )
    return RegisterValue(item.address, item.size, raw, name, item.area == "EEPROM")


def steered_value(table: ControlTable, name: str, value: int | str) -> RegisterValue:
    """Return the value to write for a register that a client changes in a run; raise UnfitRegister."""
    item = table.items.get(name)
    if item is not None and item.access == "R":
        raise UnfitRegister(f"{item.title} can only be read", "write another item")
    if item is not None and (reason := own_reason(table, item)):
        raise UnfitRegister(f"{item.title} cannot be changed: {reason[0]}", "write another item")
    found = register_value(table, name, value)
    item = table.items[name]
    if found.eeprom:
        raise UnfitRegister(
            f"{item.title} is in the EEPROM, which cannot be written while the servo has torque",
            "declare it under `registers` in the robot file, which the next start writes",
        )
    if item.deviation is not None and item.deviation.may_refuse:
        raise UnfitRegister(
            f"{item.title} cannot be changed: another value {item.deviation.effect}", "leave it as it is"
        )
    return found


def declarable(table: ControlTable) -> tuple[str, ...]:
    """Return the items of a model that can be declared, in the order of their addresses."""
    items = table.items.values()
    return tuple(item.name for item in items if item.access == "RW" and not own_reason(table, item))


def own_reason(table: ControlTable, item: ControlItem) -> tuple[str, str] | None:
    """Return the reason why an item is reserved for dxlrun, and the fix; None if it is not."""
    if item.name.startswith("indirect_"):
        return "a reboot resets it", "take it out"
    if item.name in _ANGLE_LIMITS and table.protocol == 1.0:
        return (
            "both angle limits choose the mode, which dxlrun sets",
            "write `limits: {position: ...}` instead",
        )
    rule = item.deviation
    if rule is not None and item.name in _RESTORED and rule.judgement == "report":
        return None  # start-up does not write it on this model
    return _OWN.get(item.name)


def _raw(item: ControlItem, value: int | str) -> int:
    if item.encoding == "float32":
        try:
            return int.from_bytes(struct.pack("<f", (float(value) - item.offset) / item.scale), "little")
        except (ValueError, OverflowError):
            raise UnfitRegister(f"{value!r} is no number", f"{item.title} is a float32") from None
    if isinstance(value, int):
        return value
    if not item.unit:
        raise UnfitRegister(f"{item.title} has no unit, but is {value!r}", "write a whole number")
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


def _check_meaning(item: ControlItem, raw: int) -> None:
    """Refuse values that a servo accepts but that prevent every start."""
    rule, factory = item.deviation, item.initial
    if rule is None or rule.planned or factory is None or rule.judge(raw, factory) != "refuse":
        return
    raise UnfitRegister(
        f"{item.title} cannot be {raw}, which {rule.effect_of(raw)}", f"write {factory}, or take it out"
    )
