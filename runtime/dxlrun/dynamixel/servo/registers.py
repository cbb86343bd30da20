"""Registers: writes the settings of a servo only if they differ, and reads them back; texts of values.

EEPROM wears. A servo of Protocol 2.0 refuses to write it while it holds torque (e-Manual XM430-W350, Control
Table of EEPROM Area), so it is never written then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import ItemAccess, first_reach
from dxlwire.bus_plan import BusPlan, RegisterValue
from dxlwire.control_table import ControlItem, HardwareErrors
from dxlwire.transaction import Program

_RELEASE = "switch its torque off and start again, without --take-over"


def read_registers(one: ItemAccess, registers: Sequence[RegisterValue]) -> Program[dict[str, int | None]]:
    """Read registers of one servo or device; return the integers on the wire by name, None for those without
    an answer.
    """
    present: dict[str, int | None] = {}
    for register in registers:
        reply = yield from one.read_bytes(register.address, register.size)
        item = one.items[register.name]
        present[item.name] = item.integer(reply.parameters[: item.size]) if reply.answered else None
    return present


def write_registers(
    one: ItemAccess, registers: Sequence[RegisterValue], found: Findings
) -> Program[dict[str, int]]:
    """Write the registers that differ from their desired values and read them back; return the values before,
    by name.

    Problems go to `found`. Nothing is written if one register cannot be read, or if a closed EEPROM prevents
    one of the writes.
    """
    present = yield from read_registers(one, registers)
    before = {name: found for name, found in present.items() if found is not None}
    if silent := [each for each in registers if each.name not in before]:
        found.problems.append(f"{one} did not answer when {_names(one, silent)} was read")
        return before
    differing = [each for each in registers if each.value != before[each.name]]
    stored = [register for register in differing if register.eeprom]
    if stored and (problem := (yield from one.closed_eeprom(_names(one, stored), release=_RELEASE))):
        found.problems.append(f"{one} {problem}")
        return before
    for register in differing:
        if problem := (yield from one.write_item(register.name, register.value)):
            found.problems.append(f"{one} {problem}")
        else:
            item = one.items[register.name]
            was = format_item(item, before[item.name])
            found.add_event(one.name, texts.register_written(item.title, was, register.value))
    return before


def settle_bus(plan: BusPlan, found: Findings) -> Program[None]:
    """Write the settings of the robot file to all servos of a bus; problems go to `found` and do not stop the
    next servo.
    """
    for servo in plan.servos:
        yield from write_registers(first_reach(plan, servo), servo.settings, found)


def merged(registers: Sequence[RegisterValue], newer: RegisterValue) -> tuple[RegisterValue, ...]:
    """Return `registers` with `newer` in place of the register of that name, or at the end."""
    return tuple({**{one.name: one for one in registers}, newer.name: newer}.values())


def tripped(item: ControlItem, raw: int) -> bool:
    """Return True if the item is the Bus Watchdog and its value means that it timed out and stopped its
    servo.
    """
    return item.name == "bus_watchdog" and raw in (-1, (1 << 8 * item.size) - 1)


def format_item(item: ControlItem, raw: int) -> str:
    """Return a value of an item as text for messages; a tripped Bus Watchdog gives `255 (tripped)`.

    e-Manual XM430-W350, Bus Watchdog (98): -1 is "Bus Watchdog Error Status".
    """
    return f"{raw} (tripped)" if tripped(item, raw) else str(raw)


def meaning(item: ControlItem, value: int, errors: HardwareErrors) -> str:
    """Return the meaning of an item's raw value: the quantity with unit, or hardware errors in words; empty
    if it has neither.
    """
    if tripped(item, value):
        return "tripped"
    if item.name == errors.item:
        return errors.describe_errors(value)
    return _quantity(item, value) if item.unit or item.encoding == "float32" else ""


def _quantity(item: ControlItem, value: int) -> str:
    quantity = item.value(item.wire_bytes(value))
    if not item.unit:
        return f"{quantity:.6g}"
    if item.unit == "s" and abs(quantity) < 1:
        return f"{quantity * 1e3:.6g} ms" if abs(quantity) >= 1e-3 else f"{quantity * 1e6:.6g} us"
    if item.unit.startswith("rad"):
        return f"{math.degrees(quantity):.6g} {item.unit.replace('rad', 'deg')}"
    return f"{quantity * 100:.6g} %" if item.unit == "1" else f"{quantity:.6g} {item.unit}"


def _names(one: ItemAccess, registers: Sequence[RegisterValue]) -> str:
    return ", ".join(one.items[register.name].title for register in registers)
