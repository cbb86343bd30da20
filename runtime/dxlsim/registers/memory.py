"""Memory of a simulated servo or device: the registers of its control table as bytes, from which the line
answers reads, and as integers on the wire."""

from __future__ import annotations

import ctypes
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NamedTuple

from dxlwire.control_table import ControlItem, ControlTable

_INDIRECT = re.compile(r"indirect_address_(\d+)")

_CELLS_KEPT = 1024
"""Size of the cache of address ranges. A host accesses only a few, but corrupted packets may address any
range."""


class Cells(NamedTuple):
    """Properties of a range of cells, the bytes of a memory."""

    items: tuple[ControlItem, ...]  # Their items; empty if a cell belongs to no item
    names: frozenset[str]
    whole: bool  # True if they consist of complete items
    direct: bool  # True if none is Indirect Data
    read_only: bool  # True if at least one item is read-only
    eeprom: bool  # True if at least one item is in the EEPROM area
    live: tuple[tuple[str, Callable[[], int]], ...]
    """Names of the live items in the range, with the functions that return their present values."""


class Run(NamedTuple):
    """Part of a write: bytes for a range of cells, with the values of the items after the write."""

    address: int
    data: bytes
    cells: Cells
    after: dict[str, int]  # Integers of the written items as they would be after the write


class Memory:
    """Registers of a simulated unit as bytes; `memory[name]` is the integer on the wire, never negative.

    Cells of Indirect Data are aliases of the cells at the addresses in the Indirect Addresses."""

    def __init__(self, table: ControlTable, firmware: int) -> None:
        self.table = table = table.with_firmware(firmware)
        self.firmware = firmware
        self.size = table.size  # Bytes from address 0 to the end of the last item
        self._memory = bytearray(self.size)
        self.image = (ctypes.c_uint8 * self.size).from_buffer(self._memory)
        """The same bytes, for compiled code."""
        self._cells_at: dict[tuple[int, int], Cells] = {}  # Cache, because hosts repeat the same accesses
        self._item_at: dict[int, ControlItem] = {
            address: item
            for item in table.items.values()
            for address in range(item.address, item.address + item.size)
        }
        self._indirect = _indirect_cells(table)
        self._places = {item.name: _place(item) for item in table.items.values()}
        self._readers = {item.name: _reader(item, self._memory) for item in table.items.values()}
        self._watchers: dict[str, list[Callable[[], None]]] = {}
        self._live: dict[str, Callable[[], int]] = {}
        self.show_range: Callable[[int, int], object] = _show_nothing
        """Sets the registers of a range (address, length) that show the motion of a shaft."""
        self.restore_factory_values()

    def restore_factory_values(self, keep: tuple[str, ...] = ()) -> None:
        """Reset every item except `keep` to its initial value, or to 0 without one, as by a factory reset."""
        self.reset(name for name in self.table.items if name not in keep)
        self["model_number"] = self.table.model_number
        self["firmware_version"] = self.firmware

    def restore_ram(self) -> None:
        """Reset the items of the RAM area to their values at power-up; the EEPROM area is kept."""
        self.reset(name for name, item in self.table.items.items() if item.area == "RAM")

    def reset(self, names: Iterable[str]) -> None:
        """Reset these items to their initial values; names that the model lacks are ignored."""
        for name in names:
            if (item := self.table.items.get(name)) is not None:
                initial = max(0, item.minimum) if item.access == "RW" else 0
                self[name] = initial if item.initial is None else item.initial

    def __contains__(self, name: str) -> bool:
        return name in self._places

    def __getitem__(self, name: str) -> int:
        return self._readers[name]()[0]

    def __setitem__(self, name: str, wire: int) -> None:
        start, end, mask, _, _ = self._places[name]
        wire &= mask
        if self._readers[name]()[0] == wire:
            return
        self._memory[start:end] = wire.to_bytes(end - start, "little")
        if name in self._watchers:
            self._notify((name,))

    def watch_items(self, names: Iterable[str], act: Callable[[], None]) -> None:
        """Call `act` now, and whenever one of these items is changed, possibly also without a change."""
        for name in names:
            self._watchers.setdefault(name, []).append(act)
        act()

    def _notify(self, names: Iterable[str]) -> None:
        for act in dict.fromkeys(act for name in names for act in self._watchers.get(name, ())):
            act()

    def get(self, name: str, otherwise: int = 0) -> int:
        """Return the integer of an item on the wire, or `otherwise` if the model lacks the item."""
        reader = self._readers.get(name)
        return otherwise if reader is None else reader()[0]

    def show_value(self, name: str, wire: int) -> None:
        """Set an item from inside the unit, if the model has it; the value is clamped to the range of its
        bytes."""
        if name in self._places:
            *_, lowest, highest = self._places[name]
            self[name] = lowest if wire < lowest else min(wire, highest)

    def show_live(self, live: Mapping[str, Callable[[], int]]) -> None:
        """Make items live: functions provide their values, and are called only when the items are read."""
        self._live = {name: show for name, show in live.items() if name in self}
        self._cells_at.clear()

    def show_no_more(self, name: str) -> None:
        """End the function of a live item, which keeps its present value."""
        self._live.pop(name, None)
        self._cells_at.clear()

    def refresh(self) -> None:
        """Set all live items to their present values."""
        self.show_range(0, self.size)
        for name, show in self._live.items():
            self.show_value(name, show())

    def ticks(self, name: str) -> int:
        """Return the value of an item as a signed number of ticks."""
        item = self.table.items[name]
        return item.decode(self.data(name)) if item.encoding == "sign_magnitude" else signed(item, self[name])

    def data(self, name: str) -> bytes:
        """Return the bytes of an item as they are stored."""
        item = self.table.items[name]
        return bytes(self._memory[item.address : item.address + item.size])

    def refresh_range(self, address: int, length: int) -> None:
        """Set the live items in a range, or at the targets of its Indirect Data, to their present values."""
        cells = self.cells(address, length)
        if cells.direct:
            self.show_range(address, length)
            self._refresh(cells)
            return
        for target, first, last in self.places(address, length):
            self.show_range(target, last - first)
            self._refresh(self.cells(target, last - first))

    def _refresh(self, cells: Cells) -> None:
        for name, show in cells.live:
            wire = show()
            if wire != self._readers[name]()[0]:
                self.show_value(name, wire)

    @property
    def owned(self) -> ctypes.Array[ctypes.c_uint8]:
        """One byte for each cell, 1 if the cell belongs to an item; for compiled code."""
        return (ctypes.c_uint8 * self.size)(*(cell in self._item_at for cell in range(self.size)))

    @property
    def aliases(self) -> ctypes.Array[ctypes.c_int32]:
        """Address of the Indirect Address (2 bytes) for each cell of Indirect Data, -1 for other cells; for
        compiled code."""
        items, found = self.table.items, self._indirect
        addresses = (items[found[cell]].address if cell in found else -1 for cell in range(self.size))
        return (ctypes.c_int32 * self.size)(*addresses)

    def runs(self, address: int, data: bytes) -> tuple[Run, ...]:
        """Return the parts of a write at their actual addresses: the given cells, or the targets of
        Indirect Data."""
        cells = self.cells(address, len(data))
        if cells.direct:
            return (self._run(address, data, cells),)
        return tuple(
            self._run(target, data[first:last], self.cells(target, last - first))
            for target, first, last in self.places(address, len(data))
        )

    def places(self, address: int, length: int) -> list[tuple[int, int, int]]:
        """Return the actual locations of a range, resolved through Indirect Data: (target address, first
        index, end index) of each part."""
        places: list[tuple[int, int, int]] = []
        for index in range(length):
            name = self._indirect.get(address + index)
            target = address + index if name is None else self[name]
            if places and places[-1][0] + index - places[-1][1] == target:
                places[-1] = places[-1][0], places[-1][1], index + 1
            else:
                places.append((target, index, index + 1))
        return places

    def cells(self, address: int, length: int) -> Cells:
        """Return the properties of a range of cells; cached."""
        cells = self._cells_at.get((address, length))
        if cells is None:
            spanned = range(address, address + length)
            owned = [item.name for cell in spanned if (item := self._item_at.get(cell)) is not None]
            names = tuple(dict.fromkeys(owned)) if len(owned) == length else ()
            items = tuple(self.table.items[name] for name in names)
            whole = bool(items) and sum(item.size for item in items) == length
            direct = self._indirect.keys().isdisjoint(spanned)
            cells = Cells(
                items,
                frozenset(names),
                whole=whole,
                direct=direct,
                read_only=any(item.access == "R" for item in items),
                eeprom=any(item.area == "EEPROM" for item in items),
                live=tuple((name, self._live[name]) for name in dict.fromkeys(owned) if name in self._live),
            )
            if len(self._cells_at) >= _CELLS_KEPT:
                self._cells_at.clear()
            self._cells_at[address, length] = cells
        return cells

    def _run(self, address: int, data: bytes, cells: Cells) -> Run:
        items = cells.items
        start, all_of_them = address, data
        if items and not cells.whole:  # A partial write leaves the other bytes of an item unchanged
            start, end = items[0].address, items[-1].address + items[-1].size
            before, behind = self._memory[start:address], self._memory[address + len(data) : end]
            all_of_them = bytes(before) + data + bytes(behind)
        after = {
            item.name: int.from_bytes(
                all_of_them[item.address - start : item.address - start + item.size], "little"
            )
            for item in items
        }
        return Run(address, data, cells, after)

    def write_run(self, run: Run) -> None:
        """Store one part of a write that has been accepted, and call the watchers of its items."""
        start, end = run.address, run.address + len(run.data)
        if self._memory[start:end] != run.data:
            self._memory[start:end] = run.data
        if not self._watchers.keys().isdisjoint(run.after):
            self._notify(run.after)


def signed(item: ControlItem, wire: int) -> int:
    """Return an integer on the wire with its sign, if the item is in two's complement."""
    return wire - (wire >> 8 * item.size - 1 << 8 * item.size) if item.signed else wire


def value_range(item: ControlItem) -> tuple[int, int]:
    """Return the range of an item's bytes, as a signed integer if the item is signed."""
    bits = 8 * item.size - item.signed
    return (-1 << bits if item.signed else 0), (1 << bits) - 1


def _place(item: ControlItem) -> tuple[int, int, int, int, int]:
    """Return (start, end, bit mask, lowest, highest) of an item: its addresses, and the range of its
    bytes."""
    mask = (1 << 8 * item.size) - 1
    return item.address, item.address + item.size, mask, *value_range(item)


def _show_nothing(address: int, length: int) -> None:
    """Do nothing: a device has no shaft."""


_FORMATS = {1: "<B", 2: "<H", 4: "<I"}


def _reader(item: ControlItem, memory: bytearray) -> Callable[[], tuple[int, ...]]:
    """Return a function that returns the integer of an item in the memory, as a tuple of one."""
    if item.size in _FORMATS:
        return partial(struct.Struct(_FORMATS[item.size]).unpack_from, memory, item.address)
    return lambda: (int.from_bytes(memory[item.address : item.address + item.size], "little"),)


def _indirect_cells(table: ControlTable) -> dict[int, str]:
    cells = {}
    for name in table.items:
        match = _INDIRECT.fullmatch(name)
        if match and (data := table.items.get(f"indirect_data_{match[1]}")) is not None:
            cells[data.address] = name
    return cells
