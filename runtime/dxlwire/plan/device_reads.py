"""Device reads: chooses the blocks of bytes that are read from a device, or from a servo of a script, in each
cycle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from dxlwire.bus_plan import DeviceBlock, DeviceField, Field
from dxlwire.control_table.control_items import BaseControlTable, ControlItem
from dxlwire.plan.line import MOST_SPARE, Line

MOST_BYTES = 120  # Longest block of one read: devices have small buffers [i]


def device_blocks(
    line: Line, table: BaseControlTable, states: Mapping[str, ControlItem], columns: Iterable[int]
) -> tuple[DeviceBlock, ...]:
    """Return the blocks by which the items of all these states are read in the shortest time, in the order of
    addresses.

    A read includes the bytes between two items if they belong to items and one read is faster than two.

    Args:
        line: Timing of the line.
        table: Control table of the device.
        states: Item of each state, by name.
        columns: Column of each state.
    """
    places = dict(zip(states, columns, strict=False))
    wanted = sorted(states.items(), key=lambda pair: pair[1].address)
    runs: list[list[tuple[str, ControlItem]]] = []
    for name, item in wanted:
        last = runs[-1] if runs else None
        if last is not None and _together(line, table, [one for _, one in last], item):
            last.append((name, item))
        else:
            runs.append([(name, item)])
    return tuple(_block(table, run, places) for run in runs)


def _together(line: Line, table: BaseControlTable, run: Sequence[ControlItem], item: ControlItem) -> bool:
    """Return True if one read of the items in `run` and another item is at least as fast as two reads."""
    start, end = run[0].address, max(one.address + one.size for one in run)
    upto = max(end, item.address + item.size)
    if upto - start > MOST_BYTES or not table.readable(end, item.address):
        return False
    alone = line.read_range(0, start, end - start).due_ns + line.read_range(0, item.address, item.size).due_ns
    return line.read_range(0, start, upto - start).due_ns <= alone + line.latency_ns


def _block(
    table: BaseControlTable, run: Sequence[tuple[str, ControlItem]], columns: Mapping[str, int]
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
