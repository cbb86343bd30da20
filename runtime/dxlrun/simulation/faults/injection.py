"""What each kind of fault does to a bus when its moment has come.

Simpler than the world: noise and a babbling servo reach the host and spoil what servos send meanwhile, but no
servo takes their bytes for an instruction; a supply changes from one moment to the next; a servo without
power is limp at once; a second servo with an ID is at the angle of the first one, and carries no load [i].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from random import Random

import msgspec

from dxlrun.plan.simulation_plan import ServoConfig
from dxlrun.simulation.bus.ledger import FAULT
from dxlrun.simulation.bus.line import flipped
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.faults.fault import (
    BABBLE_NS,
    BABBLE_PAUSE_NS,
    BOOT_NS,
    BROWNOUT_NS,
    FLIPPED_BITS,
    HOT_CELSIUS,
    NOISE_BYTES,
    TIMER_NS,
    TURN_NS,
    Fault,
)
from dxlrun.simulation.servo.node import Node, SimulatedNode
from dxlrun.simulation.servo.simulated_servo import SimulatedServo

_SUPPLY_NS = 10_000_000  # how often a supply with a resistance is worked out


class Hold(msgspec.Struct):
    """What lasts as long as any fault of its kind does, on one servo or one adapter."""

    restore: Callable[[], None]  # brings back what was before the first of them
    faults: int = 0


Holds = dict[tuple[str, int], Hold]
"""By kind and what it holds; one for all faults of a script, since they may overlap."""


class Injection:
    """One fault on its way to one bus; it enters the ledger once, when it happens.

    Each kind of fault is a method that has its name.
    """

    def __init__(self, fault: Fault, bus: SimulatedBus, random: Random, holds: Holds) -> None:
        """`random` is for what the fault leaves open."""
        self.fault, self.bus, self.random = fault, bus, random
        self.happened = False
        self._holds = holds

    def begin(self) -> None:
        """Let the fault happen now; one of a packet happens with the next packet."""
        getattr(self, f"_{self.fault.kind}")()

    def _enter(self) -> None:
        """Enter the fault into the ledger, when this is called first."""
        if not self.happened:
            self.happened = True
            self.bus.note(f"{FAULT}{self.fault}")

    def _named(self, nodes: Sequence[Node]) -> list[Node]:
        """Return the one that the fault names, or all of the bus, at the bus' time: it happens to them.

        None is left when the host has given it another ID meanwhile: the fault does not happen.
        """
        servo_id = self.fault.servo
        named = [node for node in nodes if servo_id in (None, node.servo_id)]
        if servo_id is not None:
            named = named[:1]  # of two with one ID the first is meant
        for node in named:
            node.advance(self.bus.now_ns)
        if named:
            self._enter()
        return named

    def _nodes(self) -> list[SimulatedNode]:
        return self._named(self.bus.nodes)

    def _servos(self) -> list[SimulatedServo]:
        return self._named(self.bus.servos)

    def _hold(self, target: object, restore: Callable[[], None]) -> None:
        """Call `restore` when the fault's `for=` is over, and that of the last one that overlaps with it."""
        hold = self._holds.setdefault((self.fault.kind, id(target)), Hold(restore))
        hold.faults += 1

        def release() -> None:
            hold.faults -= 1
            if not hold.faults:
                del self._holds[self.fault.kind, id(target)]
                hold.restore()

        if self.fault.for_ns is not None:
            self.bus.at(self.bus.now_ns + self.fault.for_ns, release)

    # Packets

    def _alter(self, text: str, change: Callable[[bytes], bytes], copies: int = 1) -> None:
        """Alter the next packets of a servo or of the host."""
        fault, bus = self.fault, self.bus

        def altered(packet: bytes) -> bytes:
            self._enter()
            return change(packet)

        for _ in range(fault.count):
            if fault.servo is None:
                bus.alter_next_instruction(f"its instruction {text}", altered)
            else:
                delay_ns = fault.by_ns or 0
                bus.alter_next(fault.servo, f"its reply {text}", altered, delay_ns=delay_ns, copies=copies)

    def _lose(self) -> None:
        self._alter("lost", lambda packet: b"")

    def _corrupt(self) -> None:
        index = -1 if self.fault.byte is None else self.fault.byte
        flip = self.fault.flip or FLIPPED_BITS

        def corrupted(packet: bytes) -> bytes:  # an index beyond the packet means its nearest byte
            return flipped(packet, max(-len(packet), min(index, len(packet) - 1)), flip)

        self._alter("corrupted", corrupted)

    def _truncate(self) -> None:
        keep = self.fault.keep or 0
        self._alter(f"cut to {keep} bytes", lambda packet: packet[:keep])

    def _delay(self) -> None:
        self._alter("delayed", lambda packet: packet)

    def _duplicate(self) -> None:
        copies = self.fault.copies or 2
        self._alter(f"sent {copies} times", lambda packet: packet, copies)

    # The line

    def _noise(self) -> None:
        self._enter()
        self.bus.inject_noise(self.fault.data or self._random_bytes(), self.bus.now_ns)

    def _random_bytes(self) -> bytes:
        return self.random.randbytes(self.fault.size or NOISE_BYTES)

    def _babble(self) -> None:
        fault, bus = self.fault, self.bus
        if not self._nodes():
            return
        end_ns = bus.now_ns + (fault.for_ns or BABBLE_NS)

        def burst() -> None:
            if bus.now_ns < end_ns:
                bus.inject_noise(self._random_bytes(), bus.now_ns)
                bus.at(bus.now_ns + (fault.every_ns or BABBLE_PAUSE_NS), burst)

        burst()

    def _unplug(self) -> None:
        self._enter()
        self.bus.unplug()
        self._hold(self.bus, self.bus.plug_in)

    def _wedge(self) -> None:
        self._enter()
        self.bus.wedge(True)
        self._hold(self.bus, partial(self.bus.wedge, False))

    def _timer(self) -> None:
        self._enter()
        self._hold(self.bus, partial(self.bus.set_latency_timer, self.bus.latency_timer_ns))
        self.bus.set_latency_timer(self.fault.by_ns or TIMER_NS)

    def _sag(self) -> None:
        """Lower the voltage of all servos by what their currents cost, again and again; at last raise it."""
        bus, fault, servos = self.bus, self.fault, self._servos()
        volts = [servo.voltage for servo in servos]
        end_ns = None if fault.for_ns is None else bus.now_ns + fault.for_ns

        def supply() -> None:
            over = end_ns is not None and bus.now_ns >= end_ns
            for servo in servos:
                servo.advance(bus.now_ns)
            drawn = 0.0 if over else sum(abs(servo.shaft.duty * servo.shaft.current) for servo in servos)
            for servo, own in zip(servos, volts, strict=True):
                servo.voltage = max(0.0, own - (fault.ohms or 0.0) * drawn)
                servo.protect()
            if not over:
                bus.at(bus.now_ns + _SUPPLY_NS, supply)

        supply()

    # Servos

    def _loose(self) -> None:
        fault = self.fault
        low, high = math.radians(fault.low_deg or 0.0), math.radians(fault.high_deg or 0.0)
        for servo in self._servos():

            def contact(servo: SimulatedServo = servo) -> bool:
                inside = low <= servo.position <= high
                return not (inside and self.random.random() < (fault.share or 1.0))

            self._interrupt(servo, contact)

    def _lossy(self) -> None:
        for node in self._nodes():
            self._interrupt(node, lambda: self.random.random() >= (self.fault.share or 0.0))

    def _interrupt(self, node: SimulatedNode, contact: Callable[[], bool]) -> None:
        node.interrupt(contact)
        if self.fault.for_ns is not None:
            self.bus.at(self.bus.now_ns + self.fault.for_ns, partial(node.connect, contact))

    def _slow(self) -> None:
        for node in self._nodes():
            self._hold(node, partial(node.reply_later, 0))
            node.reply_later(self.fault.by_ns or 0)

    def _jam(self) -> None:
        for servo in self._servos():
            self._hold(servo, partial(servo.jam, False))
            servo.jam(True)

    def _silence(self) -> None:
        for node in self._nodes():
            node.silence(True)
            self._hold(node, partial(node.silence, False))

    def _reboot(self) -> None:
        for node in self._nodes():
            node.cut_power(self.bus.now_ns + (self.fault.for_ns or BOOT_NS))

    def _brownout(self) -> None:
        end_ns = self.bus.now_ns + (self.fault.for_ns or BROWNOUT_NS)

        def start_again(node: SimulatedNode) -> None:
            node.advance(end_ns)
            node.reset()  # some switch their torque on by themselves when the power is back

        for node in self._nodes():
            node.cut_power(end_ns)
            self.bus.at(end_ns, partial(start_again, node))

    def _voltage(self) -> None:
        for node in self._nodes():
            self._hold(node, partial(node.set_voltage, node.voltage))
            node.set_voltage(self.fault.volts or 0.0)

    def _other_model(self) -> None:
        for node in self._nodes():
            self._hold(node, partial(node.poke, "model_number", node.registers["model_number"]))
            node.poke("model_number", self.fault.number or 0)

    def _overload(self) -> None:
        for servo in self._servos():
            servo.trigger_overload()

    def _overheat(self) -> None:
        for servo in self._servos():
            self._hold(servo, partial(servo.set_temperature, servo.temperature))
            servo.set_temperature(HOT_CELSIUS if self.fault.celsius is None else self.fault.celsius)

    def _turn(self) -> None:
        for servo in self._servos():
            servo.turn(math.radians(self.fault.by_deg or 0.0), self.fault.for_ns or TURN_NS)

    def _tip(self) -> None:
        fault = self.fault
        for device in self._named(self.bus.devices):
            device.tip(fault.about or "y", math.radians(fault.by_deg or 0.0), fault.for_ns or TURN_NS)

    def _duplicate_id(self) -> None:
        for servo in self._servos():
            table, delay = servo.registers.table, servo.registers["return_delay_time"]
            self.bus.add_servo(ServoConfig(servo.servo_id, table.model, servo.position, delay * 2000))
