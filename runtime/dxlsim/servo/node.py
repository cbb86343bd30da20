"""Node: base class of the units on a simulated line, servos and other devices: instructions, replies, and
disturbances.

Subclasses implement the meaning of the registers: `simulated_servo` has a shaft, `simulated_device` shows
the measurements of a board."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar, TypeVar

import msgspec

from dxlsim.registers.access import ErrorOf, refusal
from dxlsim.registers.memory import Memory, Run
from dxlsim.wire import servo_protocol1, servo_protocol2
from dxlsim.wire.servo_packets import (
    BROADCAST,
    GroupRead,
    Instruction,
    InstructionPacket,
    ListedWrites,
    ReadEntry,
    ServoReply,
)
from dxlwire.control_table import ControlTable

Answer = tuple[int, bytes]  # Error and parameters of a reply


class ServoCounts(msgspec.Struct):
    """Counters of the packets of one servo or device since the start of the simulation."""

    received: int = 0  # Intact instructions to it, including broadcasts
    replied: int = 0
    last_error: int = 0  # Error of its last reply, as in the packet

    def reply(self, error: int) -> None:
        """Count a reply with this error."""
        self.replied += 1
        self.last_error = error


class SimulatedNode(ABC):
    """One servo or device on a simulated line. The bus calls `execute_packet` and `reply_to_group_read`;
    faults and tests call the rest.

    `note` is called with a text about each refusal and each fault."""

    kind: ClassVar[str]  # Word for the node in notes
    answers_damaged = False
    """True: a packet with a wrong checksum is answered by the manual's error; False: it is never answered
    [?]."""

    def __init__(self, memory: Memory, error_of: ErrorOf, note: Callable[[str], None], now_ns: int) -> None:
        self._codec = servo_protocol1.CODEC if memory.table.protocol == 1.0 else servo_protocol2.CODEC
        self._error_of = error_of
        self.registers = memory  # Control items by name, as integers on the wire
        self.note = note
        self.counts = ServoCounts()
        self.servo_id = 0  # ID (3 or 7)
        self.secondary_id: int | None = None
        """Secondary ID (12), to which the node listens but never replies; None: it has none, or the feature
        is off.

        253 to 255 switch it off, and the ID has priority (e-Manual, X series)."""
        self._silent = False
        self._contacts: list[Callable[[], bool]] = []
        """Functions that return True if the cable has contact when an instruction arrives; all must."""
        self._later_ns = 0  # Additional delay of its replies
        self._deaf_until_ns = now_ns
        """Time (ns) until which the node boots or processes a write, and receives nothing."""
        self._delay_ns = 0  # Return Delay Time (5, 9)
        memory.show_live(self._live_items())
        memory.watch_items(("return_delay_time",), self._set_delay)

    @property
    def called(self) -> str:
        """Name of the node in notes of the ledger: `servo 3`."""
        return f"{self.kind} {self.servo_id}"

    def _set_delay(self) -> None:
        self._delay_ns = self.registers.get("return_delay_time") * 2000 + self._later_ns

    # Interface to the bus

    def listens_to(self, servo_id: int) -> bool:
        """Return True if an instruction to `servo_id`, or a broadcast, is for this node."""
        return servo_id == BROADCAST or servo_id in (self.servo_id, self.secondary_id)

    @property
    def baud_rate(self) -> int:
        """Baud rate of the node according to its registers, bit/s; in Protocol 1.0 also by the formula 2e6
        / (value + 1)."""
        registers = self.registers
        value, rates = registers[baud_item(registers)], registers.table.baud_rates
        return rates.get(value, 2_000_000 // (value + 1) if registers.table.protocol == 1.0 else 0)

    def execute_packet(self, packet: InstructionPacket, now_ns: int) -> ServoReply | None:
        """Execute an instruction whose last byte arrived at `now_ns`; return the reply, or None if the
        node sends none."""
        servo_id = self.servo_id  # A write of ID is still answered with the old ID [i]
        own = packet.servo_id == servo_id
        if not (own or self.listens_to(packet.servo_id)) or not self.receives(now_ns):
            return None
        replies = self._replies_to(packet, own)
        delay_ns = self._delay_of(packet) if replies else 0
        error, parameters = self._obey(packet)
        if error:
            refused = f"{packet.instruction:#04x} {packet.parameters.hex(' ')}"
            self.note(f"{self.kind} {servo_id} refuses {refused}: {self._codec.error(error)!r}")
            self.apply_protection(error)
        return ServoReply(servo_id, error | self._state(), parameters, delay_ns) if replies else None

    def reply_to_group_read(self, read: GroupRead, entry: ReadEntry, now_ns: int) -> ServoReply | None:
        """Return the node's reply to a group read that ended at `now_ns`, or None if it sends none."""
        if not self.receives(now_ns) or not self._takes_part(read):
            return None
        if self.registers.get("status_return_level", 2) < 1:
            return None
        error, data = self._answer_read(entry.address, entry.length)
        if read.fast and error:  # Its format has no room for an error without data [i]
            self._stays_out(read)
            return None
        # In a shared status packet only the first servo waits its Return Delay Time.
        delay_ns = self._later_ns if read.fast and entry is not read.entries[0] else self._delay_ns
        return ServoReply(self.servo_id, error | self._state(), data, delay_ns)

    # Differences between kinds of nodes

    @abstractmethod
    def advance_to(self, now_ns: int) -> None:
        """Advance the node to `now_ns`; an earlier time is ignored."""

    @abstractmethod
    def receives(self, now_ns: int) -> bool:
        """Return True if the node receives an instruction that ends at `now_ns`: it is connected, has
        booted, and is not silenced."""

    @abstractmethod
    def _live_items(self) -> Mapping[str, Callable[[], int]]:
        """Return the items that show present values, each with the function that returns the integer on
        the wire."""

    @abstractmethod
    def _state(self) -> int: ...

    @abstractmethod
    def apply_protection(self, refused: int = 0) -> None:
        """Apply the node's protection, such as a shutdown; `refused` is the error of a refused
        instruction."""

    @abstractmethod
    def power_cycle(self) -> None:
        """Power-cycle the node: its RAM registers return to their initial values."""

    @property
    @abstractmethod
    def voltage(self) -> float:
        """Supply voltage of the node, V."""

    @abstractmethod
    def set_voltage(self, volts: float) -> None:
        """Change the node's supply voltage, V."""

    @abstractmethod
    def _set(self, name: str, wire: int) -> None: ...

    @abstractmethod
    def _takes_part(self, read: GroupRead) -> bool:
        """Return True if the node supports a group read (sync or bulk read), so that it replies."""

    @abstractmethod
    def _written(self, names: frozenset[str]) -> None:
        """Apply the side effects of a write to these items."""

    # Instructions

    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return True if a status packet follows an instruction (Status Return Level). Of the broadcasts only
        a ping is answered.

        A packet with a wrong checksum is not answered, unless `answers_damaged` asks for the manual's
        error.

        Args:
            packet: The instruction.
            own: The instruction is to the node's ID; instructions to the Secondary ID are not answered.
        """
        level = self.registers.get("status_return_level", 2)
        if not packet.intact:
            return own and self.answers_damaged and level >= 2
        if packet.instruction == Instruction.PING:
            return own or packet.servo_id == BROADCAST
        return own and level >= (1 if packet.instruction == Instruction.READ else 2)

    def _delay_of(self, packet: InstructionPacket) -> int:
        if packet.servo_id != BROADCAST or packet.instruction != Instruction.PING:
            return self._delay_ns
        return self._delay_ns + self.servo_id * self._codec.ping_slot_ns(self.baud_rate)

    def _obey(self, packet: InstructionPacket) -> Answer:
        """Execute an instruction and return error and data of its reply; a packet with a wrong checksum is
        not executed."""
        codec, parameters = self._codec, packet.parameters
        if not packet.intact:
            return codec.damaged, b""
        answer: Answer | None = None
        match packet.instruction:
            case Instruction.SYNC_WRITE | Instruction.BULK_WRITE if packet.servo_id == BROADCAST:
                answer = self._write_listed(codec.listed_writes(packet)), b""
            case Instruction.READ if (place := codec.read(parameters)) is not None:
                answer = self._answer_read(*place)
            case Instruction.WRITE if (write := codec.write(parameters)) is not None:
                answer = self._write_to(packet.servo_id, *write), b""
            case Instruction.PING:
                shown = ("model_number", "firmware_version") if codec is servo_protocol2.CODEC else ()
                answer = 0, b"".join(self.registers.data(name) for name in shown)
        return (self._manage(packet), b"") if answer is None else answer

    def _manage(self, packet: InstructionPacket) -> int:
        """Execute an instruction other than reads and writes; return the error, which for an unknown one
        is not 0."""
        return self._codec.unknown

    def _stays_out(self, read: GroupRead) -> None:
        self.note(f"{self.called} does not reply to the fast read {read.instruction:#04x}")

    def _answer_read(self, address: int, length: int) -> Answer:
        """Return error and bytes for a read; cells between items are 0 [i]."""
        data = self.registers.read_bytes(address, length)
        return (self._codec.no_cells, b"") if data is None else (0, data)

    def _write_to(self, servo_id: int, address: int, data: bytes) -> int:
        return self._beyond_shadow(servo_id, address, data) or self._write(address, data)

    def _beyond_shadow(self, servo_id: int, address: int, data: bytes) -> int:
        """Return the error for a write to the EEPROM through the Secondary ID, 0 for any other write."""
        shadow = servo_id == self.secondary_id and self.registers.reaches_eeprom(address, data)
        return servo_protocol2.StatusErrorNumber.ACCESS if shadow else 0

    def _write_listed(self, writes: ListedWrites | None) -> int:
        """Execute those writes of a sync or bulk write that are for this node, in list order; its
        Secondary ID counts as well [i].

        Returns:
            The last error; in Protocol 1.0 all error bits.
        """
        if writes is None:
            return self._codec.unknown  # None of the list is executed [i]
        error, secondary = 0, self.secondary_id
        listed = writes.get(self.servo_id, ())
        if secondary is not None and secondary in writes:
            listed = sorted((*listed, *writes[secondary]))
        for _, servo_id, address, data in listed:
            before = error if self._codec is servo_protocol1.CODEC else 0
            error = before | self._write_to(servo_id, address, data)
        return error

    def _write(self, address: int, data: bytes) -> int:
        """Execute a write; return 0, or the error if the write is rejected."""
        runs = self.registers.runs(address, data)
        if error := self._refused(runs):
            return error
        for run in runs:
            self.registers.write_run(run)
            self._written(run.cells.names)
        return 0

    def _refused(self, runs: Iterable[Run]) -> int:
        return next((error for run in runs if (error := self._refusal(run))), 0)

    def _refusal(self, run: Run) -> int:
        return refusal(self.registers, run, self._error_of)

    # Interface for faults

    def silence(self, on: bool = True) -> None:
        """Cut the node's data line, or restore it. A cut node receives and sends nothing, but keeps
        moving."""
        self._silent = on
        self.note(f"{self.called}: data line {'cut' if on else 'restored'}")

    def interrupt(self, contact: Callable[[], bool]) -> None:
        """From now on pass instructions and replies of this node only while `contact` returns True."""
        self._contacts.append(contact)
        self.note(f"{self.called}: cable loose")

    def connect(self, contact: Callable[[], bool]) -> None:
        """Undo `interrupt` with the same function."""
        self._contacts.remove(contact)
        self.note(f"{self.called}: cable connected")

    def reply_later(self, by_ns: int) -> None:
        """Delay each reply by an additional time, ns; 0 ends this."""
        self._later_ns = by_ns
        self._set_delay()
        self.note(f"{self.called}: replies delayed by {by_ns} ns")

    def cut_power(self, until_ns: int) -> None:
        """Cut the node's power until `until_ns`: RAM is lost, and the node receives nothing before."""
        self.power_cycle()
        self._receive_nothing_until(max(self._deaf_until_ns, until_ns))

    def _receive_nothing_until(self, t_ns: int) -> None:
        self._deaf_until_ns = t_ns

    def poke(self, name: str, wire: int) -> None:
        """Set a register to an integer on the wire, without checks, as if it had been set before."""
        self.note(f"{self.called}: {name} set to {wire}")
        self._set(name, wire)


Node = TypeVar("Node", bound=SimulatedNode)


def baud_value(table: ControlTable, baud_rate: int) -> int:
    """Return the value of a model's baud rate item for a rate, bit/s.

    Raises:
        ValueError: The model does not support the rate.
    """
    for value, rate in table.baud_rates.items():
        if rate == baud_rate:
            return value
    value = round(2_000_000 / baud_rate) - 1  # e-Manual, Baud Rate (4): 2,000,000 / (value + 1)
    if table.protocol != 1.0 or not 0 <= value <= 254:
        raise ValueError(f"{table.model}: no baud rate near {baud_rate} bit/s")
    return value


def baud_item(memory: Memory) -> str:
    """Return the name of the item with the baud rate of the bus; the Y series has two rates."""
    return "baud_rate" if "baud_rate" in memory else "baud_rate_bus"
