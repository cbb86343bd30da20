"""What each kind of fault does to a bus when its moment has come.

Simpler than the world: noise and a babbling servo reach the host and spoil what servos send meanwhile, but no
servo takes their bytes for an instruction; a supply changes from one moment to the next; a servo without
power is limp at once; a second servo with an ID is at the angle of the first one, and carries no load [i].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import TypeVar

from dxlrun.plan.simulation_plan import ServoConfig
from dxlrun.simulation.bus.ledger import FAULT
from dxlrun.simulation.bus.line import flipped
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.device.simulated_device import SimulatedDevice
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
from dxlrun.simulation.servo.node import SimulatedNode
from dxlrun.simulation.servo.simulated_servo import SimulatedServo

Node = TypeVar("Node", bound=SimulatedNode)


@dataclass(slots=True)
class Hold:
    """What lasts as long as any fault of its kind does, on one servo or one adapter."""

    restore: Callable[[], None]  # Brings back what was before the first of them
    faults: int = 0


_SUPPLY_NS = 10_000_000  # How often a supply with a resistance is worked out

Holds = dict[tuple[str, int], Hold]
"""By kind and what it holds; one for all faults of a script, since they may overlap."""


@dataclass(slots=True)
class Injection:
    """One fault on its way to one bus; it enters the ledger once, when it happens."""

    fault: Fault
    bus: SimulatedBus
    random: Random  # For what the fault leaves open
    holds: Holds
    happened: bool = field(default=False, init=False)

    def begin(self) -> None:
        """Let the fault happen now; one of a packet happens with the next packet."""
        _BEGIN[self.fault.kind](self)

    def enter(self) -> None:
        """Enter the fault into the ledger, when this is called first."""
        if not self.happened:
            self.happened = True
            self.bus.note(f"{FAULT}{self.fault}")

    def nodes(self) -> Sequence[SimulatedNode]:
        """Return the servo or device that the fault names, or all of the bus, at the bus' time.

        It happens to them. None is left when the host has given it another ID meanwhile: the fault does not
        happen.
        """
        return self._named(self.bus.nodes)

    def servos(self) -> Sequence[SimulatedServo]:
        """Return what `nodes` does, of the servos alone."""
        return self._named(self.bus.servos)

    def devices(self) -> Sequence[SimulatedDevice]:
        """Return what `nodes` does, of the devices that are no servos."""
        return self._named(self.bus.devices)

    def _named(self, nodes: Sequence[Node]) -> list[Node]:
        servo_id = self.fault.servo
        named = [node for node in nodes if servo_id in (None, node.servo_id)]
        if servo_id is not None:
            named = named[:1]  # of two with one ID the first is meant
        for node in named:
            node.advance(self.bus.now_ns)
        if named:
            self.enter()
        return named

    def hold(self, target: object, restore: Callable[[], None]) -> None:
        """Call `restore` when the fault's `for=` is over, and that of the last one that overlaps with it."""
        hold = self.holds.setdefault((self.fault.kind, id(target)), Hold(restore))
        hold.faults += 1

        def release() -> None:
            hold.faults -= 1
            if not hold.faults:
                del self.holds[self.fault.kind, id(target)]
                hold.restore()

        if self.fault.for_ns is not None:
            self.bus.at(self.bus.now_ns + self.fault.for_ns, release)


# Packets


def _alter(injection: Injection, text: str, change: Callable[[bytes], bytes], copies: int = 1) -> None:
    """Alter the next packets of a servo or of the host."""
    fault, bus = injection.fault, injection.bus

    def altered(packet: bytes) -> bytes:
        injection.enter()
        return change(packet)

    for _ in range(fault.count):
        if fault.servo is None:
            bus.alter_next_instruction(f"its instruction {text}", altered)
        else:
            delay_ns = fault.by_ns or 0
            bus.alter_next(fault.servo, f"its reply {text}", altered, delay_ns=delay_ns, copies=copies)


def _lose(injection: Injection) -> None:
    _alter(injection, "lost", lambda packet: b"")


def _corrupt(injection: Injection) -> None:
    """Flip bits of one byte; an index beyond the packet means its nearest byte."""
    index = -1 if injection.fault.byte is None else injection.fault.byte
    flip = injection.fault.flip or FLIPPED_BITS

    def corrupted(packet: bytes) -> bytes:
        return flipped(packet, max(-len(packet), min(index, len(packet) - 1)), flip)

    _alter(injection, "corrupted", corrupted)


def _truncate(injection: Injection) -> None:
    keep = injection.fault.keep or 0
    _alter(injection, f"cut to {keep} bytes", lambda packet: packet[:keep])


def _delay(injection: Injection) -> None:
    _alter(injection, "delayed", lambda packet: packet)


def _duplicate(injection: Injection) -> None:
    copies = injection.fault.copies or 2
    _alter(injection, f"sent {copies} times", lambda packet: packet, copies)


# The line


def _noise(injection: Injection) -> None:
    fault, bus = injection.fault, injection.bus
    injection.enter()
    bus.inject_noise(fault.data or injection.random.randbytes(fault.size or NOISE_BYTES), bus.now_ns)


def _babble(injection: Injection) -> None:
    fault, bus = injection.fault, injection.bus
    if not injection.nodes():
        return
    end_ns = bus.now_ns + (fault.for_ns or BABBLE_NS)

    def burst() -> None:
        if bus.now_ns < end_ns:
            bus.inject_noise(injection.random.randbytes(fault.size or NOISE_BYTES), bus.now_ns)
            bus.at(bus.now_ns + (fault.every_ns or BABBLE_PAUSE_NS), burst)

    burst()


def _unplug(injection: Injection) -> None:
    injection.enter()
    injection.bus.unplug()
    injection.hold(injection.bus, injection.bus.plug_in)


def _wedge(injection: Injection) -> None:
    bus = injection.bus
    injection.enter()
    bus.wedge(True)
    injection.hold(bus, lambda: bus.wedge(False))


def _timer(injection: Injection) -> None:
    bus = injection.bus
    injection.enter()
    injection.hold(bus, partial(bus.set_latency_timer, bus.latency_timer_ns))
    bus.set_latency_timer(injection.fault.by_ns or TIMER_NS)


def _sag(injection: Injection) -> None:
    """Lower the voltage of all servos by what their currents cost, every 10 ms; when it is over, raise it."""
    bus = injection.bus
    servos = injection.servos()
    volts = [servo.voltage for servo in servos]
    end_ns = None if injection.fault.for_ns is None else bus.now_ns + injection.fault.for_ns

    def supply() -> None:
        over = end_ns is not None and bus.now_ns >= end_ns
        for servo in servos:
            servo.advance(bus.now_ns)
        drawn = 0.0 if over else sum(abs(servo.shaft.duty * servo.shaft.current) for servo in servos)
        for servo, own in zip(servos, volts, strict=True):
            servo.voltage = max(0.0, own - (injection.fault.ohms or 0.0) * drawn)
            servo.protect()
        if not over:
            bus.at(bus.now_ns + _SUPPLY_NS, supply)

    supply()


# Servos


def _loose(injection: Injection) -> None:
    fault = injection.fault
    low, high = math.radians(fault.low_deg or 0.0), math.radians(fault.high_deg or 0.0)
    for servo in injection.servos():

        def contact(servo: SimulatedServo = servo) -> bool:
            inside = low <= servo.position <= high
            return not (inside and injection.random.random() < (fault.share or 1.0))

        _interrupt(injection, servo, contact)


def _lossy(injection: Injection) -> None:
    for node in injection.nodes():
        _interrupt(injection, node, lambda: injection.random.random() >= (injection.fault.share or 0.0))


def _interrupt(injection: Injection, node: SimulatedNode, contact: Callable[[], bool]) -> None:
    node.interrupt(contact)
    if injection.fault.for_ns is not None:
        injection.bus.at(injection.bus.now_ns + injection.fault.for_ns, partial(node.connect, contact))


def _slow(injection: Injection) -> None:
    for node in injection.nodes():
        injection.hold(node, partial(node.reply_later, 0))
        node.reply_later(injection.fault.by_ns or 0)


def _jam(injection: Injection) -> None:
    for servo in injection.servos():
        injection.hold(servo, partial(servo.jam, False))
        servo.jam(True)


def _silence(injection: Injection) -> None:
    for node in injection.nodes():
        node.silence(True)
        injection.hold(node, partial(node.silence, False))


def _reboot(injection: Injection) -> None:
    for node in injection.nodes():
        node.cut_power(injection.bus.now_ns + (injection.fault.for_ns or BOOT_NS))


def _brownout(injection: Injection) -> None:
    """Cut the power; when it is back, the servos start: some of them switch their torque on by themselves."""
    for node in injection.nodes():
        end_ns = injection.bus.now_ns + (injection.fault.for_ns or BROWNOUT_NS)
        node.cut_power(end_ns)
        injection.bus.at(end_ns, partial(_start_again, node, end_ns))


def _start_again(node: SimulatedNode, now_ns: int) -> None:
    node.advance(now_ns)
    node.reset()


def _voltage(injection: Injection) -> None:
    for node in injection.nodes():
        injection.hold(node, partial(node.set_voltage, node.voltage))
        node.set_voltage(injection.fault.volts or 0.0)


def _other_model(injection: Injection) -> None:
    for node in injection.nodes():
        injection.hold(node, partial(node.poke, "model_number", node.registers["model_number"]))
        node.poke("model_number", injection.fault.number or 0)


def _overload(injection: Injection) -> None:
    for servo in injection.servos():
        servo.trigger_overload()


def _overheat(injection: Injection) -> None:
    for servo in injection.servos():
        injection.hold(servo, partial(servo.set_temperature, servo.temperature))
        servo.set_temperature(HOT_CELSIUS if injection.fault.celsius is None else injection.fault.celsius)


def _turn(injection: Injection) -> None:
    for servo in injection.servos():
        by = math.radians(injection.fault.by_deg or 0.0)
        servo.turn(by, injection.fault.for_ns or TURN_NS)


def _tip(injection: Injection) -> None:
    fault = injection.fault
    for device in injection.devices():
        device.tip(fault.about or "y", math.radians(fault.by_deg or 0.0), fault.for_ns or TURN_NS)


def _duplicate_id(injection: Injection) -> None:
    for servo in injection.servos():
        table, delay = servo.registers.table, servo.registers["return_delay_time"]
        twin = ServoConfig(servo.servo_id, table.model, servo.position, delay * 2000)
        injection.bus.add_servo(twin)


_BEGIN: Mapping[str, Callable[[Injection], None]] = {
    "lose": _lose,
    "corrupt": _corrupt,
    "truncate": _truncate,
    "delay": _delay,
    "duplicate": _duplicate,
    "noise": _noise,
    "silence": _silence,
    "babble": _babble,
    "reboot": _reboot,
    "brownout": _brownout,
    "voltage": _voltage,
    "other_model": _other_model,
    "overload": _overload,
    "overheat": _overheat,
    "turn": _turn,
    "tip": _tip,
    "duplicate_id": _duplicate_id,
    "loose": _loose,
    "lossy": _lossy,
    "slow": _slow,
    "jam": _jam,
    "sag": _sag,
    "timer": _timer,
    "unplug": _unplug,
    "wedge": _wedge,
}
