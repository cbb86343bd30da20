"""A node of a simulated line, a servo or another device: what the bus asks of it, and what cuts it off.

What is behind its registers is a subclass' matter: `simulated_servo` has a shaft, `device` shows what a board
measures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple, TypeVar

import msgspec

from dxlrun.simulation.servo.memory import LiveItem, Memory
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry, ServoReply

_READS_KEPT = 1024
"""So many reads are looked up only once: a host reads few places, rubbish goes everywhere."""

Answer = tuple[int, bytes]  # Error and parameters of a reply


class _Window(NamedTuple):
    live: tuple[LiveItem, ...]  # What changes by itself in it
    lasts: bool  # True: nothing of it does while no servo moves


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

    def __init__(self, memory: Memory, note: Callable[[str], None], now_ns: int) -> None:
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
        self._live = {name: show for name, show in self._live_items().items() if name in memory}
        self._windows: dict[tuple[int, int], _Window] = {}
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
            self.note(f"{self.kind} {servo_id} refuses {refused}: {self._describe(error)}")
            self.protect(error)
        return ServoReply(servo_id, error | self._state(), parameters, delay_ns) if replies else None

    def reply_to_group_read(self, read: GroupRead, entry: ReadEntry, now_ns: int) -> ServoReply | None:
        """Return its part of the reply to an instruction that ended at `now_ns`; None for silence."""
        if not self.receives(now_ns):
            return None
        answer = self._answer_group_read(read, entry)
        if answer is None:
            return None
        # of a status packet that servos share only the first one waits
        delay_ns = 0 if read.fast and entry is not read.entries[0] else self._delay_ns
        return ServoReply(self.servo_id, answer[0] | self._state(), answer[1], delay_ns)

    def lasts(self, entry: ReadEntry) -> bool:
        """Return whether it replies the same until a servo moves or something is written."""
        if self._contacts:
            return False
        places = self.registers.places(entry.address, entry.length)
        return all(self._window(target, last - first).lasts for target, first, last in places)

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
    def _by_time(self) -> frozenset[str]:
        """Return the items that show something else at another time, though nothing moves."""

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
    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows; `own`: the instruction is to the servo's ID."""

    def _delay_of(self, packet: InstructionPacket) -> int:
        return self._delay_ns

    @abstractmethod
    def _obey(self, packet: InstructionPacket) -> Answer: ...

    @abstractmethod
    def _describe(self, error: int) -> str: ...

    @abstractmethod
    def _answer_group_read(self, read: GroupRead, entry: ReadEntry) -> Answer | None: ...

    # Inside

    def _read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table, None where it has none."""
        memory = self.registers
        if length < 1 or address + length > memory.size:
            return None
        if memory.cells(address, length).direct:
            memory.show_all(self._window(address, length).live)
            return memory.raw(address, length)
        for target, first, last in memory.places(address, length):
            memory.show_all(self._window(target, last - first).live)
        return memory.read(address, length)

    def _window(self, address: int, length: int) -> _Window:
        window = self._windows.get((address, length))
        if window is None:
            if len(self._windows) >= _READS_KEPT:
                self._windows.clear()
            names = [name for name in self._live if self.registers.overlaps(name, address, length)]
            live = tuple(self.registers.live(name, self._live[name]) for name in names)
            window = self._windows[address, length] = _Window(live, self._by_time().isdisjoint(names))
        return window

    # What faults do

    def silence(self, on: bool = True) -> None:
        """Cut its data line, or restore it: it receives and sends nothing, and keeps moving."""
        self._silent = on
        self.registers.version += 1
        self.note(f"{self.called}: data line {'cut' if on else 'restored'}")

    def interrupt(self, contact: Callable[[], bool]) -> None:
        """Let instructions and replies of this servo through only where `contact` says so."""
        self._contacts.append(contact)
        self.registers.version += 1
        self.note(f"{self.called}: cable loose")

    def connect(self, contact: Callable[[], bool]) -> None:
        """End what `interrupt` began."""
        self._contacts.remove(contact)
        self.registers.version += 1
        self.note(f"{self.called}: cable has contact")

    def reply_later(self, by_ns: int) -> None:
        """Start each reply later than Return Delay Time; 0: no longer."""
        self._later_ns = by_ns
        self._set_delay()
        self.registers.version += 1
        self.note(f"{self.called}: replies {by_ns} ns later")

    def cut_power(self, until_ns: int) -> None:
        """Cut its power until a time: RAM is lost, and it does and receives nothing before."""
        self.reset()
        self._receive_nothing_until(max(self._deaf_until_ns, until_ns))

    def _receive_nothing_until(self, t_ns: int) -> None:
        self._deaf_until_ns = t_ns
        self.registers.version += 1

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before; the integer of the wire, no refusal."""
        self.note(f"{self.called}: {name} set to {wire}")
        self._set(name, wire)


Node = TypeVar("Node", bound=SimulatedNode)


def baud_item(memory: Memory) -> str:
    """Return the item that decides the rate: the Y series has two."""
    return "baud_rate" if "baud_rate" in memory else "baud_rate_bus"
