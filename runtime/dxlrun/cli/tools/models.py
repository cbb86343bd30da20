"""`dxlrun models`: list the known models of servos and devices, or print a model's control table."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from msgspec.structs import asdict

from dxlrun.cli.inputs import DebugFlag, JsonFlag
from dxlrun.errors import InputError
from dxlrun.output.terminal import show_json, show_parts
from dxlrun.output.text_table import Column, Columns, Table

if TYPE_CHECKING:
    from dxlsim.motion.motor import Motor
    from dxlwire.control_table import ControlItem, ControlTable
    from dxlwire.control_table.device_table import DeviceTable

_DEVICES_ALONE = ("offset", "state", "safe", "bit")
"""Fields of control table items that only devices have; omitted from the JSON of servos."""
_PER_SI = {
    "rad": ("deg", 180 / math.pi),
    "rad/s": ("rpm", 30 / math.pi),
    "rad/s^2": ("deg/s^2", 180 / math.pi),
    "s": ("ms", 1e3),
    "A": ("mA", 1e3),
    "1": ("%", 100.0),
}
"""SI unit -> unit in the output and factor; other units are unchanged."""


def models(
    name: str | None = None,
    /,
    *,
    protocol: float | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """List models of servos and devices, or print the control table of one.

    A robot file can name all these models.

    Parameters
    ----------
    name
        Model to print, for example AX-12A. Default: list all models.
    protocol
        Protocol, 1.0 or 2.0, of the models. Default: both.
    """
    from dxlrun.control.controllers.plugin_loading import load_plugins

    # Plug-ins may add servo models.
    load_plugins()
    tables, devices = _tables(name, protocol)
    if as_json:
        found = [_as_json(table, items=name is not None) for table in tables]
        show_json(found + [_device_json(table, items=name is not None) for table in devices])
    elif name is None:
        show_parts(_overview(tables))
        if devices:
            show_parts(_devices(devices))
    else:
        for table in tables:
            show_parts(_title(table), _facts(table), _items(table))
        for device in devices:
            show_parts(_title(device), _device_facts(device), _device_items(device))
    return 0


def _tables(name: str | None, protocol: float | None) -> tuple[list[ControlTable], list[DeviceTable]]:
    """Return the control tables of servos and of devices that a name and a protocol choose (None: all).

    Raises InputError when there is no such model.
    """
    from dxlwire.control_table import all_tables, find_table, perhaps_meant, protocols_of
    from dxlwire.control_table.device_models import device_table, device_tables, perhaps_meant_device

    if protocol not in (None, 1.0, 2.0):
        raise InputError(f"--protocol {protocol:g} does not exist; give 1.0 or 2.0")
    if name is None:
        servos = [table for table in all_tables() if protocol in (None, table.protocol)]
        return servos, [table for table in device_tables() if protocol in (None, table.protocol)]
    chosen = [each for each in (1.0, 2.0) if protocol in (None, each)]
    found = [find_table(name, each) for each in protocols_of(name) if each in chosen]
    if not found:
        with suppress(LookupError):
            return [], [device_table(name, protocol)]
        speaks = "" if protocol is None else f" of Protocol {protocol:.1f}"
        meant = perhaps_meant(name, protocol)
        if "did you mean" not in meant:
            meant = perhaps_meant_device(name)
        raise InputError(f"there is no model {name}{speaks}; {meant}")
    return found, []


def _motor_json(table: ControlTable) -> dict[str, object]:
    """Return the data of the motor that the simulation uses for a servo model, in SI units."""
    from dxlsim.motion.motor import motor_of

    motor = motor_of(table)
    return {
        **asdict(motor),
        "no_load_speed": motor.no_load_speed,
        "time_constant": motor.time_constant,
        "voltage": motor.voltage or None,
        "p_gain_duty": motor.p_gain_duty or None,
        "gain_source": motor.gain_source or None,
    }


def _device_json(table: DeviceTable, *, items: bool) -> dict[str, object]:
    about = _known(table, "model aliases model_number protocol cyclic")
    return {"kind": "device", **about, **_ends(table, items=items)}


def _as_json(table: ControlTable, *, items: bool) -> dict[str, object]:
    about = _known(table, "model aliases model_number protocol firmware rad_per_tick min_tick max_tick")
    about |= _known(table, "rad_s_per_tick max_speed_tick effort_per_tick effort_unit max_speed")
    rated = _known(table, "stall_torque stall_current nominal_voltage gear_ratio")
    about |= {name: value or None for name, value in rated.items()}
    return {
        "kind": "servo",
        **about,
        "simulated_motor": _motor_json(table),
        **_ends(table, _DEVICES_ALONE, items=items),
    }


def _known(table: ControlTable | DeviceTable, names: str) -> dict[str, object]:
    return {name: getattr(table, name) for name in names.split()}


def _ends(
    table: ControlTable | DeviceTable, without: Collection[str] = (), *, items: bool
) -> dict[str, object]:
    """Return the last keys of a model's JSON: capabilities, baud rates and, with `items`, the control table.

    `without`: fields of items that are omitted.
    """
    known = {"capabilities": sorted(table.capabilities), "baud_rates": dict(table.baud_rates)}
    if not items:
        return {**known}
    shown = [asdict(item) for item in table.items.values()]
    return {**known, "items": [{key: item[key] for key in item if key not in without} for item in shown]}


# Tables


def _overview(tables: Sequence[ControlTable]) -> Table:
    """Return the table of all servo models, one row per model."""
    columns: Columns[ControlTable] = [
        (Column("model", "name"), "model"),
        (Column("also named", "text", detail=True), _also),
        (Column("number"), "model_number"),
        (Column("protocol", form="{:.1f}"), "protocol"),
        (Column("resolution", form="{:.3g} deg"), lambda table: math.degrees(table.rad_per_tick)),
        (Column("travel"), _travel),
        (Column("no-load speed"), _speed),
        (Column("stall torque"), _torque),
        (Column("effort", "text", detail=True), _effort),
    ]
    return Table.listing("", columns, tables)


def _also(table: ControlTable | DeviceTable) -> str:
    return ", ".join(table.aliases)


def _devices(tables: Sequence[DeviceTable]) -> Table:
    """Return the table of all models of devices, one row per model."""
    columns: Columns[DeviceTable] = [
        (Column("model", "name"), "model"),
        (Column("also named", "text", detail=True), _also),
        (Column("number", missing="not checked"), "model_number"),
        (Column("protocol", form="{:.1f}"), "protocol"),
        (Column("states", "text"), lambda one: ", ".join(one.items[name].state for name in one.cyclic)),
        (Column("can be commanded", "text"), lambda one: ", ".join(_commands(one))),
    ]
    return Table.listing("Devices other than servos", columns, tables)


def _commands(table: DeviceTable) -> list[str]:
    return [item.name for item in table.items.values() if item.access == "RW" and item.area == "RAM"]


def _device_facts(table: DeviceTable) -> Table:
    """Return a device model's properties: cyclic reads, commands, capabilities and baud rates."""
    from dxlwire.control_table.device_table import CAPABILITIES

    known = ("ping, read and write", *(CAPABILITIES[name] for name in sorted(table.capabilities)))
    facts = [
        ("read each cycle", ", ".join(table.cyclic) or "the items in the robot file"),
        ("can be commanded", ", ".join(_commands(table)) or "nothing"),
        ("can", "; ".join(known)),
        ("baud rates", ", ".join(str(rate) for rate in sorted(table.baud_rates.values())) or "not listed"),
    ]
    return Table.facts("", facts)


def _device_items(table: DeviceTable) -> Table:
    """Return a device model's control table, one row per item."""
    columns: Columns[ControlItem] = [
        (Column("item", "name"), "name"),
        (Column("address"), "address"),
        (Column("bit"), "bit"),
        (Column("size"), "size"),
        (Column("access", "name"), "access"),
        (Column("area", "name"), "area"),
        (Column("unit"), lambda item: _measure(item)[0]),
        (Column("from"), lambda item: _measure(item)[1]),
        (Column("range"), _device_range),
        (Column("safe"), "safe"),
        (Column("state", "name", detail=True), "state"),
        (Column("source", "text", detail=True), "page"),
    ]
    return Table.listing("Control table", columns, table.items.values())


def _measure(item: ControlItem) -> tuple[str, str]:
    """Return the size of one tick of a device's item, and the value at tick 0 if that is not 0, in units for
    people.

    Angular velocity is in deg/s, for gyroscopes, not in rpm.
    """
    unit, factor = (
        ("deg/s", 180 / math.pi) if item.unit == "rad/s" else _PER_SI.get(item.unit, (item.unit, 1.0))
    )
    if not item.unit:
        return "", ""
    return f"{item.scale * factor:.4g} {unit}", f"{item.offset * factor:.4g}" if item.offset else ""


def _device_range(item: ControlItem) -> str:
    if item.encoding == "float32":
        return "float32"
    return f"{item.minimum}..{item.maximum}" if item.bit is None else "0..1"


def _title(table: ControlTable | DeviceTable) -> str:
    names = f" ({', '.join(table.aliases)})" if table.aliases else ""
    number = "not checked" if table.model_number is None else table.model_number
    since = getattr(table, "firmware", 0)
    firmware = f", from firmware {since} on" if since else ""
    return f"{table.model}{names}: model number {number}, Protocol {table.protocol:.1f}{firmware}"


def _facts(table: ControlTable) -> Table:
    """Return a servo model's properties: travel, motor, simulation, effort, capabilities and baud rates."""
    from dxlsim.motion.motor import motor_of
    from dxlwire.control_table import CAPABILITIES

    facts = [
        ("travel", f"{_travel(table)}, a tick is {math.degrees(table.rad_per_tick):.6g} deg"),
        ("motor", _motor(table)),
        *_simulated(motor_of(table)),
        ("effort", _effort(table)),
        ("can", "; ".join(CAPABILITIES[name] for name in sorted(table.capabilities))),
        ("baud rates", ", ".join(str(rate) for rate in sorted(table.baud_rates.values()))),
    ]
    return Table.facts("", facts)


def _items(table: ControlTable) -> Table:
    """Return a servo model's control table, one row per item; numbered items share a row."""
    columns: Columns[Sequence[ControlItem]] = [
        (Column("item", "name"), _name),
        (Column("address"), lambda run: "..".join(dict.fromkeys(str(run[end].address) for end in (0, -1)))),
        (Column("size", detail=True), lambda run: run[0].size),
        (Column("access", "name"), lambda run: run[0].access),
        (Column("area", "name"), lambda run: run[0].area),
        (Column("unit"), lambda run: unit_of(run[0])),
        (Column("range"), lambda run: f"{run[0].minimum}..{run[0].maximum}"),
        (Column("initial", detail=True), _initial),
        (Column("section of the manual", "text", detail=True), _section),
    ]
    return Table.listing("Control table", columns, runs(tuple(table.items.values())))


def _name(run: Sequence[ControlItem]) -> str:
    first, last = run[0].name, run[-1].name
    return first if first == last else f"{first}..{last.rpartition('_')[2]}"


def _initial(run: Sequence[ControlItem]) -> str:
    first, last = run[0].initial, run[-1].initial
    shown = "" if first is None else str(first)
    return shown if first == last else f"{shown}..{last}"


def _section(run: Sequence[ControlItem]) -> str:
    return run[0].page + (f", from firmware {run[0].firmware}" if run[0].firmware else "")


def runs(items: Sequence[ControlItem]) -> Iterator[list[ControlItem]]:
    """Yield lists of items: adjacent items `name_1`, `name_2`, ... with equal limits form one list."""
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
    """Return the size of one tick of an item with its unit, such as `0.229 rpm`; empty without a unit."""
    if not item.unit:
        return ""
    unit, factor = _PER_SI.get(item.unit, (item.unit, 1.0))
    return f"{item.scale * factor:.4g} {unit}"


def _travel(table: ControlTable) -> str:
    low, high = (math.degrees(tick * table.rad_per_tick) for tick in (table.min_tick, table.max_tick))
    return f"{low:.4g}..{high:.4g} deg"


def _speed(table: ControlTable) -> str:
    return f"{table.max_speed * 30 / math.pi:.4g} rpm"


def _torque(table: ControlTable) -> str:
    return f"{table.stall_torque:.3g} Nm" if table.stall_torque else ""


def _motor(table: ControlTable) -> str:
    """Return a text with the motor's data from the manual: speed, torque, current and gear."""
    known = [f"no-load speed {_speed(table)}"]
    if table.nominal_voltage:
        known[0] += f" at {table.nominal_voltage:.3g} V"
    known.append(f"stall torque {_torque(table) or 'not given'}")
    if table.stall_current:
        known.append(f"stall current {table.stall_current:.3g} A")
    if table.gear_ratio:
        known.append(f"gear {table.gear_ratio:.5g} : 1")
    return ", ".join(known)


def _simulated(motor: Motor) -> Iterator[tuple[str, str]]:
    """Yield names and texts of the simulated motor's data, and of the sources of these data."""
    known = [
        f"no-load speed {motor.no_load_speed * 30 / math.pi:.4g} rpm",
        f"time constant {motor.time_constant * 1e3:.1f} ms",
        f"friction {motor.friction:.2g} Nm and {motor.load_friction:.0%} of the torque",
        f"{motor.torque_per_ampere:.3g} Nm/A",
    ]
    yield "simulated", ", ".join(known)
    yield "  source", motor.source
    if motor.p_gain_duty:
        yield "P gain", f"{motor.p_gain_duty:.4g} of full duty per rad of error, at a gain of 1"
        yield "  source", motor.gain_source


def _effort(table: ControlTable) -> str:
    if table.effort_unit == "1":
        return "fraction of the maximum load"
    return f"{table.effort_item.replace('_', ' ')} in {table.effort_unit}"
