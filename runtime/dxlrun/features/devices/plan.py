"""Plan of the devices for the run: the control table items that controllers command."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec

from dxlwire.bus_plan import SIGN

if TYPE_CHECKING:  # the guardian reads no control tables
    from dxlwire.control_table.control_items import ControlItem

HIGHEST_FLOAT32 = 3.4028234663852886e38


class DeviceCommand(msgspec.Struct, frozen=True):
    """One control table item that controllers command; raw number = (value - offset) / scale."""

    name: str  # `led`
    item: str  # name in the control table
    address: int
    size: int
    encoding: Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
    scale: float
    offset: float
    lowest: float  # SI units
    highest: float
    column: int  # column in the commands of sources in the cycle's record
    safe: float | None = None
    """Value to write when no controller commands it and at the end of a run, SI units; None: leave it as it
    is."""

    @classmethod
    def build(cls, name: str, item: ControlItem, column: int) -> DeviceCommand:
        """Return the command for a control table item; `column` is its place in the cycle's record."""
        most = HIGHEST_FLOAT32 * abs(item.scale)
        ends = (item.offset - most, item.offset + most)
        if item.encoding != "float32":
            values = [tick * item.scale + item.offset for tick in (item.minimum, item.maximum)]
            ends = (min(values), max(values))
        return cls(
            name=name,
            item=item.name,
            address=item.address,
            size=item.size,
            encoding=item.encoding,
            scale=item.scale,
            offset=item.offset,
            lowest=ends[0],
            highest=ends[1],
            column=column,
            safe=None if item.safe is None else item.safe * item.scale + item.offset,
        )

    def data(self, value: float) -> bytes:
        """Convert a value in SI units into the item's bytes, little-endian, clamped to its range."""
        exact = (min(max(value, self.lowest), self.highest) - self.offset) / self.scale
        if self.encoding == "float32":
            return struct.pack("<f", exact)
        number = round(exact)
        if self.encoding == "sign_magnitude":
            number = abs(number) | (SIGN if number < 0 else 0)
        return number.to_bytes(self.size, "little", signed=self.encoding == "twos_complement")


DevicesPlan: TypeAlias = Mapping[str, tuple[DeviceCommand, ...]]
"""Commands of each device by the device's name, in the order of the cycle's record."""


def decode_devices(plan: bytes) -> DevicesPlan:
    """Decode the commands of all devices from `Contribution.plan`; empty bytes give an empty mapping."""
    return msgspec.json.decode(plan, type=dict[str, tuple[DeviceCommand, ...]]) if plan else {}
