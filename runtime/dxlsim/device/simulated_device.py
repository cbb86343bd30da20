"""Simulated device: a unit whose registers show measurements and keep written values; no torque, no motion.

It supports ping, read and write, and the other instructions of its control table. It does not answer
unknown instructions, like boards with ROBOTIS' Dynamixel2Arduino (utility/slave.cpp, processInst). Its
EEPROM is never locked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from random import Random
from types import MappingProxyType

from msgspec.structs import replace

from dxlsim.device.device_quantities import DeviceQuantities, make_readers
from dxlsim.registers.access import device_error
from dxlsim.registers.memory import Memory
from dxlsim.servo.node import (
    BULK_READ,
    FAST_BULK_READ,
    FAST_SYNC_READ,
    SYNC_READ,
    Answer,
    SimulatedNode,
    baud_value,
)
from dxlsim.simulation_plan import DeviceConfig
from dxlsim.wire.servo_packets import Instruction, InstructionPacket
from dxlwire.control_table import ControlItem, ControlTable
from dxlwire.control_table.device_models import device_table
from dxlwire.control_table.device_table import WAITS, DeviceTable, read_device_table

CHAIN_WAIT_NS = 50_000_000
"""Time (ns) for which a board with `waits_in_chain` waits for the status before its own (ROBOTIS' OpenCR
firmware, built natively); each other status restarts it."""
BOOT_NS = 100_000_000  # Time without reception after a reboot [i]


class SimulatedDevice(SimulatedNode):
    """One simulated device. The line calls `receives`, `present`, `execute_packet`, `chain` and `overhear`;
    faults and tests call the rest."""

    kind = "device"

    def __init__(
        self,
        table: DeviceTable,
        config: DeviceConfig,
        world: DeviceQuantities,
        *,
        baud_rate: int,
        note: Callable[[str], None],
        now_ns: int,
    ) -> None:
        self.table = table
        self._line_rate = baud_rate
        self.link = config.shown.link
        """Link of the robot's URDF that carries the device; empty: the device is upright and at rest."""
        self.world = world  # Quantities that it measures
        self.now_ns = now_ns
        self._bits = {name: (item.address, item.size, item.bit) for name, item in table.items.items()}
        random = Random(f"{config.servo_id} {table.model}")  # A seed of its own makes the noise repeatable
        self._shown = make_readers(table.items, config.shown, world, random)
        self._awaited_id: int | None = None  # ID whose status it awaits in a group read
        self._waits_until_ns = 0
        registers = _registers(table)
        self._place_names = {(item.address, item.size): item.name for item in registers.items.values()}
        memory = Memory(registers, registers.items["firmware_version"].initial or 1)
        super().__init__(memory, device_error, note, now_ns)
        self.show_live(self._live_items())
        memory["id"] = config.servo_id
        if "return_delay_time" in memory:
            memory["return_delay_time"] = min(254, round(config.return_delay_ns / 2000))
        if "baud_rate" in memory:
            memory["baud_rate"] = baud_value(registers, baud_rate)
        self._watch_identity()
        self.line.asks = 1
        fast = self.can("fast_sync_read")
        self.line.group_reads = (SYNC_READ | (fast and FAST_SYNC_READ) if self.can("sync_read") else 0) | (
            BULK_READ | (fast and FAST_BULK_READ) if self.can("bulk_read") else 0
        )

    # Interface to the line

    @property
    def baud_rate(self) -> int:
        """Baud rate of the device, bit/s: that of the line if the device has no item for it."""
        return super().baud_rate if "baud_rate" in self.registers else self._line_rate

    def advance_to(self, now_ns: int) -> None:
        """Set the device's time for its measurements; an earlier time is ignored."""
        self.now_ns = max(self.now_ns, now_ns)

    def receives(self, now_ns: int) -> bool:
        """Return True if the device receives an instruction that ends at `now_ns`: it is neither waiting nor
        disconnected."""
        if self._awaited_id is not None and now_ns < self._waits_until_ns:
            self.note(f"{self.called}: ignores instructions until {self._awaited_id} has replied")
            return False
        self._awaited_id = None
        self.advance_to(now_ns)
        return all(contact() for contact in self._contacts)

    def present(self, now_ns: int, address: int, length: int) -> None:
        """Set the registers of a range to their present values."""
        if length:
            self.registers.refresh_range(address, length)

    @property
    def waits(self) -> bool:
        """True if the device's board waits for the status before its own in a group read."""
        return self.can(WAITS)

    def chain(self, listed: Sequence[int], now_ns: int) -> None:
        """Start to wait for the status before the device's own in a group read of these IDs, if its board
        has this behaviour."""
        place = listed.index(self.servo_id) if self.waits and self.servo_id in listed else 0
        hears = not self.is_silent and now_ns >= self.line.deaf_until_ns
        if place and hears and self.receives(now_ns):
            self._awaited_id, self._waits_until_ns = listed[place - 1], now_ns + CHAIN_WAIT_NS

    def overhear(self, servo_id: int, now_ns: int) -> None:
        """Note a status packet of another unit on the line, for which the device may wait."""
        if self._awaited_id == servo_id:
            self._awaited_id = None
        elif self._awaited_id is not None and now_ns < self._waits_until_ns:
            self._waits_until_ns = now_ns + CHAIN_WAIT_NS

    def can(self, capability: str) -> bool:
        """Return True if the device's control table lists a capability."""
        return capability in self.table.capabilities

    # Instructions

    def _knows(self, instruction: int) -> bool:
        needs = {
            Instruction.SYNC_WRITE: "sync_write",
            Instruction.BULK_WRITE: "bulk_write",
            Instruction.REBOOT: "reboot",
        }
        known = (Instruction.PING, Instruction.READ, Instruction.WRITE)
        return instruction in known or (instruction in needs and self.can(needs[Instruction(instruction)]))

    def execute_packet(self, packet: InstructionPacket, now_ns: int) -> Answer | None:
        """Execute an instruction other than a read. Of the broadcasts only a ping is answered, if
        supported."""
        replies = self._knows(packet.instruction) and (
            packet.servo_id == self.servo_id or self.can("broadcast_ping")
        )
        answer = super().execute_packet(packet, now_ns)
        return answer if replies else None

    def _obey(self, packet: InstructionPacket) -> Answer:
        known = packet.intact and self._knows(packet.instruction)
        return super()._obey(packet) if known else (0, b"")

    def _manage(self, packet: InstructionPacket) -> int:
        if packet.instruction != Instruction.REBOOT:
            return super()._manage(packet)
        self.power_cycle()
        self._receive_nothing_until(self.now_ns + BOOT_NS)
        return 0

    def _written(self, names: frozenset[str]) -> None:
        """Do nothing: writes to a device only change its registers."""

    # Live items

    def _live_items(self) -> Mapping[str, Callable[[], int]]:
        live = {name: show for name, show in self._shown.items() if self.table.items[name].bit is None}
        for item in _registers(self.table).items.values():
            bits = {
                each.bit: self._shown[each.name]
                for each in self.table.items.values()
                if each.bit is not None and each.address == item.address and each.name in self._shown
            }
            if bits:
                live[item.name] = _put_together(bits)
        return live

    def _set(self, name: str, wire: int) -> None:
        """Set an item to an integer without a write instruction; the item no longer shows a measurement."""
        address, size, bit = self._bits[name]
        place = self._place_names[address, size]
        if bit is not None:
            wire = self.registers[place] & ~(1 << bit) | wire << bit
        self.registers[place] = wire
        self.registers.show_no_more(place)

    # Interface for faults

    def apply_protection(self, refused: int = 0) -> None:
        """Do nothing: a device has no torque that a shutdown could cut."""

    def power_cycle(self) -> None:
        """Power-cycle the device: its RAM registers return to their initial values."""
        self.note(f"{self.called}: power cycle")
        self.registers.restore_ram()

    def tip(self, axis: str, by: float, for_ns: int) -> None:
        """Rotate the device by an angle, rad, about one of its own axes, evenly within a time. The angle
        persists.

        Args:
            axis: x, y or z.
            by: Angle, rad.
            for_ns: Duration, ns.
        """
        begin_ns = self.now_ns

        def angle() -> tuple[float, float]:
            share = (self.now_ns - begin_ns) / for_ns
            return (by, 0.0) if share >= 1.0 else (by * share, by * 1e9 / for_ns)

        self.world.tip(axis, angle)
        self.note(f"{self.called}: tilted by {math.degrees(by):g} deg about {axis}")

    def set_voltage(self, volts: float) -> None:
        """Change the device's supply voltage, V."""
        self.world.volts = volts
        self.note(f"{self.called}: voltage {volts} V")

    @property
    def voltage(self) -> float:
        """Supply voltage of the device, V."""
        return self.world.volts


def _registers(table: DeviceTable) -> ControlTable:
    """Return a device's items as the control table that `Memory` needs. Bits of one place become one item
    with the first bit's name."""
    items: dict[str, ControlItem] = {}
    places: set[tuple[int, int]] = set()
    for name, item in table.items.items():
        if (item.address, item.size) not in places:
            whole = item if item.bit is None else replace(item, maximum=(1 << 8 * item.size) - 1)
            items[name] = whole
        places.add((item.address, item.size))
    return ControlTable(
        model=table.model,
        aliases=table.aliases,
        model_number=table.model_number or items["model_number"].initial or 0,
        protocol=table.protocol,
        items=MappingProxyType(items),
        baud_rates=table.baud_rates,
        capabilities=table.capabilities,
        # Not used: a device has no shaft
        goal_speed_item="",
        present_speed_item="",
        effort_item="",
        rad_per_tick=0.0,
        min_tick=0,
        max_tick=0,
        rad_s_per_tick=0.0,
        max_speed_tick=0,
        effort_per_tick=0.0,
        effort_unit="1",
        max_speed=0.0,
        stall_torque=0.0,
    )


def make_device(
    config: DeviceConfig,
    protocol: float,
    world: DeviceQuantities,
    *,
    baud_rate: int,
    note: Callable[[str], None],
    now_ns: int,
) -> SimulatedDevice:
    """Return a simulated device of a model that was just switched on at a baud rate, bit/s.

    Raises:
        LookupError: The model has no table of the protocol.
        ValueError: The model does not support the baud rate.
    """
    table = (
        read_device_table(config.shown.table) if config.shown.table else device_table(config.model, protocol)
    )
    return SimulatedDevice(table, config, world, baud_rate=baud_rate, note=note, now_ns=now_ns)


def _put_together(bits: Mapping[int, Callable[[], int]]) -> Callable[[], int]:
    return lambda: sum((show() & 1) << bit for bit, show in bits.items())
