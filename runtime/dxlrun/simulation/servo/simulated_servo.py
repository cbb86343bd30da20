"""A simulated servo: it receives instructions, replies, moves its shaft, and can be broken.

What both protocols share is here; `protocol1_servo` and `protocol2_servo` have the instructions of each, and
how such a servo protects itself. Where the e-Manual has no answer, `[i]` marks what was inferred; nothing was
compared with a real servo yet.

Not modelled: other protocols than 1.0 and 2.0 on one line (a servo that is set to another one falls silent),
what the two shafts of a 2XL or 2XC share, servos that Drive Mode couples, and what firmware decides beyond
the control table, the fast reads, Clear and Control Table Backup.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import NamedTuple

from dxlrun.simulation.motion.mechanics import SUPPLY_OHM
from dxlrun.simulation.servo.memory import IDENTITY, LiveItem, Memory, Run
from dxlrun.simulation.servo.shaft import Shaft
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry, ServoReply

BOOT_NS = 100_000_000
"""How long a servo receives nothing after a reboot; no manual names it [i]."""

_READS_KEPT = 1024
"""So many reads are looked up only once: a host reads few places, rubbish goes everywhere."""

_BY_TIME = frozenset(("realtime_tick",))
"""What shows something else at another time, though no servo moves and nothing is written."""

_SECONDARY_IDS = ("secondary_shadow_id", "secondary_id")

Answer = tuple[int, bytes]
"""Error and parameters of a reply."""


class _Window(NamedTuple):
    """A row of cells that is read."""

    live: tuple[LiveItem, ...]
    """What changes by itself in it."""
    lasts: bool
    """True: nothing of it does while no servo moves."""


@dataclass(slots=True)
class ServoCounts:
    """What a servo did on the line since the start."""

    received: int = 0
    """Intact instructions to it, those to all servos among them."""
    replied: int = 0
    errors: int = 0
    """Replies with an error."""
    last_error: int = 0
    """Of its last reply, as in the packet."""

    def reply(self, error: int) -> None:
        """Count a reply."""
        self.replied += 1
        self.errors += error != 0
        self.last_error = error


class SimulatedServo(ABC):
    """One servo: the bus calls `execute` and `reply_to_group_read`; faults and tests do the rest.

    `note` is called with each refusal and each fault.
    """

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        self.registers = memory
        """Its control items, by name, as integers of the wire."""
        self.shaft = shaft
        self.note = note
        self.counts = ServoCounts()
        self.overload = False
        """True while the shaft is loaded beyond the torque."""
        self.wakes_on_goal = True
        """Protocol 1.0: writing Goal Position (30) while Torque Enable (24) is 0 sets it to 1 [i]."""
        self.answers_damaged = False
        """True: a packet with a wrong checksum is answered by the manual's error; False: never [?]."""
        self.boot_ns = BOOT_NS
        """How long a reboot or a factory reset by an instruction takes: Protocol 2.0."""
        self.servo_id = 0
        """ID (3 or 7)."""
        self.secondary_id: int | None = None
        """Secondary ID (12), to which it never replies; None: it has none, or it is off.

        253 to 255 switch it off, and the ID goes first (e-Manual, X series).
        """
        self._silent = False
        self._contacts: list[Callable[[], bool]] = []
        """Each says, when an instruction arrives, whether its cable has contact."""
        self._later_ns = 0
        """How much later than its Return Delay Time it replies."""
        self._deaf_until_ns = shaft.now_ns
        """Until then it boots, or works on a write, and receives nothing."""
        self.write_time_ns = 0
        """How long it receives nothing after an instruction that writes."""
        self._speaks = True
        """False when it is set to another protocol."""
        self._delay_ns = 0
        """Return Delay Time (5, 9)."""
        self._started_ns = self._received_ns = shaft.now_ns
        self._registered: tuple[int, bytes] | None = None
        self._live = {name: show for name, show in self._live_items().items() if name in memory}
        self._windows: dict[tuple[int, int], _Window] = {}
        self._secondary_item = next((each for each in _SECONDARY_IDS if each in memory), None)
        self._voltage = 0.0
        self.voltage = _supply(memory)
        shaft.mechanics.watch(shaft.index, self._strained)
        memory.watch(("return_delay_time",), self._set_delay)
        memory.watch(IDENTITY, self._identify)

    def _identify(self) -> None:
        """Take over what it listens to."""
        registers = self.registers
        self.servo_id = registers["id"]
        secondary = None if self._secondary_item is None else registers[self._secondary_item]
        off = secondary is None or secondary > 252 or secondary == self.servo_id
        self.secondary_id = None if off else secondary

    def _set_delay(self) -> None:
        self._delay_ns = self.registers["return_delay_time"] * 2000 + self._later_ns

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

    def advance(self, now_ns: int) -> None:
        """Bring the shaft and the present registers to a time; going back is ignored."""
        self.shaft.advance(now_ns)
        self._refresh()

    def receives(self, now_ns: int) -> bool:
        """Take an instruction on the line at a time; return whether it reaches the servo."""
        if self._silent or now_ns < self._deaf_until_ns or not self._speaks:
            return False
        self.shaft.advance(now_ns)
        if self._contacts and not all(contact() for contact in self._contacts):
            return False
        self._received_ns = self.shaft.now_ns
        return True

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
            self.note(f"servo {servo_id} refuses {refused}: {self._describe(error)}")
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

    # What the protocols do differently

    @abstractmethod
    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows; `own`: the instruction is to the servo's ID."""

    def _delay_of(self, packet: InstructionPacket) -> int:
        """Return how long the servo waits before it replies, ns."""
        return self._delay_ns

    @abstractmethod
    def _obey(self, packet: InstructionPacket) -> Answer: ...

    @abstractmethod
    def _describe(self, error: int) -> str:
        """Return an error in words."""

    @abstractmethod
    def _answer_group_read(self, read: GroupRead, entry: ReadEntry) -> Answer | None:
        """Return the servo's part; None: it does not reply."""

    @abstractmethod
    def _refusal(self, run: Run) -> int:
        """Return the error of a write, 0 when it is allowed."""

    @abstractmethod
    def _state(self) -> int:
        """Return the bits of every reply's error that show the servo's state."""

    @abstractmethod
    def protect(self, refused: int = 0) -> None:
        """Take the torque away when something is wrong for which Shutdown asks."""

    @abstractmethod
    def _start_up(self) -> None: ...

    @abstractmethod
    def _after_write(self, names: AbstractSet[str]) -> None:
        """Do what the writing of some items does beside changing them."""

    # Instructions that both protocols have

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
        """Return what changes by itself in some cells; looked up once."""
        window = self._windows.get((address, length))
        if window is None:
            if len(self._windows) >= _READS_KEPT:
                self._windows.clear()
            names = [name for name in self._live if self.registers.overlaps(name, address, length)]
            live = tuple(self.registers.live(name, self._live[name]) for name in names)
            window = self._windows[address, length] = _Window(live, _BY_TIME.isdisjoint(names))
        return window

    def _write(self, address: int, data: bytes) -> int:
        """Write, or return the error with which it is refused; 0 when it is not."""
        memory = self.registers
        runs = memory.runs(address, data)
        for run in runs:
            if error := self._refusal(run):
                return error
        if self.write_time_ns:
            self._receive_nothing_until(max(self._deaf_until_ns, self._received_ns + self.write_time_ns))
        for run in runs:
            names = run.cells.names
            memory.write(run)
            self._after_write(names)
            self.shaft.plan(names)
        return 0

    def _register(self, address: int, data: bytes) -> int:
        """Keep a write for an Action, or return the error with which it is refused."""
        for run in self.registers.runs(address, data):
            if error := self._refusal(run):
                return error
        self._keep_registered((address, data))
        return 0

    def _act(self) -> int:
        """Do the registered write; return its error."""
        if self._registered is None:
            return 0
        address, data = self._registered
        self._keep_registered(None)
        return self._write(address, data)

    def _keep_registered(self, write: tuple[int, bytes] | None) -> None:
        self._registered = write
        for name in ("registered", "registered_instruction"):
            self.registers.show(name, write is not None)

    def _set(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before, with nothing refused."""
        self.registers[name] = wire
        self.shaft.plan((name,))

    # What time and load do

    def _live_items(self) -> Mapping[str, Callable[[], int]]:
        """Return the items that change by themselves: worked out when they are read, not before."""
        return {
            **self.shaft.live(),
            "present_temperature": lambda: round(self.temperature),
            "present_inverter_temperature": lambda: round(self.temperature),
            "present_motor_temperature": lambda: round(self.temperature),
            "present_voltage": lambda: self._shown_voltage("present_voltage"),
            "present_input_voltage": lambda: self._shown_voltage("present_input_voltage"),
            "realtime_tick": lambda: (self.shaft.now_ns - self._started_ns) // 1_000_000 % 32768,
        }

    def _shown_voltage(self, name: str) -> int:
        drawn = abs(self.shaft.duty * self.shaft.current)
        return round((self._voltage - SUPPLY_OHM * drawn) / self.registers.table.items[name].scale)

    def _strained(self) -> None:
        """It became warmer or colder by a degree, or was overloaded for too long."""
        if not self.overload and self.shaft.mechanics.overloaded(self.shaft.index):
            self._overload(True)
            self.note(f"servo {self.servo_id}: overload, it does not hold its load")
        self.protect()

    def _overload(self, on: bool) -> None:
        self.overload = on
        self.registers.version += 1

    def _refresh(self) -> None:
        """Bring all that can be read to the time."""
        for name, show in self._live.items():
            self.registers.show(name, show())

    def power_up(self) -> None:
        """Start: RAM is as it is at power-up, the shaft stays where it is."""
        self._registered = None
        self._overload(False)
        self.registers.restore_ram()
        self.shaft.power_up()
        self._start_up()
        self.protect()
        self._refresh()

    # What tests see and faults do

    @property
    def position(self) -> float:
        """Angle of the shaft, rad from raw 0, at the time of `advance` or of the last instruction."""
        return self.shaft.angle

    @property
    def velocity(self) -> float:
        """Speed of the shaft, rad/s, counter-clockwise positive."""
        return self.shaft.velocity

    @property
    def torque_on(self) -> bool:
        """True when the motor holds or moves the shaft: torque enabled and its limit not 0."""
        return self.shaft.torque_on

    @property
    def voltage(self) -> float:
        """Voltage of the supply, V; the servo sees less while it draws current."""
        return self._voltage

    @voltage.setter
    def voltage(self, volts: float) -> None:
        self._voltage = volts
        self.shaft.mechanics.supply(self.shaft.index, volts)

    @property
    def temperature(self) -> float:
        """degrees C."""
        return float(self.shaft.mechanics.strain.temperature[self.shaft.index])

    @temperature.setter
    def temperature(self, celsius: float) -> None:
        self.shaft.mechanics.heat(self.shaft.index, celsius)

    def silence(self, on: bool = True) -> None:
        """Cut its data line, or restore it: it receives and sends nothing, and keeps moving."""
        self._silent = on
        self.registers.version += 1
        self.note(f"servo {self.servo_id}: data line {'cut' if on else 'restored'}")

    def interrupt(self, contact: Callable[[], bool]) -> None:
        """Let instructions and replies of this servo through only where `contact` says so."""
        self._contacts.append(contact)
        self.registers.version += 1
        self.note(f"servo {self.servo_id}: cable loose")

    def connect(self, contact: Callable[[], bool]) -> None:
        """End what `interrupt` began."""
        self._contacts.remove(contact)
        self.registers.version += 1
        self.note(f"servo {self.servo_id}: cable has contact")

    def reply_later(self, by_ns: int) -> None:
        """Start each reply later than Return Delay Time; 0: no longer."""
        self._later_ns = by_ns
        self._set_delay()
        self.registers.version += 1
        self.note(f"servo {self.servo_id}: replies {by_ns} ns later")

    def jam(self, on: bool) -> None:
        """Block the shaft, or free it."""
        self.shaft.mechanics.jam(self.shaft.index, on)
        self.note(f"servo {self.servo_id}: shaft {'blocked' if on else 'free'}")

    def reset(self) -> None:
        """Cut and give back its power: RAM is lost, the shaft stays where it is."""
        self.note(f"servo {self.servo_id}: power cycle")
        self.power_up()

    def cut_power(self, until_ns: int) -> None:
        """Cut its power until a time: RAM is lost, and it neither moves nor receives anything before."""
        self.reset()
        self._receive_nothing_until(max(self._deaf_until_ns, until_ns))

    def _receive_nothing_until(self, t_ns: int) -> None:
        self._deaf_until_ns = t_ns
        self.registers.version += 1

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before; the integer of the wire, no refusal."""
        self.note(f"servo {self.servo_id}: {name} set to {wire}")
        self._set(name, wire)

    def trigger_overload(self) -> None:
        """Load the shaft beyond the torque.

        It ends with a power cycle, a reboot (Protocol 2.0), a write of Torque Limit (34, Protocol 1.0).
        """
        self._overload(True)
        self.note(f"servo {self.servo_id}: overload")
        self.protect()

    def set_voltage(self, volts: float) -> None:
        """Supply it with another voltage, V."""
        self.voltage = volts
        self.note(f"servo {self.servo_id}: voltage {volts} V")
        self.protect()

    def set_temperature(self, celsius: float) -> None:
        """Heat it, degrees C."""
        self.temperature = celsius
        self.note(f"servo {self.servo_id}: temperature {celsius} degC")
        self.protect()

    def turn(self, by: float, duration_ns: int) -> None:
        """Let a hand turn the shaft by an angle, rad, in a time; it gives way to a servo that has torque."""

        def gives_way(turned: float) -> None:
            came = f"gives way after {math.degrees(turned):.1f} of {math.degrees(by):g} deg"
            self.note(f"servo {self.servo_id}: holds or drives its shaft, so the hand that turns it {came}")

        self.shaft.mechanics.turn(self.shaft.index, by, duration_ns, gives_way)

    def turn_by_hand(self, angle: float) -> None:
        """Turn the shaft to an angle, rad; a servo with torque goes back to its goal."""
        self.note(f"servo {self.servo_id}: turned by hand to {angle} rad")
        self.shaft.rest_at(angle)
        self.shaft.plan(self.shaft.items)


def baud_item(memory: Memory) -> str:
    """Return the item that decides the rate: the Y series has two."""
    return "baud_rate" if "baud_rate" in memory else "baud_rate_bus"


def _supply(memory: Memory) -> float:
    """Return the voltage at which a servo is tried, V.

    The one that the manual's figures are for; else 12 V, or the middle of its limits.
    """
    if memory.table.nominal_voltage:
        return memory.table.nominal_voltage
    lowest, highest = memory.get("min_voltage_limit", 0), memory.get("max_voltage_limit", 999)
    return 12.0 if lowest <= 120 <= highest else (lowest + highest) / 20
