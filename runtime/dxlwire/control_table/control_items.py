"""Control tables: classes for the control items of one servo or device model, with addresses and units."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Literal

import msgspec
from msgspec.structs import replace

from dxlwire.control_table.deviation import Deviation, Judgement
from dxlwire.control_table.hardware_errors import HardwareErrors, error_item

Access = Literal["R", "RW"]
Area = Literal["EEPROM", "RAM"]
Encoding = Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
"""Encoding of an item's bytes. `float32`: IEEE 754 binary32, for devices only; its integer on the wire
consists of the same four bytes."""
EffortUnit = Literal["1", "A", "Nm"]

_TITLES = {"id": "ID", "cw": "CW", "ccw": "CCW", "led": "LED", "pwm": "PWM", "shadow": "(Shadow)"}
"""Spelling of words in item titles that are not just capitalized."""
SIGN_BIT = 10
"""Direction bit of items with sign and magnitude: 0 counter-clockwise, 1 clockwise (e-Manual, Present
Speed (38))."""
_HIGHEST_VOLTAGE = 4 / 3
"""Highest voltage as a multiple of the nominal voltage: 16 V of 12 V (e-Manual XM430-W350, Max Voltage
Limit (32)), assumed for all models [i]. Speed is proportional to voltage [i]: that manual gives 46 rpm
at 12 V and 57 rpm at 14.8 V."""


class ControlItem(msgspec.Struct, frozen=True):
    """One control item (register) of a servo or a device: 1, 2 or 4 bytes, little-endian.

    Its value is ticks * scale + offset. Only items of devices use the fields from `offset` on."""

    name: str
    address: int
    size: int
    access: Access
    area: Area
    minimum: int
    """Lowest value in the e-Manual: of the integer on the wire, where a direction bit counts as a bit. With
    two's complement, and for devices, of the signed number. A float32 has the range of the integer of its
    bytes."""
    maximum: int
    initial: int | None
    """Integer on the wire after a factory reset or at power-up; None if the manual gives none."""
    encoding: Encoding
    unit: str
    """SI unit of `scale`; empty for flags, numbers and steps; `1` for a fraction of the maximum."""
    scale: float  # SI units per tick
    page: str  # Section of the model's manual page
    firmware: int = 0  # First firmware version that has the item; 0: every version
    deviation: Deviation | None = None
    """Rule for values other than the factory's; None for a read-only item."""
    offset: float = 0.0  # SI units at tick 0
    state: str = ""  # Name of the item's state: `angular_velocity.x`
    safe: int | None = None
    """Integer on the wire that is written at the end of a run; None: nothing is written."""
    bit: int | None = None
    """Index of the item's bit in an integer shared with other items; None: all bits. A single bit is
    read-only."""

    def encode(self, raw: int) -> bytes:
        """Return the item's bytes for a signed number of ticks.

        Raises:
            ValueError: The number does not fit into the item.
        """
        wire = raw
        if self.encoding == "sign_magnitude":
            if abs(raw) >= 1 << SIGN_BIT:
                raise ValueError(f"{self.name}: {raw} does not fit into {SIGN_BIT} bits and a direction bit")
            wire = abs(raw) | (raw < 0) << SIGN_BIT
        try:
            return wire.to_bytes(self.size, "little", signed=self.encoding == "twos_complement")
        except OverflowError:
            raise ValueError(f"{self.name}: {raw} does not fit into {self.size} bytes") from None

    def decode(self, data: bytes | bytearray | memoryview) -> int:
        """Return the signed number of ticks in the item's bytes.

        Raises:
            ValueError: `data` does not have `size` bytes.
        """
        if len(data) != self.size:
            raise ValueError(f"{self.name}: {self.size} bytes are needed, {len(data)} were given")
        wire = int.from_bytes(data, "little", signed=self.encoding == "twos_complement")
        if self.encoding == "sign_magnitude":
            magnitude = wire & ((1 << SIGN_BIT) - 1)
            return -magnitude if wire >> SIGN_BIT & 1 else magnitude
        return wire

    def value(self, data: bytes | memoryview) -> float:
        """Return the physical value in the item's bytes, in the SI unit of the item."""
        if self.bit is not None:
            return float(self.integer(data))
        ticks: float = struct.unpack("<f", data)[0] if self.encoding == "float32" else self.decode(data)
        return ticks * self.scale + self.offset

    def integer(self, data: bytes | memoryview) -> int:
        """Return the integer in the item's bytes, signed if the item's range is; 0 or 1 for a single bit.
        It keeps a direction bit."""
        if self.signed or self.minimum < 0:
            return self.decode(data)
        wire = int.from_bytes(data, "little")
        return wire if self.bit is None else wire >> self.bit & 1

    def wire_bytes(self, value: int) -> bytes:
        """Return the item's bytes for an integer as in `integer`. Negative numbers are in two's complement
        or have a direction bit."""
        if self.encoding == "sign_magnitude" and value < 0:
            return self.encode(value)
        return value.to_bytes(self.size, "little", signed=value < 0)

    @property
    def title(self) -> str:
        """Title of the item in the e-Manual, with its address: `Torque Enable (24)`."""
        words = (_TITLES.get(word, word.capitalize()) for word in self.name.split("_"))
        return f"{' '.join(words)} ({self.address})"

    @property
    def limited_by(self) -> str:
        """Name of the item that limits this one, such as `pwm_limit` for `goal_pwm`; empty if there is
        none."""
        return "" if self.deviation is None else self.deviation.limited_by

    @property
    def signed(self) -> bool:
        """True if the item's bytes are in two's complement, so that `minimum` may be negative."""
        return self.encoding == "twos_complement"


class BaseControlTable(msgspec.Struct, frozen=True):
    """Control table of one model; base class of the tables of servos and devices."""

    model: str  # The model's own name, even if the lookup used an alias
    aliases: tuple[str, ...]  # Names of other models with the same table
    protocol: float
    items: Mapping[str, ControlItem]
    """Control items by the e-Manual's name in snake_case, in the order of addresses."""
    baud_rates: Mapping[int, int]  # Value of the baud rate item -> bit/s
    capabilities: frozenset[str]  # Capabilities of the model; `CAPABILITIES` explains each word
    errors: HardwareErrors = HardwareErrors()
    """Item that reports the model's hardware errors, with their meaning."""

    @property
    def size(self) -> int:
        """Number of bytes from address 0 to the end of the last item."""
        return max(item.address + item.size for item in self.items.values())

    def has_baud_rate(self, rate: int) -> bool:
        """Return True if the model can run at a baud rate, bit/s.

        In Protocol 1.0 also the rates 2,000,000 / (value + 1) count, within 3 %. A table without rates
        accepts any rate (e-Manual, Baud Rate (4))."""
        if rate in self.baud_rates.values() or not self.baud_rates:
            return True
        if self.protocol != 1.0 or rate <= 0:
            return False
        value = round(2_000_000 / rate) - 1
        return 0 <= value <= 254 and abs(2_000_000 / (value + 1) - rate) < 0.03 * rate

    def readable(self, start: int, end: int) -> bool:
        """Return True if all addresses from `start` up to but not including `end` belong to items, so one
        read may cover them."""
        items = self.items.values()
        known = {address for item in items for address in range(item.address, item.address + item.size)}
        return known.issuperset(range(start, end))

    def spare(self, end: int, most: int) -> int:
        """Return the number of readable bytes from address `end` on, at most `most`; a read may be that
        much longer."""
        return next((count for count in range(most, 0, -1) if self.readable(end, end + count)), 0)


class ControlTable(BaseControlTable, frozen=True, kw_only=True):
    """Control table of one servo model, with its exact units and motor data.

    The angle of a servo is counted from the raw position 0: theta = raw * `rad_per_tick`."""

    model_number: int
    goal_speed_item: str
    """Name of the item with the speed toward the goal: `moving_speed`, `profile_velocity`, or on PRO
    `goal_velocity`."""
    present_speed_item: str
    effort_item: str  # `present_load`, or `present_current` if the model measures its current
    rad_per_tick: float
    min_tick: int
    """Lowest value of goal and present position, ticks; negative if the middle of the travel is 0."""
    max_tick: int  # Highest value of goal and present position
    rad_s_per_tick: float
    max_speed_tick: int  # Highest magnitude of a goal speed
    effort_per_tick: float  # `effort_unit` per tick of `effort_item`
    effort_unit: EffortUnit
    """SI unit of the measured effort. `1`: fraction of the maximum, for a model that measures no torque;
    `A`: motor current."""
    max_speed: float  # No-load speed, rad/s, at `nominal_voltage`
    stall_torque: float  # Nm, at `nominal_voltage`; 0 if the manual gives none
    fast_sync_read_firmware: int | None = None
    """First firmware version that supports fast sync and bulk read; None if the model does not."""
    firmware: int = 0  # First firmware version with this table; 0: every version
    gear_ratio: float = 0.0  # Revolutions of the motor per revolution of the horn; 0 if the manual gives none
    stall_current: float = 0.0  # Current at `stall_torque`, A; 0 if the manual gives none
    nominal_voltage: float = 0.0
    """Voltage to which `max_speed`, `stall_torque` and `stall_current` apply, V; 0 if the manual gives
    none."""

    @property
    def top_speed(self) -> float:
        """Highest speed that the servo can reach, rad/s: without load, at the highest accepted voltage."""
        return self.max_speed * _HIGHEST_VOLTAGE

    def with_firmware(self, firmware: int) -> ControlTable:
        """Return the table as it is for a firmware version, without the items that later versions added."""
        items = {name: item for name, item in self.items.items() if item.firmware <= firmware}
        return self if len(items) == len(self.items) else replace(self, items=MappingProxyType(items))


CAPABILITIES: Mapping[str, str] = {
    "bulk_read": "bulk read",
    "bulk_write": "bulk write",
    "fast_sync_read": "fast sync read and fast bulk read, from `fast_sync_read_firmware` on",
    "indirect": "indirect addresses",
    "hardware_error": "hardware error status or error code, and the alert bit in its replies",
    "operating_mode": "operating modes selected by an item, not by the angle limits",
    "posvel": "goal speed and goal position are adjacent: one write sets both",
    "reboot": "the reboot instruction",
    "state_block": "effort, speed and position are adjacent: one read gets all three",
    "sync_read": "sync read",
    "sync_write": "sync write",
}
"""Words in `ControlTable.capabilities`, with their meaning."""

DERIVED = frozenset({"hardware_error", "indirect", "operating_mode", "posvel", "state_block"})
"""Capabilities that are computed from the items; data files must not list them."""


def derived_capabilities(
    items: Mapping[str, ControlItem], goal_speed: str, present_speed: str, effort: str
) -> frozenset[str]:
    """Return the capabilities in DERIVED that a model has, from the presence and the addresses of its
    items."""
    has = {
        "operating_mode": "operating_mode" in items or "control_mode" in items,
        "hardware_error": error_item(items) != "",
        "indirect": "indirect_address_1" in items,
        "posvel": len(side_by_side((items[goal_speed], items["goal_position"]))) == 1,
        "state_block": len(side_by_side(items[name] for name in (effort, present_speed, "present_position")))
        == 1,
    }
    return frozenset(name for name, yes in has.items() if yes)


def side_by_side(
    items: Iterable[ControlItem], most_bytes: int | None = None
) -> tuple[tuple[ControlItem, ...], ...]:
    """Group items into blocks that one read can fetch: contiguous items, at most `most_bytes` per block."""
    blocks: list[list[ControlItem]] = []
    for item in sorted(items, key=lambda one: one.address):
        end = item.address + item.size
        block = blocks[-1] if blocks else None
        if (
            block is not None
            and block[-1].address + block[-1].size == item.address
            and (most_bytes is None or end - block[0].address <= most_bytes)
        ):
            block.append(item)
        else:
            blocks.append([item])
    return tuple(map(tuple, blocks))


def decoded(items: Iterable[ControlItem], start: int, data: bytes | memoryview) -> dict[str, int]:
    """Decode the items that lie completely inside `data`; return signed ticks by name. `start` is the
    address of the first byte."""
    found: dict[str, int] = {}
    for item in items:
        at = item.address - start
        if 0 <= at <= len(data) - item.size:
            found[item.name] = item.decode(data[at : at + item.size])
    return found


class FoundDeviation(msgspec.Struct, frozen=True):
    """A setting of a servo that differs from the factory value in a way that matters to a run."""

    item: ControlItem
    found: int
    factory: int
    judgement: Judgement
    effect: str  # Effect of the value: a verb with its object
    remedy: str

    @property
    def refused(self) -> bool:
        """True if this value keeps the servo from getting torque."""
        return self.judgement == "refuse"

    @property
    def text(self) -> str:
        """Found and factory value, for a message: `PWM Limit (36) = 100 instead of 885`."""
        return f"{self.item.title} = {self.found} instead of {self.factory}"


def find_deviations(items: Iterable[ControlItem], values: Mapping[str, int]) -> tuple[FoundDeviation, ...]:
    """Return the settings among a servo's values that differ from the factory's and matter, in the order of
    addresses.

    Skipped are items without a value, without a factory value, or with a value that is compared with the
    plan of a run."""
    found: list[FoundDeviation] = []
    for item in items:
        rule, value = item.deviation, values.get(item.name)
        if item.access == "R" or rule is None or rule.planned or value is None:
            continue
        factory = item.initial
        if factory is None:
            factory = values.get(item.limited_by)
            if factory is None or (value and abs(value) >= factory):
                continue  # The item that bounds it may have been lowered since power-up
        judgement = rule.judge_value(value, factory)
        if judgement != "harmless":
            found.append(FoundDeviation(item, value, factory, judgement, rule.effect_of(value), rule.remedy))
    return tuple(found)
