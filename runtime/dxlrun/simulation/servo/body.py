"""What a simulated servo is without its line: memory, shaft, what surrounds it, and what goes wrong with it.

`Body` is what both protocols share; `LockBody` and `TorqueBody` add how each protects itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import NamedTuple

from dxlrun.simulation.memory.cells import IDENTITY, LiveItem, Memory, Run
from dxlrun.simulation.motion.shaft import Shaft
from dxlrun.simulation.motion.strain import SUPPLY_OHM

BOOT_NS = 100_000_000
"""How long a servo hears nothing after a reboot; no manual names it [i]."""

_READS_KEPT = 1024
"""So many reads are looked up only once: a host reads few places, rubbish goes everywhere."""

_BY_TIME = frozenset(("realtime_tick",))
"""What shows something else at another time, though no servo moves and nothing is written."""

_SECONDARY_IDS = ("secondary_shadow_id", "secondary_id")


class _Window(NamedTuple):
    """A row of cells that is read."""

    live: tuple[LiveItem, ...]
    """What changes by itself in it."""
    lasts: bool
    """True: nothing of it does while no servo moves."""


class Body(ABC):
    """One servo as its own instructions and its surroundings act on it."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        self.memory = memory
        self.shaft = shaft
        self.note = note
        self._voltage = 0.0
        self.voltage = _supply(memory)
        self.overload = False
        """True while the shaft is loaded beyond the torque."""
        self.wakes_on_goal = True
        """Protocol 1.0: writing Goal Position (30) while Torque Enable (24) is 0 sets it to 1 [i]."""
        self.boot_ns = BOOT_NS
        """How long a reboot or a factory reset by an instruction takes: Protocol 2.0."""
        self.deaf_until_ns = shaft.now_ns
        """Until then it boots and hears nothing."""
        self._started_ns = shaft.now_ns
        shaft.mechanics.watch(shaft.index, self._strained)
        self._live = {name: show for name, show in self._live_items().items() if name in memory}
        self._windows: dict[tuple[int, int], _Window] = {}
        self.answers_damaged = False
        """True: a packet with a wrong checksum is answered by the manual's error; False: never [?]."""
        self._registered: tuple[int, bytes] | None = None
        self._secondary_item = next((each for each in _SECONDARY_IDS if each in memory), None)
        self.servo_id = 0
        """ID (3 or 7)."""
        self.secondary_id: int | None = None
        """Secondary ID (12): 253 to 255 switch it off, and the ID goes first (e-Manual, X series)."""
        self.hears_protocol = True
        """False when it was told to speak another protocol."""
        self.delay_ns = 0
        """Return Delay Time (5, 9), in its unit of 2 us."""
        memory.watch(("return_delay_time",), self._time)
        memory.watch(IDENTITY, self._identify)

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

    def _identify(self) -> None:
        """Take note of what it hears."""
        self.servo_id = self.memory["id"]
        secondary = None if self._secondary_item is None else self.memory[self._secondary_item]
        off = secondary is None or secondary > 252 or secondary == self.servo_id
        self.secondary_id = None if off else secondary

    def _time(self) -> None:
        self.delay_ns = self.memory["return_delay_time"] * 2000

    def advance(self, now_ns: int) -> None:
        """Let time pass."""
        self.shaft.advance(now_ns)

    def hear(self, now_ns: int) -> None:
        """Take note of an instruction on the line at a time."""
        self.advance(now_ns)

    def power_up(self) -> None:
        """Start: RAM is as it is at power-up, the shaft stays where it is."""
        self._registered = None
        self.overload = False
        self.memory.restore_ram()
        self.shaft.power_up()
        self._start_up()
        self.protect()
        self.refresh()

    def refresh(self) -> None:
        """Bring all that can be read to the time."""
        for name, show in self._live.items():
            self.memory.show(name, show())

    # Instructions that both protocols have

    def read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table, None where it has none."""
        memory = self.memory
        if length < 1 or address + length > memory.size:
            return None
        if memory.cells(address, length).direct:
            memory.show_all(self._look_up(address, length).live)
            return memory.raw(address, length)
        for target, first, last in memory.places(address, length):
            memory.show_all(self._look_up(target, last - first).live)
        return memory.read(address, length)

    def lasts(self, address: int, length: int) -> bool:
        """Return whether some cells show the same until a servo moves or something is written."""
        places = self.memory.places(address, length)
        return all(self._look_up(target, last - first).lasts for target, first, last in places)

    def _look_up(self, address: int, length: int) -> _Window:
        """Return what changes by itself in some cells; looked up once."""
        window = self._windows.get((address, length))
        if window is None:
            if len(self._windows) >= _READS_KEPT:
                self._windows.clear()
            live = tuple(
                self.memory.live(*each)
                for each in self._live.items()
                if _overlaps(self.memory, each[0], address, length)
            )
            window = _Window(live, _BY_TIME.isdisjoint([each.name for each in live]))
            self._windows[address, length] = window
        return window

    def write(self, address: int, data: bytes) -> int:
        """Write, or return the error with which it is refused; 0 when it is not."""
        memory = self.memory
        runs = memory.runs(address, data)
        for run in runs:
            if error := self.refusal(run):
                return error
        for run in runs:
            names = run.cells.names
            memory.write(run)
            self._obey(names)
            self.shaft.plan(names)
        return 0

    def register(self, address: int, data: bytes) -> int:
        """Keep a write for `act`, or return the error with which it is refused."""
        for run in self.memory.runs(address, data):
            if error := self.refusal(run):
                return error
        self._registered = (address, data)
        self._show_registered(1)
        return 0

    @property
    def has_registered(self) -> bool:
        """True when a registered write waits."""
        return self._registered is not None

    def act(self) -> int:
        """Do the registered write; return its error."""
        if self._registered is None:
            return 0
        address, data = self._registered
        self._registered = None
        self._show_registered(0)
        return self.write(address, data)

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before, with nothing refused."""
        self.memory[name] = wire
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
        return round((self._voltage - SUPPLY_OHM * drawn) / self.memory.table.items[name].scale)

    def _strained(self) -> None:
        """Take note that it became warmer or colder, or was overloaded for too long."""
        if not self.overload and self.shaft.mechanics.overloaded(self.shaft.index):
            self.overload = True
            self.note(f"servo {self.servo_id}: overload, it does not hold its load")
        self.protect()

    # What the protocols do differently

    @abstractmethod
    def refusal(self, run: Run) -> int:
        """Return the error of a write, 0 when it is allowed."""

    @abstractmethod
    def state(self) -> int:
        """Return the bits of every reply's error that tell the servo's state."""

    @abstractmethod
    def protect(self, refused: int = 0) -> None:
        """Take the torque away when something is wrong for which Shutdown asks."""

    @abstractmethod
    def _start_up(self) -> None: ...

    @abstractmethod
    def _obey(self, names: AbstractSet[str]) -> None:
        """Do what the writing of some items does beside changing them."""

    def _show_registered(self, value: int) -> None:
        self.memory.show("registered", value)
        self.memory.show("registered_instruction", value)


def _overlaps(memory: Memory, name: str, address: int, length: int) -> bool:
    item = memory.table.items[name]
    return item.address < address + length and address < item.address + item.size


def _supply(memory: Memory) -> float:
    """Return the voltage at which a servo is tried, V.

    The one that the manual's figures are for; else 12 V, or the middle of its limits.
    """
    if memory.table.nominal_voltage:
        return memory.table.nominal_voltage
    lowest, highest = memory.get("min_voltage_limit", 0), memory.get("max_voltage_limit", 999)
    return 12.0 if lowest <= 120 <= highest else (lowest + highest) / 20
