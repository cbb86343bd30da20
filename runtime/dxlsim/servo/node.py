"""A node of a simulated line, a servo or another device: what the bus asks of it, and what cuts it off.

What is behind its registers is a subclass' matter: `simulated_servo` has a shaft, `device` shows what a board
measures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar, TypeVar

import msgspec

from dxlsim.registers.access import ErrorOf, refusal
from dxlsim.registers.memory import Memory, Run
from dxlsim.wire import protocol1, protocol2
from dxlsim.wire.packets import (
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
    """What a servo did on the line since the start."""

    received: int = 0  # Intact instructions to it, those to all servos among them
    replied: int = 0
    last_error: int = 0  # Of its last reply, as in the packet

    def reply(self, error: int) -> None:
        """Count a reply."""
        self.replied += 1
        self.last_error = error


class SimulatedNode(ABC):
    """One node: the bus calls `execute` and `reply_to_group_read`; faults and tests do the rest.

    `note` is called with each refusal and each fault.
    """

    kind: ClassVar[str]  # As notes call it
    answers_damaged = False
    """True: a packet with a wrong checksum is answered by the manual's error; False: never [?]."""

    def __init__(self, memory: Memory, error_of: ErrorOf, note: Callable[[str], None], now_ns: int) -> None:
        self._codec = protocol1.CODEC if memory.table.protocol == 1.0 else protocol2.CODEC
        self._error_of = error_of
        self.registers = memory  # Its control items, by name, as integers of the wire
        self.note = note
        self.counts = ServoCounts()
        self.servo_id = 0  # ID (3 or 7)
        self.secondary_id: int | None = None
        """Secondary ID (12), to which it never replies; None: it has none, or it is off.

        253 to 255 switch it off, and the ID goes first (e-Manual, X series).
        """
        self._silent = False
        self._contacts: list[Callable[[], bool]] = []
        """Each says, when an instruction arrives, whether its cable has contact."""
        self._later_ns = 0  # How much later than its Return Delay Time it replies
        self._deaf_until_ns = now_ns
        """Until then it boots, or works on a write, and receives nothing."""
        self._delay_ns = 0  # Return Delay Time (5, 9)
        memory.show_live(self._live_items())
        memory.watch(("return_delay_time",), self._set_delay)

    @property
    def called(self) -> str:
        """How notes call it: `servo 3`."""
        return f"{self.kind} {self.servo_id}"

    def _set_delay(self) -> None:
        self._delay_ns = self.registers.get("return_delay_time") * 2000 + self._later_ns

    # What the bus asks

    def listens_to(self, servo_id: int) -> bool:
        """Return whether an instruction to an ID, or to all, is for this servo."""
        return servo_id == BROADCAST or servo_id in (self.servo_id, self.secondary_id)

    @property
    def baud_rate(self) -> int:
        """The rate at which it listens, bit/s; in Protocol 1.0 also by the formula 2e6 / (value + 1)."""
        registers = self.registers
        value, rates = registers[baud_item(registers)], registers.table.baud_rates
        return rates.get(value, 2_000_000 // (value + 1) if registers.table.protocol == 1.0 else 0)

    def execute(self, packet: InstructionPacket, now_ns: int) -> ServoReply | None:
        """Obey an instruction whose last byte arrived at `now_ns`; return the reply, None for silence."""
        servo_id = self.servo_id  # a write of ID is still answered under the old one [i]
        own = packet.servo_id == servo_id
        if not (own or self.listens_to(packet.servo_id)) or not self.receives(now_ns):
            return None
        replies = self._replies_to(packet, own)
        delay_ns = self._delay_of(packet) if replies else 0
        error, parameters = self._obey(packet)
        if error:
            refused = f"{packet.instruction:#04x} {packet.parameters.hex(' ')}"
            self.note(f"{self.kind} {servo_id} refuses {refused}: {self._codec.error(error)!r}")
            self.protect(error)
        return ServoReply(servo_id, error | self._state(), parameters, delay_ns) if replies else None

    def reply_to_group_read(self, read: GroupRead, entry: ReadEntry, now_ns: int) -> ServoReply | None:
        """Return its part of the reply to an instruction that ended at `now_ns`; None for silence."""
        if not self.receives(now_ns) or not self._takes_part(read):
            return None
        if self.registers.get("status_return_level", 2) < 1:
            return None
        error, data = self._answer_read(entry.address, entry.length)
        if read.fast and error:  # its form has no room for an error without data [i]
            self._stays_out(read)
            return None
        # of a status packet that servos share only the first one waits its Return Delay Time
        delay_ns = self._later_ns if read.fast and entry is not read.entries[0] else self._delay_ns
        return ServoReply(self.servo_id, error | self._state(), data, delay_ns)

    # What kinds of nodes do differently

    @abstractmethod
    def advance(self, now_ns: int) -> None:
        """Bring what it shows to a time; going back is ignored."""

    @abstractmethod
    def receives(self, now_ns: int) -> bool:
        """Take an instruction on the line at a time; return whether it reaches the node."""

    @abstractmethod
    def _live_items(self) -> Mapping[str, Callable[[], int]]:
        """Return the items that change by themselves: worked out when they are read, not before."""

    @abstractmethod
    def _state(self) -> int: ...

    @abstractmethod
    def protect(self, refused: int = 0) -> None:
        """Do what it does against what may harm it."""

    @abstractmethod
    def reset(self) -> None:
        """Cut and give back its power: RAM is lost."""

    @property
    @abstractmethod
    def voltage(self) -> float:
        """Voltage of its supply, V."""

    @abstractmethod
    def set_voltage(self, volts: float) -> None:
        """Supply it with another voltage, V."""

    @abstractmethod
    def _set(self, name: str, wire: int) -> None: ...

    @abstractmethod
    def _takes_part(self, read: GroupRead) -> bool:
        """Return whether it knows a group read."""

    @abstractmethod
    def _written(self, names: frozenset[str]) -> None:
        """Do what the writing of some items does beside changing them."""

    # Instructions

    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level); of broadcasts only to a ping.

        `own`: the instruction is to the servo's ID; those to the Secondary ID get none. A packet with a wrong
        checksum gets none, unless `answers_damaged` asks for the manual's error.
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
        """Return the answer to an instruction; of a packet with a wrong checksum nothing is obeyed."""
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
                shown = ("model_number", "firmware_version") if codec is protocol2.CODEC else ()
                answer = 0, b"".join(self.registers.data(name) for name in shown)
        return (self._manage(packet), b"") if answer is None else answer

    def _manage(self, packet: InstructionPacket) -> int:
        """Obey what is not reading or writing; return the error, also for what it does not know."""
        return self._codec.unknown

    def _stays_out(self, read: GroupRead) -> None:
        self.note(f"{self.called} does not reply to the fast read {read.instruction:#04x}")

    def _answer_read(self, address: int, length: int) -> Answer:
        """Return data; cells between items are 0 [i]."""
        data = self.registers.read(address, length)
        return (self._codec.no_cells, b"") if data is None else (0, data)

    def _write_to(self, servo_id: int, address: int, data: bytes) -> int:
        return self._beyond_shadow(servo_id, address, data) or self._write(address, data)

    def _beyond_shadow(self, servo_id: int, address: int, data: bytes) -> int:
        """Return the error of a write to the EEPROM through the Secondary ID, 0 of any other."""
        shadow = servo_id == self.secondary_id and self.registers.reaches_eeprom(address, data)
        return protocol2.ErrorNumber.ACCESS if shadow else 0

    def _write_listed(self, writes: ListedWrites | None) -> int:
        """Do the writes of a list to this servo, in its order; a listed Secondary ID counts as well [i].

        Return the last error; of Protocol 1.0 all error bits.
        """
        if writes is None:
            return self._codec.unknown  # and nothing of it is done [i]
        error, secondary = 0, self.secondary_id
        listed = writes.get(self.servo_id, ())
        if secondary is not None and secondary in writes:
            listed = sorted((*listed, *writes[secondary]))
        for _, servo_id, address, data in listed:
            before = error if self._codec is protocol1.CODEC else 0
            error = before | self._write_to(servo_id, address, data)
        return error

    def _write(self, address: int, data: bytes) -> int:
        """Write, or return the error with which it is refused; 0 when it is not."""
        runs = self.registers.runs(address, data)
        if error := self._refused(runs):
            return error
        for run in runs:
            self.registers.write(run)
            self._written(run.cells.names)
        return 0

    def _refused(self, runs: Iterable[Run]) -> int:
        return next((error for run in runs if (error := self._refusal(run))), 0)

    def _refusal(self, run: Run) -> int:
        return refusal(self.registers, run, self._error_of)

    # What faults do

    def silence(self, on: bool = True) -> None:
        """Cut its data line, or restore it: it receives and sends nothing, and keeps moving."""
        self._silent = on
        self.note(f"{self.called}: data line {'cut' if on else 'restored'}")

    def interrupt(self, contact: Callable[[], bool]) -> None:
        """Let instructions and replies of this servo through only where `contact` says so."""
        self._contacts.append(contact)
        self.note(f"{self.called}: cable loose")

    def connect(self, contact: Callable[[], bool]) -> None:
        """End what `interrupt` began."""
        self._contacts.remove(contact)
        self.note(f"{self.called}: cable has contact")

    def reply_later(self, by_ns: int) -> None:
        """Start each reply later than Return Delay Time; 0: no longer."""
        self._later_ns = by_ns
        self._set_delay()
        self.note(f"{self.called}: replies {by_ns} ns later")

    def cut_power(self, until_ns: int) -> None:
        """Cut its power until a time: RAM is lost, and it does and receives nothing before."""
        self.reset()
        self._receive_nothing_until(max(self._deaf_until_ns, until_ns))

    def _receive_nothing_until(self, t_ns: int) -> None:
        self._deaf_until_ns = t_ns

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before; the integer of the wire, no refusal."""
        self.note(f"{self.called}: {name} set to {wire}")
        self._set(name, wire)


Node = TypeVar("Node", bound=SimulatedNode)


def baud_value(table: ControlTable, baud_rate: int) -> int:
    """Return the value of that item for a rate, bit/s. Raises ValueError for one that the model lacks."""
    for value, rate in table.baud_rates.items():
        if rate == baud_rate:
            return value
    value = round(2_000_000 / baud_rate) - 1  # e-Manual, Baud Rate (4): 2,000,000 / (value + 1)
    if table.protocol != 1.0 or not 0 <= value <= 254:
        raise ValueError(f"{table.model}: no baud rate near {baud_rate} bit/s")
    return value


def baud_item(memory: Memory) -> str:
    """Return the item that decides the rate: the Y series has two."""
    return "baud_rate" if "baud_rate" in memory else "baud_rate_bus"
