"""The tables of `dxlrun models`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from dxlrun.dynamixel.control_table import CAPABILITIES, ControlItem, ControlTable
from dxlrun.simulation.motion.motor import Motor, motor_of

_PER_SI = {
    "rad": ("deg", 180 / math.pi),
    "rad/s": ("rpm", 30 / math.pi),
    "rad/s^2": ("deg/s^2", 180 / math.pi),
    "s": ("ms", 1e3),
    "A": ("mA", 1e3),
    "1": ("%", 100.0),
}
"""SI unit -> the unit that people read; the others stand as they are."""


def overview(tables: Sequence[ControlTable]) -> Table:
    """Return one line a model."""
    shown = Table(box=box.SIMPLE_HEAD)
    for name in ("model", "also named"):
        shown.add_column(name, overflow="fold")
    for name in ("number", "protocol", "resolution", "travel", "no-load speed", "stall torque"):
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("effort")
    for table in tables:
        shown.add_row(
            table.model,
            ", ".join(table.aliases),
            str(table.model_number),
            f"{table.protocol:.1f}",
            f"{math.degrees(table.rad_per_tick):.3g} deg",
            _travel(table),
            _speed(table),
            _torque(table),
            _effort(table),
        )
    return shown


def facts(table: ControlTable) -> Text:
    """Return what holds for the whole model, in a few lines."""
    names = f" ({', '.join(table.aliases)})" if table.aliases else ""
    firmware = f", from firmware {table.firmware} on" if table.firmware else ""
    can = "; ".join(CAPABILITIES[name] for name in sorted(table.capabilities))
    lines = [
        f"{table.model}{names}: model number {table.model_number}, Protocol {table.protocol:.1f}{firmware}",
        f"travel {_travel(table)}, a tick is {math.degrees(table.rad_per_tick):.6g} deg",
        _motor(table),
        *_simulated(motor_of(table)),
        f"effort: {_effort(table)}",
        f"can: {can}",
        f"baud rates: {', '.join(str(rate) for rate in sorted(table.baud_rates.values()))}",
    ]
    return Text("\n".join(lines))


def items_of(table: ControlTable) -> Table:
    """Return one line an item; items that repeat themselves share one."""
    shown = Table(box=box.SIMPLE_HEAD)
    shown.add_column("item", no_wrap=True)
    for name in ("address", "size"):
        shown.add_column(name, justify="right", no_wrap=True)
    for name in ("access", "area"):
        shown.add_column(name, no_wrap=True)
    for name in ("unit", "range", "initial"):
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("section of the manual", overflow="fold")
    for run in runs(tuple(table.items.values())):
        first, last = run[0], run[-1]
        alone = first is last
        same = first.initial == last.initial
        shown.add_row(
            first.name if alone else f"{first.name}..{last.name.rpartition('_')[2]}",
            str(first.address) if alone else f"{first.address}..{last.address}",
            str(first.size),
            first.access,
            first.area,
            unit_of(first),
            f"{first.minimum}..{first.maximum}",
            _initial(first) if alone or same else f"{_initial(first)}..{_initial(last)}",
            first.page + (f", from firmware {first.firmware}" if first.firmware else ""),
        )
    return shown


def runs(items: Sequence[ControlItem]) -> Iterator[list[ControlItem]]:
    """Yield the items in groups: `name_1`, `name_2`, ... side by side are one group."""
    group: list[ControlItem] = []
    for item in items:
        if group and not _continues(group[-1], item):
            yield group
            group = []
        group.append(item)
    if group:
        yield group


def _continues(before: ControlItem, item: ControlItem) -> bool:
    counted = re.fullmatch(r"(.*_)(\d+)", before.name)
    return (
        counted is not None
        and item.name == f"{counted[1]}{int(counted[2]) + 1}"
        and (item.address, item.size) == (before.address + before.size, before.size)
        and (item.minimum, item.maximum, item.access) == (before.minimum, before.maximum, before.access)
    )


def unit_of(item: ControlItem) -> str:
    """Return what a tick is, in the units that people read."""
    if not item.unit:
        return ""
    unit, factor = _PER_SI.get(item.unit, (item.unit, 1.0))
    return f"{item.scale * factor:.4g} {unit}"


def _initial(item: ControlItem) -> str:
    return "" if item.initial is None else str(item.initial)


def _travel(table: ControlTable) -> str:
    low, high = (math.degrees(tick * table.rad_per_tick) for tick in (table.min_tick, table.max_tick))
    return f"{low:.4g}..{high:.4g} deg"


def _speed(table: ControlTable) -> str:
    return f"{table.max_speed * 30 / math.pi:.4g} rpm"


def _torque(table: ControlTable) -> str:
    return f"{table.stall_torque:.3g} Nm" if table.stall_torque else ""


def _motor(table: ControlTable) -> str:
    """Say what the motor does at its nominal voltage, as far as the manual gives it."""
    known = [f"no-load speed {_speed(table)}"]
    if table.nominal_voltage:
        known[0] += f" at {table.nominal_voltage:.3g} V"
    known.append(f"stall torque {_torque(table) or 'not given'}")
    if table.stall_current:
        known.append(f"stall current {table.stall_current:.3g} A")
    if table.gear_ratio:
        known.append(f"gear {table.gear_ratio:.5g} : 1")
    return ", ".join(known)


def _simulated(motor: Motor) -> list[str]:
    """Say how the simulated servo's motor moves, and where these figures are from."""
    known = [
        f"no-load speed {motor.no_load_speed * 30 / math.pi:.4g} rpm",
        f"time constant {motor.time_constant * 1e3:.1f} ms",
        f"friction {motor.friction:.2g} Nm and {motor.load_friction:.0%} of the torque",
        f"{motor.torque_per_ampere:.3g} Nm/A",
    ]
    lines = [f"simulated: {', '.join(known)}", f"source of it: {motor.source}"]
    if motor.p_gain_duty:
        lines.append(f"P gain: {motor.p_gain_duty:.4g} of full duty per rad of error and unit")
        lines.append(f"source of it: {motor.gain_source}")
    return lines


def _effort(table: ControlTable) -> str:
    if table.effort_unit == "1":
        return "fraction of the maximum load"
    return f"{table.effort_item.replace('_', ' ')} in {table.effort_unit}"
