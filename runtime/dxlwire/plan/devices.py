"""Devices: which bytes of a device are read each cycle and by how many reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dxlwire.bus_plan import DeviceBlock, DeviceField, Field
from dxlwire.control_table.device_table import DeviceTable
from dxlwire.control_table.table import ControlItem
from dxlwire.plan.line import MOST_SPARE, Line

MOST_BYTES = 120  # The longest block of one read: a device has a small buffer [i]


def device_blocks(
    line: Line, table: DeviceTable, states: Mapping[str, ControlItem], first_column: int
) -> tuple[DeviceBlock, ...]:
    """Return the reads that get the items of all states in the shortest time, in the order of addresses.

    Bytes between two items are read with them where that is quicker than a read of its own, and where they
    belong to items. `states`: item of each state, by name, in the order of their columns.
    """
    columns = {name: first_column + index for index, name in enumerate(states)}
    wanted = sorted(states.items(), key=lambda pair: pair[1].address)
    runs: list[list[tuple[str, ControlItem]]] = []
    for name, item in wanted:
        last = runs[-1] if runs else None
        if last is not None and _together(line, table, [one for _, one in last], item):
            last.append((name, item))
        else:
            runs.append([(name, item)])
    return tuple(_block(table, run, columns) for run in runs)


def _together(line: Line, table: DeviceTable, run: Sequence[ControlItem], item: ControlItem) -> bool:
    """Check whether one more item is read with those before it, or by a read of its own."""
    start, end = run[0].address, max(one.address + one.size for one in run)
    upto = max(end, item.address + item.size)
    if upto - start > MOST_BYTES or not table.readable(end, item.address):
        return False
    alone = line.read(0, start, end - start).due_ns + line.read(0, item.address, item.size).due_ns
    return line.read(0, start, upto - start).due_ns <= alone + line.latency_ns


def _block(
    table: DeviceTable, run: Sequence[tuple[str, ControlItem]], columns: Mapping[str, int]
) -> DeviceBlock:
    start = run[0][1].address
    end = max(item.address + item.size for _, item in run)
    fields = tuple(
        DeviceField(
            state=name,
            place=Field(item.address - start, item.size, item.encoding, item.bit),
            scale=item.scale,
            offset=item.offset,
            column=columns[name],
        )
        for name, item in run
    )
    return DeviceBlock(start, end - start, fields, table.spare(end, MOST_SPARE))
