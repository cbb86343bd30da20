"""Rigs: the hardware of a robot on simulated buses, stepped by hand on virtual time.

`make_plan` (in `tests.kit.plans`) and `make_x` plan a bus, `make_rig` puts hardware on simulated servos,
`start_rig` starts it, too:

    rig = start_rig(make_x((11, 12)))
    rig.buses[0].servo(12).silence()
    rig.cycles(10)
    assert rig.states.valid.tolist() == [True, False]

What passes the lines is in the ledger of the simulated buses; what the hardware says is kept in lists.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any, Self

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from tests.kit.bus_ports import BusPorts
from tests.kit.decoded import decode_packets
from tests.kit.kept_events import Events
from tests.kit.line_faults import corrupt_next, truncate_next
from tests.kit.plans import make_plan

from dxlrun.channels.cycle import Commands, SourceStates, States, Torque
from dxlrun.channels.logged_packets import LoggedPacket, PacketBatch
from dxlrun.channels.ring import Handover
from dxlrun.dynamixel.bus_part import FeatureParts
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlrun.dynamixel.tools import inspection, tool_port
from dxlrun.errors import StartUpError
from dxlrun.features import FEATURES
from dxlrun.features.devices.plan import decode_devices
from dxlsim.bus.ledger import Ledger, LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import AdapterConfig, BusConfig, DeviceConfig, ServoConfig
from dxlwire.bus.adjustable_port import FIRST_RATE
from dxlwire.bus_plan import BusPlan
from dxlwire.clock import VirtualClock
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketKind

X_IDS = (11, 12, 13, 14, 15, 16, 17, 18)
WRITE, SYNC_WRITE = 0x03, 0x83


class Packets(PacketBatch):
    """Takes packets and keeps them."""

    def __init__(self) -> None:
        self._decoded: list[LoggedPacket] = []
        super().__init__(Handover(lambda _, payload: self._decoded.extend(decode_packets(payload))))

    @property
    def list(self) -> list[LoggedPacket]:
        self.commit_packets()
        return self._decoded

    def sent(self, bus: int = 0) -> list[bytes]:
        return [p.data for p in self.list if p.bus == bus and p.kind is PacketKind.INSTRUCTION]

    def received(self, bus: int = 0) -> bytes:
        return b"".join(p.data for p in self.list if p.bus == bus and p.kind is not PacketKind.INSTRUCTION)


@dataclass
class Rig:
    """Hardware on simulated buses; `cycle` runs one exchange and lets the period pass."""

    plans: Sequence[BusPlan]
    ledger: Ledger
    clock: VirtualClock
    buses: Sequence[SimulatedBus]
    ports: BusPorts
    states: States
    goals: Commands
    packets: Packets
    events: Events
    hardware: DynamixelHardware
    beats: list[int]
    period_ns: int = 20_000_000
    sources: SourceStates = field(default_factory=SourceStates.empty)
    device_commands: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    restless: float = 0.0
    """rad by which every goal goes to and fro, so that each is sent in every cycle: what stays is not."""
    anchors: bool = True  # Joints that were given torque get their goals, as the loop does

    def cycle(self, *, idle: bool = True) -> None:
        start = self.clock.now_ns()
        self.hardware.read_states()
        self.anchor()
        self.restless = -self.restless
        self.goals.position[:] += self.restless
        self.hardware.write_goals()
        deadline = start + self.period_ns
        if idle:
            self.hardware.idle(deadline)
        assert self.clock.now_ns() <= deadline or not idle
        self.clock.wait_until(deadline)

    def anchor(self) -> None:
        """Set the goals of joints that got torque, or have none, to where they are, as the loop does."""
        limp = np.isin(self.states.torque, (Torque.OFF, Torque.RELEASED)) & self.states.valid
        np.copyto(self.goals.position, self.states.position, where=limp)
        given = (self.states.torque == Torque.GIVEN) & self.states.valid
        if given.any() and self.anchors:
            np.copyto(self.goals.position, self.states.position, where=given)
            self.hardware.follow_goals(np.flatnonzero(given).tolist())

    def refused(self) -> tuple[str, ...]:
        """Start, which must fail; return what is said. No servo has torque then."""
        with pytest.raises(StartUpError) as caught:
            self.hardware.start()
        assert not any(self.torque())
        return caught.value.sentences

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.cycle()

    def until_valid(self, most: int = 150) -> int:
        """Run cycles until every servo has answered; return how many."""
        for count in range(most):
            self.cycle()
            if self.states.valid.all():
                return count
        raise AssertionError("not every servo came back")

    @property
    def lines(self) -> Lines:
        """The lines anew, as another process has them behind a loop that died."""
        return Lines(self.plans, self.ports, self.clock, self.packets)

    def wait(self, duration_ns: int) -> None:
        """Let time pass without the loop."""
        self.clock.wait_until(self.clock.now_ns() + duration_ns)
        self.torque()

    @contextmanager
    def away(self, servo_id: int, cycles: int = 4, settle: int = 5) -> Iterator[SimulatedServo]:
        """Let a servo be silent for some cycles and in the block, then wait until it is back."""
        servo = self.servo(servo_id)
        servo.silence()
        self.cycles(cycles)
        yield servo
        servo.silence(False)
        self.until_valid()
        self.cycles(settle)

    def servo(self, servo_id: int, bus: int = 0) -> SimulatedServo:
        return self.buses[bus].servo(servo_id)

    def registers(self, name: str, bus: int = 0) -> list[int]:
        """Return what all servos have in an item."""
        return [servo.registers[name] for servo in self.buses[bus].servos]

    def stick(self, servo_id: int, name: str, value: int) -> None:
        """Let an item of a servo keep a value, whatever is written."""
        servo = self.servo(servo_id)
        servo.registers.watch_items((name,), lambda: servo.poke(name, value))

    def torque_given(self, servo_id: int) -> list[int]:
        """Return a list that collects what is written into a servo's Torque Enable from now on."""
        servo, given = self.servo(servo_id), list[int]()
        servo.registers.watch_items(
            ("torque_enable",), lambda: given.append(servo.registers["torque_enable"])
        )
        given.clear()  # what it has now
        return given

    def when(self, packet_is: Callable[[bytes], bool], act: Callable[[], object]) -> None:
        """Do something before each packet of a kind goes out on the first line."""
        port = self.ports.ports[0]
        write = port.write_packet

        def through(data: bytes) -> None:
            if packet_is(bytes(data)):
                act()
            write(data)

        port.write_packet = through  # type: ignore[method-assign]

    def set_modes(self, *modes: int) -> None:
        """Ask for a mode of each joint, 0: none."""
        self.hardware.set_modes(np.array(modes, dtype=np.uint8))

    def into_bus(self, index: int = 0) -> list[bytes]:
        name = self.plans[index].name
        return [entry.data for entry in self.ledger.entries if entry.bus == name and entry.direction == "in"]

    def out_of_bus(self, index: int = 0) -> bytes:
        name = self.plans[index].name
        return b"".join(e.data for e in self.ledger.entries if e.bus == name and e.direction == "out")

    def writes(self, since: int = 0) -> list[tuple[int, int, bytes]]:
        """Return what single servos were told to write, behind so many packets: ID, address and data."""
        sent = self.into_bus()[since:]
        if self.plans[0].protocol == 1.0:
            return [(p[2], p[5], bytes(p[6:-1])) for p in sent if p[4] == WRITE]
        return [(p[4], p[8] | p[9] << 8, bytes(p[10:-2])) for p in sent if p[7] == WRITE]

    def goals_sent(self, since: int = 0) -> list[tuple[int, list[int]]]:
        """Return the sync writes behind so many packets: address, and the IDs that it names."""
        return [named for p in self.into_bus()[since:] if (named := goals_in(p, self.plans[0].protocol))]

    def torque(self, index: int = 0) -> list[bool]:
        for bus in self.buses:
            bus.advance_to(self.clock.now_ns())
        return [servo.torque_on for servo in self.buses[index].servos]


class VirtualLine:
    """The line of a tool, with one simulated bus; `cannot`: rates that its adapter does not have."""

    def __init__(
        self,
        *servos: ServoConfig,
        protocol: float = 2.0,
        rate: int = 57_600,
        cannot: Sequence[int] = (),
        adapter: AdapterConfig | None = None,
        devices: tuple[DeviceConfig, ...] = (),
    ) -> None:
        self.name, self.cannot, self.other_rates = "/dev/ttyVirtual", cannot, dict[int, int]()
        self.latency_ns, self.most_latency_ns = 0, 16_000_000
        self.clock, self.ledger = VirtualClock(1_000_000), Ledger()
        adapter = adapter or AdapterConfig()
        config = BusConfig("main", rate, servos, protocol, adapter=adapter, devices=devices)
        self.bus = SimulatedBus(config, self.ledger, 0)
        self.ports = BusPorts(self.clock, [self.bus])

    def receive_bytes(self, until_ns: int) -> bytes:
        self.ports.wait_for_bytes(until_ns)
        buffer = memoryview(bytearray(4096))
        return bytes(buffer[: self.ports.ports[0].read_into(buffer)])

    def send_bytes(self, data: bytes) -> None:
        self.ports.ports[0].write_packet(data)

    def tune(self, baud_rate: int) -> bool:
        if baud_rate not in self.cannot:
            self.bus.change_rate(baud_rate)
        return baud_rate not in self.cannot

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    @property
    def heard(self) -> list[bytes]:
        return [entry.data for entry in self.ledger.entries if entry.direction == "in"]


class VirtualLines:
    """Lines on virtual time, at names that commands of this process open as ports: `lines.serve(bus)`.

    A command gives up on a servo after milliseconds, for which the process of a simulated servo may get no
    processor.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._lines: dict[str, VirtualLine] = {}
        for module in (tool_port, inspection):
            patch.setattr(module, "TunablePort", self._open)

    def serve(self, bus: BusConfig) -> tuple[str, Callable[[], Sequence[LedgerEntry]]]:
        """Return the name of a new line, and what has its ledger."""
        name = f"/dev/ttyVirtual{len(self._lines)}"
        self._lines[name] = line = VirtualLine(
            *bus.servos, protocol=bus.protocol, rate=bus.baud_rate, devices=bus.devices
        )
        return name, lambda: line.ledger.entries

    def wait(self, seconds: float) -> None:
        """Let time pass on all lines."""
        for line in self._lines.values():
            line.clock.wait_until(line.clock.now_ns() + round(seconds * 1e9))

    def _open(self, path: str, baud_rate: int = FIRST_RATE, **_: object) -> VirtualLine:
        line = self._lines[path]
        line.name = path
        line.tune(baud_rate)
        return line


def goals_in(packet: bytes, protocol: float) -> tuple[int, list[int]] | None:
    """Return address and named IDs of a sync write; None: the packet is none."""
    if protocol == 1.0:
        return (packet[5], list(packet[7 : -1 : packet[6] + 1])) if packet[4] == SYNC_WRITE else None
    if packet[7] != SYNC_WRITE:
        return None
    width = (packet[10] | packet[11] << 8) + 1
    return packet[8] | packet[9] << 8, list(packet[12:-2:width])


def make_x(ids: Sequence[int] = X_IDS, **change: Any) -> BusPlan:
    """Return a plan of XM430-W350 without return delay, in the middle of their turn."""
    x = {"name": "arm", "protocol": 2.0, "model": "XM430-W350", "reference": math.pi, "return_delay_ns": 0}
    return make_plan(ids, **x | {"lower": -2.5, "upper": 2.5} | change)


def every_servo(plan: BusPlan, **fields: Any) -> BusPlan:
    """Return a plan whose servos have other values in these fields: `torque_on_return=True`."""
    return replace(plan, servos=tuple(replace(servo, **fields) for servo in plan.servos))


def make_rig(
    *plans: BusPlan,
    take_over: bool = False,
    extra: Sequence[ServoConfig] = (),
    position: float | None = None,
    firmware: int | None = None,
    commands: bytes = b"",
) -> Rig:
    """Return hardware that is not started, on the servos of some plans; eight AX-12 where none is given.

    `commands`: of the devices, as their feature compiles them.
    """
    plans = plans or (make_plan(),)
    ledger = Ledger()
    clock = VirtualClock(1_000_000_000)
    buses = []
    for plan in plans:
        delay_ns = plan.return_delay_ns
        servos = [
            ServoConfig(one.servo_id, one.model, position or 2.0 + 0.1 * one.row, delay_ns, firmware=firmware)
            for one in plan.servos
        ]
        # of devices that have the place of their states in common with a servo
        servos += [ServoConfig(one.servo_id, one.model, 2.0, delay_ns) for one in plan.devices]
        config = BusConfig(plan.name, plan.baud_rate, (*servos, *extra), plan.protocol)
        buses.append(SimulatedBus(config, ledger, clock.now_ns()))
    ports = BusPorts(clock, buses)
    rows = sum(len(plan.servos) for plan in plans)
    states, goals, packets, events = States.empty(rows), Commands.empty(rows), Packets(), Events()
    devices = [device for plan in plans for device in plan.devices]
    fields = [one for device in devices for block in device.blocks for one in block.fields]
    sources = SourceStates.empty(len(devices), len(fields))
    commanded = np.full(sum(map(len, decode_devices(commands).values())), np.nan)
    beats: list[int] = []
    hardware = DynamixelHardware(
        Lines(plans, ports, clock, packets, lambda: beats.append(clock.now_ns())),
        packets,
        ServoArrays(states, goals, sources),
        events,
        parts=FeatureParts(FEATURES, (), commanded, {"devices": commands}),
        take_over=take_over,
    )
    rig = Rig(plans, ledger, clock, buses, ports, states, goals, packets, events, hardware, beats)
    rig.sources, rig.device_commands = sources, commanded
    return rig


def start_rig(*plans: BusPlan, **change: Any) -> Rig:
    """Return hardware that holds its servos; see `make_rig`."""
    rig = make_rig(*plans, **change)
    rig.hardware.start()
    return rig


def random_fault(rig: Rig, chance: Random) -> None:
    """Do something to the line, or to one of the servos 1, 2 and 3."""
    bus, servo_id, now_ns = rig.buses[0], chance.choice((1, 2, 3)), rig.clock.now_ns()
    servo = bus.servo(servo_id)
    kinds: list[Callable[[], object]] = [
        lambda: truncate_next(bus, servo_id, chance.randrange(3)),
        lambda: corrupt_next(bus, servo_id),
        lambda: (
            servo.silence(),
            bus.at(now_ns + chance.randrange(1, 300) * 1_000_000, partial(servo.silence, False)),
        ),
        lambda: bus.inject_noise(bytes(chance.randrange(256) for _ in range(6)), now_ns + 100_000),
        # no servo boots in less; one of Protocol 1.0 that did would be seen by nothing
        lambda: servo.cut_power(now_ns + chance.randrange(150, 400) * 1_000_000),
    ]
    kinds[chance.randrange(5)]()
