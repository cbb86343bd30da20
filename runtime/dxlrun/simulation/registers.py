"""The memory of a simulated servo: control items as bytes, and which writes it refuses.

Where the e-Manual says nothing, `[i]` marks what was inferred.
"""

from __future__ import annotations

import struct

from dxlrun.control_table import ControlItem, ControlTable
from dxlrun.simulation.packets import ErrorBit

FIRMWARE_VERSION = 24
"""What a simulated servo says of its firmware; the manual gives no number."""


class Registers:
    """Bytes of a control table; values are the integers of the wire."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self._memory = bytearray(table.size)
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
        item = self.table.items[name]
        return int.from_bytes(self._memory[item.address : item.address + item.size], "little")

    def __setitem__(self, name: str, wire: int) -> None:
        item = self.table.items[name]
        self._memory[item.address : item.address + item.size] = wire.to_bytes(item.size, "little")

    def ticks(self, name: str) -> int:
        """Return the signed number of ticks of an item."""
        item = self.table.items[name]
        return item.decode(self._memory[item.address : item.address + item.size])

    def set_present(self, position: int, speed: int, load: int) -> None:
        """Write the block Present Position (36), Speed (38), Load (40); integers of the wire."""
        start = self.table.items["present_position"].address
        struct.pack_into("<HHH", self._memory, start, position, speed, load)

    def read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table, None where it has none."""
        if length < 1 or address + length > len(self._memory):
            return None
        return bytes(self._memory[address : address + length])

    def refusal(self, address: int, data: bytes) -> ErrorBit:
        """Return why a write would be refused; no bit when it would not.

        A write is refused as a whole [i]. A cell that no item owns, a read-only item, a locked one and a value out of
        its range are each a range error [i]; a goal outside the angle limits is an angle limit error (e-Manual).
        """
        if not data:
            return ErrorBit.RANGE
        names = self._names(address, len(data))
        if names is None:
            return ErrorBit.RANGE
        new = self._memory[:]
        new[address : address + len(data)] = data
        error = ErrorBit(0)
        for name in names:
            item = self.table.items[name]
            wire = int.from_bytes(new[item.address : item.address + item.size], "little")
            error |= self._refusal_of(item, wire)
        return error

    def write(self, address: int, data: bytes) -> frozenset[str]:
        """Write bytes that were not refused; return the names of the items that they touch."""
        self._memory[address : address + len(data)] = data
        return frozenset(self._names(address, len(data)) or ())

    @property
    def wheel_mode(self) -> bool:
        """True when both angle limits are 0 (e-Manual, CW/CCW Angle Limit (6, 8))."""
        return self["cw_angle_limit"] == 0 and self["ccw_angle_limit"] == 0

    def _names(self, address: int, length: int) -> list[str] | None:
        names: list[str] = []
        for cell in range(address, address + length):
            item = self._item_at.get(cell)
            if item is None:
                return None
            if not names or names[-1] != item.name:
                names.append(item.name)
        return names

    def _refusal_of(self, item: ControlItem, wire: int) -> ErrorBit:
        if item.access == "R" or not item.minimum <= wire <= item.maximum:
            return ErrorBit.RANGE
        locked = self["lock"] == 1
        if locked and (item.area == "EEPROM" or (item.name == "lock" and wire == 0)):
            return ErrorBit.RANGE
        if self.wheel_mode:
            return ErrorBit(0)
        if item.name == "moving_speed" and wire > self.table.max_speed_tick:
            return ErrorBit.RANGE  # the direction bit belongs to wheel mode: "0 ~ 1,023 can be used"
        if item.name == "goal_position" and not self["cw_angle_limit"] <= wire <= self["ccw_angle_limit"]:
            return ErrorBit.ANGLE_LIMIT
        return ErrorBit(0)
