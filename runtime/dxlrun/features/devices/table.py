"""Table of the devices, as `dxlrun check` shows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dxlrun.compile.report import Row, TableStage
from dxlrun.output.table import Column, Columns, Table
from dxlrun.plan.robot_plan import Plan
from dxlwire.bus_plan import BusPlan, DevicePlan

_COLUMNS: Columns[Row] = [
    (Column("device", "name"), "name"),
    (Column("bus", "name"), "bus"),
    (Column("model", "name"), "model"),
    (Column("ID"), "id"),
    (Column("states", "text"), lambda row: ", ".join(row["states"])),
    (Column("commands", "text"), lambda row: ", ".join(row["commands"])),
    (Column("addresses read", "text"), lambda row: ", ".join(row["reads"])),
]


def device_rows(plan: Plan) -> Iterator[Row]:
    """Yield a row for each device, in the order of the buses."""
    for bus in plan.buses:
        for device in bus.devices:
            yield _device(bus, device)


def device_table(rows: Sequence[Row]) -> Table:
    """Return the table of these devices."""
    return Table.listing("Devices", _COLUMNS, rows)


STAGE = TableStage(rows=device_rows, table=device_table)


def _state_names(device: DevicePlan) -> tuple[str, ...]:
    """Return the names of a device's states, in the order of the cycle's record."""
    fields = [field for block in device.blocks for field in block.fields]
    return tuple(field.state for field in sorted(fields, key=lambda field: field.column))


def _device(bus: BusPlan, device: DevicePlan) -> Row:
    return {
        "name": device.name,
        "bus": bus.name,
        "id": device.servo_id,
        "model": device.model,
        "states": _state_names(device),
        "commands": [command.name for command in device.commands],
        "reads": [f"{block.address}..{block.address + block.length - 1}" for block in device.blocks],
    }
