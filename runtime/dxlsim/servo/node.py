"""Node: base class of the units on a simulated line, servos and other devices: instructions other than reads,
and disturbances.

The line in C answers reads from the registers. Subclasses implement the meaning of the registers:
`simulated_servo` has a shaft, `simulated_device` shows the measurements of a board."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar, NamedTuple, TypeVar

from dxlsim.registers.access import ACCESS, ErrorOf, refusal
from dxlsim.registers.memory import Memory, Run
from dxlsim.wire import servo_protocol1, servo_protocol2
from dxlsim.wire.compiled_line import NodeState
from dxlsim.wire.servo_packets import BROADCAST, Instruction, InstructionPacket, ListedWrites
from dxlwire.control_table import ControlTable

Answer = tuple[int, bytes]  # Error and parameters of a reply

SYNC_READ, BULK_READ, FAST_SYNC_READ, FAST_BULK_READ = 1, 2, 4, 8
"""Bits of the group reads to which a node replies."""


class ServoCounts(NamedTuple):
    """Counters of the packets of one servo or device since the start of the simulation."""

    received: int  # Intact instructions to it, including broadcasts
    replied: int
    last_error: int  # Error of its last reply, as in the packet


class SimulatedNode(ABC):
    """One servo or device on a simulated line. The line calls `receives`, `present`, `execute_packet` and
    `decline_group_read`; faults and tests call the rest.

    `note` is called with a text about each refusal and each fault."""

    kind: ClassVar[str]  # Word for the node in notes

    def __init__(self, memory: Memory, error_of: ErrorOf, note: Callable[[str], None], now_ns: int) -> None:
        self._codec = servo_protocol1.CODEC if memory.table.protocol == 1.0 else servo_protocol2.CODEC
        self._error_of = error_of
        self.registers = memory  # Control items by name, as integers on the wire
        self.note = note
        self._owned, self._aliases = memory.owned, memory.aliases
        self.line = NodeState(
            memory=ctypes.addressof(memory.image),
            owned=ctypes.addressof(self._owned),
            alias=ctypes.addressof(self._aliases),
            size=memory.size,
            has_gaps=1,
            speaks=1,
            secondary_id=-1,
            now_ns=now_ns,
            deaf_until_ns=now_ns,
            level_at=_address(memory, "status_return_level"),
            error_at=-1,
        )
        """State of the node that the line uses: its ID and rate, when it receives, how it replies."""
        self._contacts: list[Callable[[], bool]] = []
        """Functions that return True if the cable has contact when an instruction arrives; all must."""
        memory.watch_items(("return_delay_time",), self._set_delay)

    def show_live(self, live: Mapping[str, Callable[[], int]]) -> None:
        """Let functions provide the values of items, also of those that show the motion."""
        self.registers.show_live(live)
        self.line.show = None

    @property
    def called(self) -> str:
        """Name of the node in notes of the ledger: `servo 3`."""
        return f"{self.kind} {self.servo_id}"

    @property
    def servo_id(self) -> int:
        """ID (3 or 7)."""
        return int(self.line.id)

    @property
    def secondary_id(self) -> int | None:
        """Secondary ID (12), to which the node listens but never replies; None: it has none, or the feature
        is off.

        253 to 255 switch it off, and the ID has priority (e-Manual, X series)."""
        return None if self.line.secondary_id < 0 else int(self.line.secondary_id)

    @property
    def counts(self) -> ServoCounts:
        """Counters of the node's packets."""
        return ServoCounts(self.line.received, self.line.replied, self.line.last_error)

    @property
    def answers_damaged(self) -> bool:
        """True: a packet with a wrong checksum is answered by the manual's error; False: it is never
        answered [?]."""
        return bool(self.line.answers_damaged)

    @answers_damaged.setter
    def answers_damaged(self, on: bool) -> None:
        self.line.answers_damaged = on

    @property
    def is_silent(self) -> bool:
        """True while the node's data line is cut."""
        return bool(self.line.silent)

    def _set_delay(self) -> None:
        self.line.delay_ns = self.registers.get("return_delay_time") * 2000 + self.line.later_ns

    def _watch_identity(self) -> None:
        self.registers.watch_items(ACCESS.identity, self._identify)

    def _identify(self) -> None:
        """Let the line know ID and rate."""
        self.line.id = self.registers["id"]
        self.line.baud_rate = self.baud_rate

    # Interface to the line

    @property
    def baud_rate(self) -> int:
        """Baud rate of the node according to its registers, bit/s; in Protocol 1.0 also by the formula 2e6
        / (value + 1)."""
        registers = self.registers
        value, rates = registers[baud_item(registers)], registers.table.baud_rates
        return rates.get(value, 2_000_000 // (value + 1) if registers.table.protocol == 1.0 else 0)

    @abstractmethod
    def receives(self, now_ns: int) -> bool:
        """Return True if the node receives an instruction that ends at `now_ns`, which it does unless it is
        silent or booting.

        The line asks only if the node's state demands it."""

    @abstractmethod
    def present(self, now_ns: int, address: int, length: int) -> None:
        """Set the registers of a range to their values at `now_ns`, because they are about to be read."""

    def execute_packet(self, packet: InstructionPacket, now_ns: int) -> Answer | None:
        """Execute an instruction other than a read, whose last byte arrived at `now_ns`.

        Returns:
            Error and data for a reply; None: the node never replies to the instruction.
        """
        called = self.called  # A write may change the ID
        error, parameters = self._obey(packet)
        if error:
            self.refuse_instruction(packet, error, called)
        return error, parameters

    def refuse_instruction(self, packet: InstructionPacket, error: int, called: str = "") -> None:
        """Note that an instruction is refused with an error, which may cause a shutdown."""
        refused = f"{packet.instruction:#04x} {packet.parameters.hex(' ')}"
        self.note(f"{called or self.called} refuses {refused}: {self._codec.error(error)!r}")
        self.apply_protection(error)

    def decline_group_read(self, packet: InstructionPacket, entries: int, *, failed: bool) -> None:
        """Note that the node does not reply to a group read of so many entries.

        Args:
            packet: The instruction.
            entries: Number of entries.
            failed: True: it cannot reply with an error; False: it does not support the instruction.
        """
        if failed:
            self._stay_out(packet)

    def _stay_out(self, packet: InstructionPacket) -> None:
        self.note(f"{self.called} does not reply to the fast read {packet.instruction:#04x}")

    # Differences between kinds of nodes

    @abstractmethod
    def advance_to(self, now_ns: int) -> None:
        """Advance the node to `now_ns`; an earlier time is ignored."""

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
    def _written(self, names: frozenset[str]) -> None:
        """Apply the side effects of a write to these items."""

    # Instructions

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

    def _write_to(self, servo_id: int, address: int, data: bytes) -> int:
        return self._beyond_shadow(servo_id, address, data) or self._write(address, data)

    def _beyond_shadow(self, servo_id: int, address: int, data: bytes) -> int:
        """Return the error for a write to the EEPROM through the Secondary ID, 0 for any other write."""
        shadow = servo_id == self.secondary_id and any(
            run.cells.eeprom for run in self.registers.runs(address, data)
        )
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
        self.line.silent = on
        self.note(f"{self.called}: data line {'cut' if on else 'restored'}")

    def interrupt(self, contact: Callable[[], bool]) -> None:
        """From now on pass instructions and replies of this node only while `contact` returns True."""
        self._contacts.append(contact)
        self.line.asks = 1
        self.note(f"{self.called}: cable loose")

    def connect(self, contact: Callable[[], bool]) -> None:
        """Undo `interrupt` with the same function."""
        self._contacts.remove(contact)
        self.note(f"{self.called}: cable connected")

    def reply_later(self, by_ns: int) -> None:
        """Delay each reply by an additional time, ns; 0 ends this."""
        self.line.later_ns = by_ns
        self._set_delay()
        self.note(f"{self.called}: replies delayed by {by_ns} ns")

    def cut_power(self, until_ns: int) -> None:
        """Cut the node's power until `until_ns`: RAM is lost, and the node receives nothing before."""
        self.power_cycle()
        self._receive_nothing_until(max(self.line.deaf_until_ns, until_ns))

    def _receive_nothing_until(self, t_ns: int) -> None:
        self.line.deaf_until_ns = t_ns

    def refuse_reads(self, *addresses: int) -> None:
        """Refuse each read of a range with one of these cells, like firmware that lacks their items."""
        for address in addresses:
            self._owned[address] = 2

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


def _address(memory: Memory, name: str) -> int:
    """Return the address of an item, -1 if the model lacks it."""
    item = memory.table.items.get(name)
    return -1 if item is None else item.address
