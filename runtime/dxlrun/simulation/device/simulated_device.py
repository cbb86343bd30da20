"""A simulated device: registers that show what it measures and keep what is written; no torque, no motion.

It knows ping, read and write, and of the others what its control table names. An instruction that it does not
know stays without a reply, as of boards with the maker's Dynamixel2Arduino (utility/slave.cpp, processInst).
Its EEPROM is never locked.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from random import Random
from types import MappingProxyType

from msgspec.structs import replace

from dxlrun.dynamixel.control_table import ControlItem, ControlTable
from dxlrun.dynamixel.control_table.device_table import WAITS, DeviceTable, read_device_table
from dxlrun.dynamixel.control_table.devices import device_table
from dxlrun.plan.simulation_plan import DeviceConfig
from dxlrun.simulation.device.measured import Measured, shown
from dxlrun.simulation.servo.memory import IDENTITY, Memory, Run, in_range
from dxlrun.simulation.servo.node import Answer, SimulatedNode
from dxlrun.simulation.wire import protocol1, protocol2
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry
from dxlrun.simulation.wire.protocol1 import ErrorBit
from dxlrun.simulation.wire.protocol2 import ErrorNumber, bulk_writes, sync_writes

CHAIN_WAIT_NS = 50_000_000
"""How long a board that `waits_in_chain` waits for the status ahead of its own (ROBOTIS' OpenCR firmware,
built natively); each other status restarts it."""
BOOT_NS = 100_000_000  # How long it receives nothing after a reboot [i]
_BULK = (protocol2.Instruction.BULK_READ, protocol2.Instruction.FAST_BULK_READ)
_Instruction1, _Instruction2 = protocol1.Instruction, protocol2.Instruction


class SimulatedDevice(SimulatedNode):
    """One device: the bus calls `execute` and `reply_to_group_read`; faults and tests do the rest."""

    kind = "device"

    def __init__(
        self,
        table: DeviceTable,
        config: DeviceConfig,
        world: Measured,
        *,
        baud_rate: int,
        note: Callable[[str], None],
        now_ns: int,
    ) -> None:
        self.table = table
        self._line_rate = baud_rate
        self.link = config.link
        """Link of the robot's URDF with which it moves; empty: it stands upright and still."""
        self.world = world  # What it measures
        self.now_ns = now_ns
        self._bits = {name: (item.address, item.size, item.bit) for name, item in table.items.items()}
        random = Random(f"{config.servo_id} {table.model}")  # noise repeats itself
        self._shown = shown(table.items, config, world, random)
        self._still = not config.noise and not config.link
        self._awaited_id: int | None = None  # Whose status it waits for in a group read
        self._waits_until_ns = 0
        registers = _registers(table)
        self._place_names = {(item.address, item.size): item.name for item in registers.items.values()}
        super().__init__(Memory(registers, registers.items["firmware_version"].initial or 1), note, now_ns)
        memory = self.registers
        memory["id"] = config.servo_id
        if "return_delay_time" in memory:
            memory["return_delay_time"] = min(254, round(config.return_delay_ns / 2000))
        if "baud_rate" in memory:
            memory["baud_rate"] = _baud_value(table, baud_rate)
        memory.watch(IDENTITY, self._identify)

    def _identify(self) -> None:
        self.servo_id = self.registers["id"]

    # What the bus asks

    @property
    def baud_rate(self) -> int:
        """The rate at which it listens, bit/s: that of the line where it has no item for it."""
        return super().baud_rate if "baud_rate" in self.registers else self._line_rate

    def advance(self, now_ns: int) -> None:
        """Bring what it measures to a time; going back is ignored."""
        self.now_ns = max(self.now_ns, now_ns)

    def receives(self, now_ns: int) -> bool:
        """Take an instruction on the line at a time; return whether it reaches the device."""
        if self._silent or now_ns < self._deaf_until_ns:
            return False
        if self._awaited_id is not None and now_ns < self._waits_until_ns:
            self.note(f"{self.called}: waits for the status of {self._awaited_id}, and obeys nothing")
            return False
        self._awaited_id = None
        self.advance(now_ns)
        return all(contact() for contact in self._contacts)

    def chain(self, read: GroupRead, now_ns: int) -> None:
        """Wait for the status ahead of its own in a group read, if it is a board that does."""
        listed = [entry.servo_id for entry in read.entries]
        place = listed.index(self.servo_id) if self.can(WAITS) and self.servo_id in listed else 0
        if place and self.receives(now_ns):
            self._awaited_id, self._waits_until_ns = listed[place - 1], now_ns + CHAIN_WAIT_NS
            self.registers.version += 1

    def overhear(self, servo_id: int, now_ns: int) -> None:
        """Take notice of a status packet on the line."""
        if self._awaited_id == servo_id:
            self._awaited_id = None
        elif self._awaited_id is not None and now_ns < self._waits_until_ns:
            self._waits_until_ns = now_ns + CHAIN_WAIT_NS

    def lasts(self, entry: ReadEntry) -> bool:
        """Return whether it replies the same until a servo moves or something is written."""
        return self._still and super().lasts(entry)

    def can(self, capability: str) -> bool:
        """Return whether it knows an instruction, in the words of control tables."""
        return capability in self.table.capabilities

    # Instructions

    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows: of broadcasts only to a ping, if it takes part in that."""
        if not packet.intact or not self._knows(packet.instruction):
            return False
        if packet.instruction == _Instruction2.PING:  # of both protocols
            return own or self.can("broadcast_ping")
        level = 1 if packet.instruction == _Instruction2.READ else 2
        return own and level <= self.registers.get("status_return_level", 2)

    @abstractmethod
    def _knows(self, instruction: int) -> bool: ...

    def _write(self, address: int, data: bytes) -> int:
        """Write, or return the error with which it is refused; 0 when it is not."""
        runs = self.registers.runs(address, data)
        for run in runs:
            if error := self._refusal(run):
                return error
        for run in runs:
            self.registers.write(run)
        return 0

    @abstractmethod
    def _refusal(self, run: Run) -> int: ...

    def _state(self) -> int:
        return 0

    # What it shows

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

    def _by_time(self) -> frozenset[str]:
        return frozenset()

    def _set(self, name: str, wire: int) -> None:
        """Set an item as if it had been so before; what it measured there it shows no more."""
        address, size, bit = self._bits[name]
        place = self._place_names[address, size]
        if bit is not None:
            wire = self.registers[place] & ~(1 << bit) | wire << bit
        self.registers[place] = wire
        self._live.pop(place, None)
        self._windows.clear()

    # What faults do

    def protect(self, refused: int = 0) -> None:
        """Do nothing: a device has no torque to take away."""

    def reset(self) -> None:
        """Cut and give back its power: RAM is lost."""
        self.note(f"{self.called}: power cycle")
        self.registers.restore_ram()

    def tip(self, axis: str, by: float, for_ns: int) -> None:
        """Turn it about one of its own axes, x, y or z, by an angle, rad, evenly in a time; it stays so."""
        begin_ns = self.now_ns

        def angle() -> tuple[float, float]:
            share = (self.now_ns - begin_ns) / for_ns
            return (by, 0.0) if share >= 1.0 else (by * share, by * 1e9 / for_ns)

        self._still = False
        self._windows.clear()
        self.registers.version += 1
        self.world.tip(axis, angle)
        self.note(f"{self.called}: tips by {math.degrees(by):g} deg about {axis}")

    def set_voltage(self, volts: float) -> None:
        """Supply it with another voltage, V."""
        self.world.volts = volts
        self.registers.version += 1
        self.note(f"{self.called}: voltage {volts} V")

    @property
    def voltage(self) -> float:
        """Voltage of the supply, V."""
        return self.world.volts


class Protocol1Device(SimulatedDevice):
    """A device of Protocol 1.0."""

    def _knows(self, instruction: int) -> bool:
        known = {_Instruction1.PING, _Instruction1.READ, _Instruction1.WRITE}
        return instruction in known or (instruction == _Instruction1.SYNC_WRITE and self.can("sync_write"))

    def _describe(self, error: int) -> str:
        return repr(ErrorBit(error))

    def _obey(self, packet: InstructionPacket) -> Answer:
        parameters = packet.parameters
        match packet.instruction:
            case _Instruction1.READ if packet.intact and len(parameters) == 2:
                return self._answer_read(*parameters)
            case _Instruction1.WRITE if packet.intact and len(parameters) >= 2:
                return self._write(parameters[0], parameters[1:]), b""
            case _Instruction1.SYNC_WRITE if packet.intact and self.can("sync_write"):
                self._sync_write(parameters)
        return 0, b""

    def _answer_read(self, address: int, length: int) -> Answer:
        data = self._read(address, length)
        return (ErrorBit.RANGE, b"") if data is None else (0, data)

    def _sync_write(self, parameters: bytes) -> None:
        if len(parameters) < 3 or parameters[1] == 0:
            return
        address, length = parameters[0], parameters[1]
        for start in range(2, len(parameters) - length, length + 1):
            if parameters[start] == self.servo_id:
                self._write(address, parameters[start + 1 : start + 1 + length])

    def _answer_group_read(self, read: GroupRead, entry: ReadEntry) -> Answer | None:
        if not self.can("bulk_read") or self.registers.get("status_return_level", 2) < 1:
            return None
        return self._answer_read(entry.address, entry.length)

    def _refusal(self, run: Run) -> int:
        for item in run.cells.items:
            if item.access == "R" or not in_range(item, run.after[item.name]):
                return ErrorBit.RANGE
        return 0 if run.cells.items else ErrorBit.RANGE


class Protocol2Device(SimulatedDevice):
    """A device of Protocol 2.0."""

    def _knows(self, instruction: int) -> bool:
        needs = {
            _Instruction2.SYNC_WRITE: "sync_write",
            _Instruction2.BULK_WRITE: "bulk_write",
            _Instruction2.REBOOT: "reboot",
        }
        known = (_Instruction2.PING, _Instruction2.READ, _Instruction2.WRITE)
        return instruction in known or (instruction in needs and self.can(needs[_Instruction2(instruction)]))

    def _describe(self, error: int) -> str:
        return repr(ErrorNumber(error))

    def _delay_of(self, packet: InstructionPacket) -> int:
        if packet.servo_id != BROADCAST or packet.instruction != _Instruction2.PING:
            return self._delay_ns
        return self._delay_ns + self.servo_id * protocol2.ping_slot_ns(self.baud_rate)

    def _obey(self, packet: InstructionPacket) -> Answer:
        parameters = packet.parameters
        answer: Answer = 0, b""
        if not packet.intact or not self._knows(packet.instruction):
            return answer
        match packet.instruction:
            case _Instruction2.PING:
                answer = 0, self.registers.data("model_number") + self.registers.data("firmware_version")
            case _Instruction2.READ if len(parameters) == 4:
                answer = self._answer_read(_word(parameters, 0), _word(parameters, 2))
            case _Instruction2.WRITE if len(parameters) >= 3:
                answer = self._write(_word(parameters, 0), parameters[2:]), b""
            case _Instruction2.SYNC_WRITE:
                self._write_listed(sync_writes(parameters))
            case _Instruction2.BULK_WRITE:
                self._write_listed(bulk_writes(parameters))
            case _Instruction2.REBOOT:
                self.reset()
                self._receive_nothing_until(self.now_ns + BOOT_NS)
            case _:
                answer = ErrorNumber.INSTRUCTION, b""
        return answer

    def _write_listed(self, writes: protocol2.ListedWrites | None) -> None:
        for _, _, address, data in (writes or {}).get(self.servo_id, ()):
            self._write(address, data)

    def _answer_read(self, address: int, length: int) -> Answer:
        """Return data; cells between items are 0, as of the maker's Slave class."""
        data = self._read(address, length)
        return (ErrorNumber.ACCESS, b"") if data is None else (0, data)

    def _answer_group_read(self, read: GroupRead, entry: ReadEntry) -> Answer | None:
        need = "bulk_read" if read.instruction in _BULK else "sync_read"
        if not self.can(need) or (read.fast and not self.can("fast_sync_read")):
            return None
        if self.registers.get("status_return_level", 2) < 1:
            return None
        answer = self._answer_read(entry.address, entry.length)
        return None if read.fast and answer[0] else answer

    def _refusal(self, run: Run) -> int:
        cells = run.cells
        if not cells.items or cells.read_only:
            return ErrorNumber.ACCESS
        if not cells.whole:
            return ErrorNumber.DATA_LENGTH
        for item in cells.items:
            if not in_range(item, run.after[item.name]):
                return ErrorNumber.DATA_RANGE
        return 0


def _registers(table: DeviceTable) -> ControlTable:
    """Return a device's items as a control table; bits of one place are one item, of the first bit's name."""
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
        # it has no shaft, so these say nothing
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


def _baud_value(table: DeviceTable, baud_rate: int) -> int:
    for value, rate in table.baud_rates.items():
        if rate == baud_rate:
            return value
    raise ValueError(f"a {table.model} has no baud rate of {baud_rate} bit/s")


def make_device(
    config: DeviceConfig,
    protocol: float,
    world: Measured,
    *,
    baud_rate: int,
    note: Callable[[str], None],
    now_ns: int,
) -> SimulatedDevice:
    """Return a device that was just switched on, and listens at a rate, bit/s.

    Raises LookupError for a model without a table of the protocol, ValueError for a rate that it lacks.
    """
    table = read_device_table(config.table) if config.table else device_table(config.model, protocol)
    kind = Protocol1Device if protocol == 1.0 else Protocol2Device
    return kind(table, config, world, baud_rate=baud_rate, note=note, now_ns=now_ns)


def _put_together(bits: Mapping[int, Callable[[], int]]) -> Callable[[], int]:
    return lambda: sum((show() & 1) << bit for bit, show in bits.items())


def _word(data: bytes, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")
