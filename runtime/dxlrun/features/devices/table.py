"""Table of the devices, as `dxlrun check` prints it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dxlrun.compile.check_report import Row, TableStage
from dxlrun.output.quantity import names_with_units
from dxlrun.output.text_table import Column, Columns, Table
from dxlrun.plan.loop_plan import SourcePlan
from dxlrun.plan.robot_plan import Plan
from dxlwire.bus_plan import BusPlan, DevicePlan

_COLUMNS: Columns[Row] = [
    (Column("device", "name"), "name"),
    (Column("bus", "name"), "bus"),
    (Column("model", "name"), "model"),
    (Column("ID"), "id"),
    (Column("states", "text"), lambda row: names_with_units(row["states"], row["units"])),
    (Column("commands", "text"), lambda row: names_with_units(row["commands"], row["command_units"])),
    (Column("addresses read", "text"), lambda row: ", ".join(row["reads"])),
]


def device_rows(plan: Plan) -> Iterator[Row]:
    """Yield the columns of each device in a plan as a mapping, bus by bus."""
    sources = {source.name: source for source in plan.loop.sources}
    for bus in plan.buses:
        for device in bus.devices:
            yield _device(bus, device, sources[device.name])


def device_table(rows: Sequence[Row]) -> Table:
    """Return the printable table `Devices` of these rows."""
    return Table.listing("Devices", _COLUMNS, rows)


STAGE = TableStage(rows=device_rows, table=device_table)


def _device(bus: BusPlan, device: DevicePlan, source: SourcePlan) -> Row:
    return {
        "name": device.name,
        "bus": bus.name,
        "id": device.servo_id,
        "model": device.model,
        "states": source.states,
        "commands": list(source.commands),
        "reads": [f"{block.address}..{block.address + block.length - 1}" for block in device.blocks],
        "units": source.units,
        "command_units": source.command_units,
    }
