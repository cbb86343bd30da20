"""Compiles the section `devices` of a robot file and checks it against buses, servos and control tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path

import msgspec
from msgspec.structs import replace

from dxlrun.compile.contribution import BusDevice, Compilation, CompileStage, Contribution
from dxlrun.compile.joints.compiled_servos import check_bus
from dxlrun.compile.joints.described_servos import described_servos
from dxlrun.compile.problems import RobotFile
from dxlrun.description.bus import Bus
from dxlrun.description.document import KeyPath, read_file
from dxlrun.description.reading import Description
from dxlrun.errors import Mark, suggestion
from dxlrun.features.devices import form
from dxlrun.features.devices.form import Device
from dxlrun.features.devices.plan import DeviceCommand
from dxlrun.features.devices.simulate import simulated_states
from dxlrun.plan.loop_plan import SourcePlan
from dxlwire.bus_plan import DevicePlan
from dxlwire.control_table.control_items import ControlItem
from dxlwire.control_table.device_models import device_table, perhaps_meant_device
from dxlwire.control_table.device_table import DeviceTable, read_device_table
from dxlwire.plan.device_reads import device_blocks
from dxlwire.plan.line import Line
from dxlwire.wire.dialect import dialect_of


def compile_devices(compilation: Compilation) -> Contribution:
    """Return plans, sources and commands of the devices; those with a wrong bus, model or state are missing.

    Columns of states and commands are counted from the start of the cycle's record.
    """
    file, body = compilation.file, compilation.body
    described = form.STAGE.section_of(file.robot)
    sources: list[SourcePlan] = []
    devices: list[BusDevice] = []
    texts: dict[str, str] = {}
    by_device: dict[str, tuple[DeviceCommand, ...]] = {}
    commands: list[DeviceCommand] = []
    states = 0
    for name, device in described.items():
        _check_place(file, name, device)
        table = _table(file, name, device)
        if table is None:
            continue
        read = _read_items(file, name, device, table)
        written = _written_items(file, name, device, table)
        bus = file.robot.buses.get(device.bus)
        if bus is None or not read:
            continue
        plan = DevicePlan(
            name=name,
            servo_id=device.id,
            model=table.model,
            model_number=table.model_number,
            source=len(sources),
            blocks=device_blocks(_line(bus), table, read, count(states)),
        )
        columns = count(len(commands))
        own = {each: DeviceCommand.build(each, item, next(columns)) for each, item in written.items()}
        by_device[name] = _with_safe_values(file, name, own)
        commands += by_device[name]
        sources.append(
            SourcePlan(
                name=name,
                kind="device",
                states=tuple(read),
                commands=tuple(written),
                ranges=tuple((command.lowest, command.highest) for command in by_device[name]),
                label=f"{name} (ID {device.id} on bus {device.bus})",
                commandable=True,
                units=_units(read),
                command_units=_units(written),
            )
        )
        links = None if body is None else body.urdf.links
        shown = simulated_states(file, name, table, read, links)
        devices.append(BusDevice(device.bus, plan, table, shown))
        if (path := _file(file.description, name, device)) is not None:
            texts[str(path)] = table.text
        states += len(read)
    return Contribution(
        names=tuple(described),
        buses=frozenset(device.bus for device in described.values()),
        sources=tuple(sources),
        devices=tuple(devices),
        links={name: each.simulation.link for name, each in described.items() if each.simulation.link},
        texts=texts,
        plan=msgspec.json.encode(by_device) if commands else b"",
    )


STAGE = CompileStage(compile_devices)


def _check_place(file: RobotFile, name: str, device: Device) -> None:
    robot, marks = file.robot, file.marks
    check_bus(file, device, name, partial(marks.value, "devices", name), "ID")
    others = {(servo.bus, servo.id): servo.title for servo in described_servos(file.description)}
    for each, other in form.STAGE.section_of(robot).items():
        if each == name:
            break
        others.setdefault((other.bus, other.id), each)
    if (owner := others.get((device.bus, device.id))) is not None:
        file.error(
            marks.value("devices", name, "id"),
            f"ID {device.id} of {name} is taken by {owner} on bus {device.bus}",
            "give every servo and every device of a bus its own ID",
        )


def _table(file: RobotFile, name: str, device: Device) -> DeviceTable | None:
    mark = file.at("devices", name, "model")
    bus = file.robot.buses.get(device.bus)
    path = _file(file.description, name, device)
    try:
        table = device_table(device.model) if path is None else _read(path)
    except LookupError:
        what = f"no control table for the device {device.model} of {name}"
        file.error(mark, what, perhaps_meant_device(device.model))
        return None
    except OSError as error:
        what = f"the control table {device.model} of {name} cannot be read: {error.strerror}"
        file.error(mark, what, "check the path, relative to the folder of this file")
        return None
    except ValueError as error:
        what = f"{device.model} of {name} is not a control table of a device: {error}"
        file.error(mark, what, "correct the file; docs/how-to/devices.md shows its format")
        return None
    if bus is not None and table.protocol != bus.protocol:
        what = f"{table.model} of {name} speaks Protocol {table.protocol}"
        what = f"{what}, bus {device.bus} Protocol {bus.protocol}"
        file.error(mark, what, f"put it on a bus of Protocol {table.protocol}")
        return None
    return table


def _file(description: Description, name: str, device: Device) -> Path | None:
    """Return the path of the TOML file that a device names as its model; None for a built-in model."""
    if not device.model.endswith(".toml"):
        return None
    return Path(description.marks.value("devices", name, "model").file).parent / device.model


def _read(path: Path) -> DeviceTable:
    """Read a control table from a TOML file; raise OSError, or ValueError if its contents are wrong."""
    text = read_file(path).decode("utf-8")
    try:
        return replace(read_device_table(text), text=text)
    except KeyError as error:
        raise ValueError(f"the entry {error} is missing") from None


def _units(items: Mapping[str, ControlItem]) -> dict[str, str]:
    return {name: item.unit for name, item in items.items() if item.unit}


def _read_items(file: RobotFile, name: str, device: Device, table: DeviceTable) -> dict[str, ControlItem]:
    """Return the control table item of each state that a device reads in every cycle, by the state's name."""
    if not device.states and not table.cyclic:
        what = f"{name} has no states, and {table.model} has no default items"
        fix = f"list some under states: {', '.join(table.items)}"
        file.error(file.key("devices", name), what, fix)
    written = device.states or tuple(("", item) for item in table.cyclic)
    return _named(file, ("devices", name, "states"), written, table)


def _written_items(file: RobotFile, name: str, device: Device, table: DeviceTable) -> dict[str, ControlItem]:
    """Return the control table item of each command, by its name; read-only items are errors."""
    found = _named(file, ("devices", name, "commands"), device.commands, table)
    for index, (command, item) in enumerate(found.items()):
        if item.access == "R" or item.area == "EEPROM" or item.bit is not None:
            why = "would wear out the EEPROM" if item.area == "EEPROM" else "shares its byte with other bits"
            why = "cannot be written" if item.access == "R" else why
            mark = _item_mark(file.description, ("devices", name, "commands"), index, command)
            writable = [
                one.name
                for one in table.items.values()
                if (one.access, one.area, one.bit) == ("RW", "RAM", None)
            ]
            fix = f"take one of {', '.join(writable)}" if writable else "remove it"
            file.error(mark, f"{item.name} of {name} ({table.model}) {why}", fix)
    return found


def _with_safe_values(
    file: RobotFile, name: str, commands: Mapping[str, DeviceCommand]
) -> tuple[DeviceCommand, ...]:
    """Return a device's commands with the values of `safe` in the file; check their names and ranges."""
    found = dict(commands)
    for each, value in form.STAGE.section_of(file.robot)[name].safe.items():
        mark = file.at("devices", name, "safe", each)
        if (command := commands.get(each)) is None:
            fix = suggestion(each, tuple(commands)) if commands else "name its item under commands"
            file.error(mark, f"{each} is not a command of {name}", fix)
        elif not command.lowest <= value <= command.highest:
            ends = f"{command.lowest:g} to {command.highest:g}"
            file.error(mark, f"{name}/{each} = {value:g} is outside its range", f"give it {ends}")
        else:
            found[each] = replace(command, safe=value)
    return tuple(found.values())


def _named(
    file: RobotFile, at: KeyPath, pairs: Sequence[tuple[str, str]], table: DeviceTable
) -> dict[str, ControlItem]:
    """Return control table items by the names that the file gives them; `at` is the path of that key."""
    found: dict[str, ControlItem] = {}
    _, name, key = at
    for index, (given, item_name) in enumerate(pairs):
        mark = _item_mark(file.description, at, index, given)
        item = table.items.get(item_name)
        if item is None:
            what = f"the device {table.model} of {name} has no item {item_name}"
            file.error(mark, what, suggestion(item_name, tuple(table.items)))
            continue
        own = item.name if key == "commands" else item.state
        if (given or own) in found:
            what = f"two {key} of {name} have the name {given or own}"
            file.error(mark, what, "write NAME: ITEM for each, with different names")
            continue
        found[given or own] = item
    return found


def _item_mark(description: Description, at: KeyPath, index: int, given: str) -> Mark:
    """Return line and column where the file names an item of a device, else those of the device."""
    marks = description.marks
    for path in ((*at, given), (*at, index)):
        if marks.has(path):
            return marks.value(*path)
    return marks.key(*at[:2])


def _line(bus: Bus) -> Line:
    return Line(bus.baud_rate, bus.latency, bus.return_delay_time, dialect_of(bus.protocol))
