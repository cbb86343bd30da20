"""The memory of a simulated servo: control items as bytes, and which writes it refuses.

Where the e-Manual says nothing, `[i]` marks what was inferred.
"""

from __future__ import annotations

from dxlrun.control_table import ControlItem, ControlTable
from dxlrun.simulation.packets import ErrorBit

FIRMWARE_VERSION = 24
"""What a simulated servo says of its firmware; the manual gives no number."""


class Registers:
    """Bytes of a control table; values are the integers of the wire."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self._memory = bytearray(table.size)
        self._values: dict[str, int] = {}  # the same as in the bytes: looked up far more often than written
        self._names_at: dict[
            tuple[int, int], tuple[str, ...]
        ] = {}  # hosts write the same cells again and again
        self._item_at: dict[int, ControlItem] = {
            address: item
            for item in table.items.values()
            for address in range(item.address, item.address + item.size)
        }
        self.restore_factory_values()

    def restore_factory_values(self) -> None:
        """Set every item to its initial value, and those without one to 0."""
        for item in self.table.items.values():
            self[item.name] = item.initial or 0
        self["firmware_version"] = FIRMWARE_VERSION

    def restore_ram(self) -> None:
        """Set the items of the RAM area to what they are at power-up; the EEPROM area stays."""
        for item in self.table.items.values():
            if item.area == "RAM":
                self[item.name] = item.initial or 0
        self["torque_limit"] = self["max_torque"]  # e-Manual, Torque Limit (34)

    def __getitem__(self, name: str) -> int:
        return self._values[name]

    def __setitem__(self, name: str, wire: int) -> None:
        if self._values.get(name) == wire:
            return
        item = self.table.items[name]
        self._memory[item.address : item.address + item.size] = wire.to_bytes(item.size, "little")
        self._values[name] = wire

    def ticks(self, name: str) -> int:
        """Return the signed number of ticks of an item."""
        item = self.table.items[name]
        return item.decode(self._memory[item.address : item.address + item.size])

    def read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table, None where it has none."""
        if length < 1 or address + length > len(self._memory):
            return None
        return bytes(self._memory[address : address + length])

    def refusal(self, address: int, data: bytes) -> int:
        """Return the error bits with which a write would be refused; 0 when it would not.

        A write is refused as a whole [i]. A cell that no item owns, a read-only item, a locked one and a
        value out of its range are each a range error [i]; a goal outside the angle limits is an angle limit
        error (e-Manual, Goal Position (30)).
        """
        names = self._names(address, len(data))
        if not names:
            return ErrorBit.RANGE
        new = self._memory[:]
        new[address : address + len(data)] = data
        error = 0
        for name in names:
            item = self.table.items[name]
            wire = int.from_bytes(new[item.address : item.address + item.size], "little")
            error |= self._refusal_of(item, wire)
        return error

    def write(self, address: int, data: bytes) -> tuple[str, ...]:
        """Write bytes that were not refused; return the names of the items that they touch."""
        names = self._names(address, len(data))
        self._memory[address : address + len(data)] = data
        for name in names:
            item = self.table.items[name]
            self._values[name] = int.from_bytes(
                self._memory[item.address : item.address + item.size], "little"
            )
        return names

    @property
    def wheel_mode(self) -> bool:
        """True when both angle limits are 0 (e-Manual, CW/CCW Angle Limit (6, 8))."""
        return self["cw_angle_limit"] == 0 and self["ccw_angle_limit"] == 0

    def _names(self, address: int, length: int) -> tuple[str, ...]:
        """Return the items of some cells, none when a cell belongs to no item."""
        names = self._names_at.get((address, length))
        if names is None:
            items = [self._item_at.get(cell) for cell in range(address, address + length)]
            owned = [item.name for item in items if item is not None]
            names = tuple(dict.fromkeys(owned)) if len(owned) == length else ()
            self._names_at[address, length] = names
        return names

    def _refusal_of(self, item: ControlItem, wire: int) -> int:
        if item.access == "R" or not item.minimum <= wire <= item.maximum:
            return ErrorBit.RANGE
        if self["lock"] == 1 and (item.area == "EEPROM" or (item.name == "lock" and wire == 0)):
            return ErrorBit.RANGE
        if self.wheel_mode:
            return 0
        if item.name == "moving_speed" and wire > self.table.max_speed_tick:
            return ErrorBit.RANGE  # the direction bit belongs to wheel mode: "0 ~ 1,023 can be used"
        if item.name == "goal_position" and not self["cw_angle_limit"] <= wire <= self["ccw_angle_limit"]:
            return ErrorBit.ANGLE_LIMIT
        return 0
