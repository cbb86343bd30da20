"""Kinds of faults: for each kind the keys of its line, its effect on a simulated bus, and its random values
in a storm.

Simplifications: noise and a babbling servo reach the host and corrupt simultaneous replies of servos, but
servos never parse their bytes as instructions. A supply voltage changes instantly. A servo without power
is limp at once. A second servo with an ID has the angle of the first one and carries no load [i]."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from random import Random
from typing import NamedTuple, TypeVar

import msgspec

from dxlsim.bus.ledger import FAULT
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.values import READERS, TURN, Reader, Value
from dxlsim.servo.node import Node, SimulatedNode
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import ServoConfig

NOISE_BYTES = 8
TIMER_NS = 16_000_000  # Factory setting of an FTDI adapter's latency timer (AN232B-04)
HOT_CELSIUS = 90.0
"""Temperature of the fault `overheat` by default, degrees C: above the factory setting of Temperature
Limit (31) in every model, which is 85 at most."""
BOOT_NS = 100_000_000  # Time without reception after a restart; the manuals give no value [i]
BROWNOUT_NS = 200_000_000
BABBLE_NS = 200_000_000
BABBLE_PAUSE_NS = 2_000_000
TURN_NS = 1_000_000_000
_SHORTEST_BOOT_NS = 50_000_000  # No servo restarts faster after a loss of power [i]
_STEP_NS = 1000  # Resolution of the times in a storm
_SUPPLY_NS = 10_000_000  # Update interval of a supply with a resistance
_MS, _S = 1_000_000, 1_000_000_000

LINE, PACKET, NODE, SERVO, DEVICE = "line", "packet", "node", "servo", "device"
"""Targets of a kind of fault: the line or its adapter; a packet of a servo or of the host; any unit on the
line; a servo (with a shaft, or of a model); another device."""


def flipped(packet: bytes, index: int, flip: int) -> bytes:
    """Return a packet with the bits of `flip` inverted in the byte at `index`. Raises IndexError if the
    packet is shorter."""
    broken = bytearray(packet)
    broken[index] ^= flip
    return bytes(broken)


class Hold(msgspec.Struct):
    """Lasting effect of a kind of fault on one servo or adapter, which ends with the last overlapping
    fault of that kind."""

    restore: Callable[[], None]  # Restores the state from before the first fault
    faults: int = 0


Holds = dict[tuple[str, int], Hold]
"""The lasting effects by kind and `id()` of the target; shared by all faults of a script, because they may
overlap."""


_Act = TypeVar("_Act", bound=Callable[..., None])

Draw = Callable[[Random], Mapping[str, Value]]  # Draws random values of a kind for a storm, by key


class Kind(NamedTuple):
    """One kind of fault: its effect in words, its target, the function that does it, and its keys,
    required ones first."""

    does: str
    of: str
    act: Callable[..., None]
    draw: Draw
    readers: Mapping[str, Reader]
    needs: tuple[str, ...]


KINDS: dict[str, Kind] = {}  # By name, in the order of the help

WHEN = ("bus", "at", "packet")  # Keys of every kind for place and time; a storm cannot begin at a packet


def _kind(of: str, draw: Draw = lambda random: {}) -> Callable[[_Act], _Act]:
    """Return a decorator that registers a function as the kind of fault of its name; its parameters are
    the keys of the kind's line."""

    def take_up(act: _Act) -> _Act:
        name, does = act.__name__.removeprefix("_"), inspect.cleandoc(act.__doc__ or "")
        arguments = {each.name.rstrip("_"): each for each in inspect.signature(act).parameters.values()}
        own = [key for key in arguments if key in READERS]
        when = [key for key in WHEN if (name, key) != ("storm", "packet")]
        readers = {key: READERS[key] for key in (*own, *when)}
        if "by" in own and arguments["by"].annotation == "float":
            readers["by"] = TURN
        needs = tuple(key for key in own if arguments[key].default is inspect.Parameter.empty)
        does = " ".join(f"{does[:1].lower()}{does[1:]}".split()).removesuffix(".")
        KINDS[name] = Kind(does, of, act, draw, readers, needs)
        return act

    return take_up


def _time_from(random: Random, shortest_ns: int, longest_ns: int) -> int:
    return random.randint(shortest_ns // _STEP_NS, longest_ns // _STEP_NS) * _STEP_NS


def _while(random: Random, shortest_ns: int = 10 * _MS, longest_ns: int = _S) -> dict[str, Value]:
    return {"for": _time_from(random, shortest_ns, longest_ns)}


def _boot(random: Random) -> dict[str, Value]:
    return _while(random, _SHORTEST_BOOT_NS, 500 * _MS)


def _stretch(random: Random) -> dict[str, Value]:
    low = random.randint(0, 300)
    return {"low": float(low), "high": low + 30.0, **_while(random)}


class Happening:
    """One planned fault on one bus; it adds a note to the ledger when it happens."""

    def __init__(self, kind: str, text: str, bus: SimulatedBus, random: Random, holds: Holds) -> None:
        """Prepare a fault; calling the function of its kind with this object makes it happen.

        Args:
            kind: Key of KINDS.
            text: Line of the fault.
            bus: The bus.
            random: Source of values that the line leaves open.
            holds: Shared by all faults of a script.
        """
        self.bus, self.random = bus, random
        self.happened = False
        self._kind, self._text, self._holds = kind, text, holds

    def _enter(self) -> None:
        if not self.happened:
            self.happened = True
            self.bus.add_note(f"{FAULT}{self._text}")

    def _named(self, nodes: Sequence[Node], servo: int | None) -> list[Node]:
        """Return the unit with this ID, or all units if `servo` is None, advanced to now; note in the ledger
        that the fault happens.

        The result is empty if the host has changed the ID since planning. The fault then does not happen."""
        named = [node for node in nodes if servo in (None, node.servo_id)]
        if servo is not None:
            named = named[:1]  # If two units share the ID, the fault concerns the first
        for node in named:
            node.advance_to(self.bus.now_ns)
        if named:
            self._enter()
        return named

    def _nodes(self, servo: int | None) -> list[SimulatedNode]:
        return self._named(self.bus.nodes, servo)

    def _servos(self, servo: int | None) -> list[SimulatedServo]:
        return self._named(self.bus.servos, servo)

    def _after(self, for_ns: int | None, action: Callable[[], None]) -> None:
        if for_ns is not None:
            self.bus.at(self.bus.now_ns + for_ns, action)

    def _hold(self, target: object, restore: Callable[[], None], for_ns: int | None) -> None:
        """Call `restore` after `for_ns`, or after the end of the last overlapping fault of the same kind;
        None: never."""
        hold = self._holds.setdefault((self._kind, id(target)), Hold(restore))
        hold.faults += 1

        def release_fault() -> None:
            hold.faults -= 1
            if not hold.faults:
                del self._holds[self._kind, id(target)]
                hold.restore()

        self._after(for_ns, release_fault)

    def _alter(
        self,
        servo: int | None,
        count: int,
        text: str,
        change: Callable[[bytes], bytes] = bytes,
        *,
        delay_ns: int = 0,
        copies: int = 1,
    ) -> None:
        """Alter the next `count` packets of a servo by `change`; None: those of the host."""

        def altered(packet: bytes) -> bytes:
            self._enter()
            return change(packet)

        for _ in range(count):
            if servo is None:
                self.bus.alter_next_instruction(f"its instruction {text}", altered)
            else:
                self.bus.alter_next(servo, f"its reply {text}", altered, delay_ns=delay_ns, copies=copies)

    def _interrupt(self, node: SimulatedNode, contact: Callable[[], bool], for_ns: int | None) -> None:
        node.interrupt(contact)
        self._after(for_ns, partial(node.connect, contact))

    # Packets

    @_kind(PACKET, lambda random: {"count": random.randint(1, 5)})
    def _lose(self, servo: int | None = None, from_: str | None = None, count: int = 1) -> None:
        """The next reply of a servo, or instruction of the host, is lost."""
        self._alter(servo, count, "lost", lambda packet: b"")

    @_kind(PACKET, lambda random: {"byte": random.randint(0, 15), "flip": 1 << random.randrange(8)})
    def _corrupt(
        self,
        byte: int = -1,
        flip: int = 0x01,
        *,
        servo: int | None = None,
        from_: str | None = None,
        count: int = 1,
    ) -> None:
        """A byte of the packet (default: the last) has bits flipped (default 0x01)."""

        def corrupted(packet: bytes) -> bytes:  # An index beyond the packet selects its nearest byte
            return flipped(packet, max(-len(packet), min(byte, len(packet) - 1)), flip)

        self._alter(servo, count, "corrupted", corrupted)

    @_kind(PACKET, lambda random: {"keep": random.randint(1, 10)})
    def _truncate(
        self, keep: int, servo: int | None = None, from_: str | None = None, count: int = 1
    ) -> None:
        """Only its first bytes get through."""
        self._alter(servo, count, f"cut to {keep} bytes", lambda packet: packet[:keep])

    @_kind(NODE, lambda random: {"by": _time_from(random, 10_000, 50 * _MS)})
    def _delay(self, servo: int, by: int, count: int = 1) -> None:
        """The next reply of a servo starts later."""
        self._alter(servo, count, "delayed", delay_ns=by)

    @_kind(NODE, lambda random: {"copies": random.randint(2, 3)})
    def _duplicate(self, servo: int, copies: int = 2, count: int = 1) -> None:
        """The next reply of a servo comes twice, or as often as copies=."""
        self._alter(servo, count, f"sent {copies} times", copies=copies)

    # The line

    @_kind(LINE, lambda random: {"data": random.randbytes(random.randint(1, 32))})
    def _noise(self, data: bytes = b"", size: int = NOISE_BYTES) -> None:
        """Bytes that no servo sent are on the line: those of data= (hex), or size= random ones
        (default 8)."""
        self._enter()
        self.bus.inject_noise(data or self.random.randbytes(size), self.bus.now_ns)

    # Servos and other devices

    @_kind(NODE, lambda random: _while(random, _MS))
    def _silence(self, servo: int, for_: int | None = None) -> None:
        """The data line of a servo is cut: it keeps moving."""
        for node in self._nodes(servo):
            node.silence(True)
            self._hold(node, partial(node.silence, False), for_)

    @_kind(NODE, lambda random: _while(random, _MS, 200 * _MS) | {"size": random.randint(1, 16)})
    def _babble(
        self,
        servo: int,
        for_: int = BABBLE_NS,
        every: int = BABBLE_PAUSE_NS,
        size: int = NOISE_BYTES,
    ) -> None:
        """A servo sends random bytes (size=, default 8) every 2 ms (every=) for 200 ms (for=), unasked."""
        bus, end_ns = self.bus, self.bus.now_ns + for_

        def burst() -> None:
            if bus.now_ns < end_ns:
                bus.inject_noise(self.random.randbytes(size), bus.now_ns)
                self._after(every, burst)

        if self._nodes(servo):
            burst()

    @_kind(NODE, _boot)
    def _reboot(self, servo: int, for_: int = BOOT_NS) -> None:
        """A servo restarts: RAM is lost, and it receives nothing for 100 ms (for=)."""
        for node in self._nodes(servo):
            node.cut_power(self.bus.now_ns + for_)

    @_kind(LINE, _boot)
    def _brownout(self, servo: int | None = None, for_: int = BROWNOUT_NS) -> None:
        """A servo, or every one on the bus, has no power for 200 ms (for=), then starts again."""
        end_ns = self.bus.now_ns + for_

        def start_again(node: SimulatedNode) -> None:
            node.advance_to(end_ns)
            node.power_cycle()  # Some models enable torque at power-up

        for node in self._nodes(servo):
            node.cut_power(end_ns)
            self._after(for_, partial(start_again, node))

    @_kind(NODE, lambda random: {"volts": round(random.uniform(5.0, 20.0), 1), **_while(random)})
    def _voltage(self, volts: float, servo: int | None = None, for_: int | None = None) -> None:
        """The supply of a servo, or of every one on the bus, is another one."""
        for node in self._nodes(servo):
            self._hold(node, partial(node.set_voltage, node.voltage), for_)
            node.set_voltage(volts)

    @_kind(NODE, lambda random: {"number": random.randint(0, 65_535), **_while(random)})
    def _other_model(self, servo: int, number: int, for_: int | None = None) -> None:
        """A servo or device answers with another model number."""
        for node in self._nodes(servo):
            self._hold(node, partial(node.poke, "model_number", node.registers["model_number"]), for_)
            node.poke("model_number", number)

    @_kind(SERVO)
    def _overload(self, servo: int) -> None:
        """The shaft of a servo is loaded beyond its torque."""
        for each in self._servos(servo):
            each.trigger_overload()

    @_kind(SERVO, _while)
    def _overheat(self, servo: int, celsius: float = HOT_CELSIUS, for_: int | None = None) -> None:
        """A servo is hot (default 90)."""
        for each in self._servos(servo):
            self._hold(each, partial(each.set_temperature, each.temperature), for_)
            each.set_temperature(celsius)

    @_kind(SERVO, lambda random: {"by": float(random.randint(-90, 90) or 1), **_while(random)})
    def _turn(self, servo: int, by: float, for_: int = TURN_NS) -> None:
        """A hand turns the shaft of a servo in 1 s (for=), unless the servo holds or drives the shaft."""
        for each in self._servos(servo):
            each.turn_shaft(math.radians(by), for_)

    @_kind(DEVICE)
    def _tip(self, servo: int, by: float, about: str = "y", for_: int = TURN_NS) -> None:
        """A device turns in 1 s (for=) and stays so: forward about y, or about=x, z of its own axes."""
        for device in self._named(self.bus.devices, servo):
            device.tip(about, math.radians(by), for_)

    @_kind(SERVO)
    def _duplicate_id(self, servo: int) -> None:
        """A second servo of the same model has this ID."""
        for each in self._servos(servo):
            table, delay = each.registers.table, each.registers["return_delay_time"]
            self.bus.add_servo(ServoConfig(each.servo_id, table.model, each.shaft_angle, delay * 2000))

    @_kind(SERVO, _stretch)
    def _loose(
        self,
        servo: int,
        low: float,
        high: float,
        *,
        share: float = 1.0,
        for_: int | None = None,
    ) -> None:
        """The cable of a servo has no contact while its shaft is between two angles, or a share= of the
        time."""
        for each in self._servos(servo):

            def contact(one: SimulatedServo = each) -> bool:
                inside = math.radians(low) <= one.shaft_angle <= math.radians(high)
                return not (inside and self.random.random() < share)

            self._interrupt(each, contact, for_)

    @_kind(NODE, lambda random: {"share": round(random.uniform(0.01, 0.5), 2), **_while(random)})
    def _lossy(self, share: float, servo: int | None = None, for_: int | None = None) -> None:
        """A share of all packets of a servo, or of every one on the bus, is lost."""
        for node in self._nodes(servo):
            self._interrupt(node, lambda: self.random.random() >= share, for_)

    @_kind(NODE, lambda random: {"by": _time_from(random, 10_000, 2 * _MS), **_while(random)})
    def _slow(self, servo: int, by: int, for_: int | None = None) -> None:
        """A servo starts every reply later."""
        for node in self._nodes(servo):
            self._hold(node, partial(node.reply_later, 0), for_)
            node.reply_later(by)

    @_kind(SERVO, _while)
    def _jam(self, servo: int, for_: int | None = None) -> None:
        """The shaft of a servo is blocked."""
        for each in self._servos(servo):
            self._hold(each, partial(each.jam_shaft, False), for_)
            each.jam_shaft(True)

    # The line's supply and adapter

    @_kind(LINE, lambda random: {"ohms": round(random.uniform(0.1, 2.0), 1), **_while(random)})
    def _sag(self, ohms: float, for_: int | None = None) -> None:
        """The supply of the whole bus has a resistance: its voltage falls with the current of all servos."""
        bus, servos = self.bus, self._servos(None)
        volts = [servo.voltage for servo in servos]
        end_ns = None if for_ is None else bus.now_ns + for_

        def supply() -> None:
            over = end_ns is not None and bus.now_ns >= end_ns
            for servo in servos:
                servo.advance_to(bus.now_ns)
            drawn = 0.0 if over else sum(abs(servo.shaft.duty * servo.shaft.current) for servo in servos)
            for servo, own in zip(servos, volts, strict=True):
                servo.voltage = max(0.0, own - ohms * drawn)
                servo.apply_protection()
            if not over:
                self._after(_SUPPLY_NS, supply)

        supply()

    @_kind(LINE, lambda random: {"by": _time_from(random, _MS, 16 * _MS), **_while(random)})
    def _timer(self, by: int = TIMER_NS, for_: int | None = None) -> None:
        """The adapter has a latency timer of 16 ms (by=), as FTDI chips are shipped."""
        self._enter()
        self._hold(self.bus, partial(self.bus.set_latency_timer, self.bus.latency_timer_ns), for_)
        self.bus.set_latency_timer(by)

    @_kind(LINE, _while)
    def _unplug(self, for_: int | None = None) -> None:
        """The adapter is pulled, and comes back after for=, under another name."""
        self._enter()
        self.bus.unplug()
        self._hold(self.bus, self.bus.plug_in, for_)

    @_kind(LINE, lambda random: _while(random, _MS, 500 * _MS))
    def _wedge(self, for_: int | None = None) -> None:
        """The adapter takes bytes and gives none."""
        self._enter()
        self.bus.wedge(True)
        self._hold(self.bus, partial(self.bus.wedge, False), for_)


# Storms


PASSING = ("lose", "corrupt", "truncate", "delay", "duplicate", "noise", "silence", "babble")
"""Kinds of faults that end without a lasting effect: the default of a storm."""
_HOST_SHARE = 0.25  # Fraction of lost or corrupted packets in a storm that are the host's


Strike = Callable[[SimulatedBus, str, dict[str, Value]], None]
"""Plans one fault that a storm has drawn, from its bus, its kind, and its values by key."""


@_kind(LINE)
def _storm(
    strike: Strike,
    faults: int,
    within: int,
    seed: int | None = None,
    kinds: tuple[str, ...] = PASSING,
    *,
    random: Random,
    buses: Sequence[SimulatedBus],
    begin_ns: int,
) -> None:
    """A number of faults at random times within a time, of those in kinds= (default: those that pass)."""
    for _ in range(faults):
        kind = random.choice(kinds)
        bus = random.choice(buses)
        given = dict(KINDS[kind].draw(random))
        of = KINDS[kind].of
        if of == PACKET and random.random() < _HOST_SHARE:
            given["from"] = "host"
        elif of != LINE:
            victims: Sequence[SimulatedNode] = bus.servos if of == SERVO else bus.nodes
            given["servo"] = random.choice(victims).servo_id
        given["at"] = begin_ns + random.randint(0, within // _STEP_NS) * _STEP_NS
        strike(bus, kind, given)
