"""A torso of AX-12 servos on virtual time, with everything it said kept in lists."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, SourceStates, States
from dxlrun.channels.events import EventCode, Severity
from dxlrun.channels.packets import LoggedPacket, PacketBatch, PacketKind, decode_packets
from dxlrun.channels.ring import Handover
from dxlrun.clock import VirtualClock
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange import kernel
from dxlrun.dynamixel.hardware import DynamixelHardware
from dxlrun.dynamixel.plan.planning import Wiring, bus_plan
from dxlrun.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.simulation import BusConfig, Ledger, ServoConfig, encode_config, read_ledger
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.virtual_ports import VirtualPorts

MIDDLE = math.radians(150)


class Packets(PacketBatch):
    """Takes packets and keeps them."""

    def __init__(self):
        self._decoded: list[LoggedPacket] = []
        super().__init__(Handover(lambda _, payload: self._decoded.extend(decode_packets(payload))))

    @property
    def list(self) -> list[LoggedPacket]:
        self.commit()
        return self._decoded

    def sent(self, bus=0):
        return [p.data for p in self.list if p.bus == bus and p.kind is PacketKind.INSTRUCTION]

    def received(self, bus=0):
        return b"".join(p.data for p in self.list if p.bus == bus and p.kind is not PacketKind.INSTRUCTION)


@dataclass
class Events:
    """Takes events and keeps them."""

    list: list[tuple[EventCode, Severity, str, str]] = field(default_factory=list)

    def emit(self, code, severity, source, text, data=b""):
        self.list.append((code, severity, source, text))

    def of(self, code):
        return [(source, text) for kind, _, source, text in self.list if kind == code]


@dataclass
class Rig:
    """Hardware on simulated buses; `cycle` runs one exchange and lets the period pass."""

    plans: Sequence[BusPlan]
    ledger: Ledger
    clock: VirtualClock
    buses: Sequence[SimulatedBus]
    ports: VirtualPorts
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

    def cycle(self, *, idle=True):
        start = self.clock.now_ns()
        self.hardware.read()
        self.restless = -self.restless
        self.goals.position[:] += self.restless
        self.hardware.write()
        deadline = start + self.period_ns
        if idle:
            self.hardware.idle(deadline)
        assert self.clock.now_ns() <= deadline or not idle
        self.clock.wait_until(deadline)

    def into_bus(self, index=0):
        name = self.plans[index].name
        return [entry.data for entry in self.ledger.entries if entry.bus == name and entry.direction == "in"]

    def out_of_bus(self, index=0):
        name = self.plans[index].name
        return b"".join(e.data for e in self.ledger.entries if e.bus == name and e.direction == "out")

    def torque(self, index=0):
        for bus in self.buses:
            bus.advance(self.clock.now_ns())
        return [servo.torque_on for servo in self.buses[index].servos]


def _plan(
    ids=(1, 3, 5, 6, 2, 4, 20, 21),
    *,
    name="main",
    first_row=0,
    latency_ns=0,
    return_delay_ns=500_000,
    **change,
):
    """Return a plan; references in the middle, directions -1, +1, -1, ...; AX-12 if nothing else is said."""
    protocol = change.get("protocol", 1.0)
    models = change.get("models") or [change.get("model", "AX-12A")] * len(ids)
    names = change.get("joints", [f"{name}_{servo_id}_joint" for servo_id in ids])
    wiring = [
        Wiring(
            joint=names[index],
            row=first_row + index,
            servo_id=servo_id,
            table=control_table(models[index], protocol),
            reference=change.get("reference", MIDDLE),
            direction=1 if index % 2 else -1,
            lower=change.get("lower", -MIDDLE),
            upper=change.get("upper", MIDDLE),
            continuous=change.get("continuous", False),
            start_mode=change.get("start_mode"),
        )
        for index, servo_id in enumerate(ids)
    ]
    plan = bus_plan(
        name=name,
        port="sim",
        baud_rate=1_000_000,
        latency_ns=latency_ns,
        return_delay_ns=return_delay_ns,
        joints=wiring,
        protocol=protocol,
        devices=change.get("devices", ()),
    )
    return plan if change.get("fast") else replace(plan, fast=(False,) * len(plan.groups))


@pytest.fixture(scope="session")
def fuzz():
    """Return the module of the campaign that compares kernel and parser."""
    path = Path(__file__).parent.parent / "bench" / "fuzz_kernel.py"
    spec = importlib.util.spec_from_file_location("fuzz_kernel", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def make_plan() -> Callable[..., BusPlan]:
    return _plan


@pytest.fixture(scope="session")
def module_plan() -> BusPlan:
    return _plan()


@pytest.fixture
def make_rig(make_plan) -> Callable[..., Rig]:
    def build(*plans, take_over=False, extra=(), position=None, firmware=None, compiled=True):
        plans = plans or (make_plan(),)
        ledger = Ledger()
        clock = VirtualClock(1_000_000_000)
        buses = []
        for plan in plans:
            servos = tuple(
                ServoConfig(
                    servo.servo_id,
                    servo.model,
                    position or 2.0 + 0.1 * servo.row,
                    plan.return_delay_ns,
                    firmware=firmware,
                )
                for servo in plan.servos
            )
            servos += tuple(  # of devices that have the place of their states in common with a servo
                ServoConfig(device.servo_id, device.model, 2.0, plan.return_delay_ns)
                for device in plan.devices
            )
            config = BusConfig(plan.name, plan.baud_rate, servos + tuple(extra), plan.protocol)
            buses.append(SimulatedBus(config, ledger, clock.now_ns()))
        ports = VirtualPorts(clock, buses)
        rows = sum(len(plan.servos) for plan in plans)
        states, goals, packets, events = States.empty(rows), Commands.empty(rows), Packets(), Events()
        devices = [device for plan in plans for device in plan.devices]
        fields = [one for device in devices for block in device.blocks for one in block.fields]
        sources = SourceStates.empty(len(devices), len(fields))
        commands = np.full(sum(len(device.commands) for device in devices), np.nan)
        beats: list[int] = []
        hardware = DynamixelHardware(
            plans,
            ports,
            clock,
            states,
            goals,
            packets,
            events,
            lambda: beats.append(clock.now_ns()),
            take_over=take_over,
            library=kernel.load() if compiled else None,
            sources=sources,
            device_commands=commands,
        )
        rig = Rig(plans, ledger, clock, buses, ports, states, goals, packets, events, hardware, beats)
        rig.sources, rig.device_commands = sources, commands
        return rig

    return build


@pytest.fixture
def simulated_line(tmp_path):
    """Run a simulated bus as a run does; gives its pseudo-terminal, and what ends it and has the ledger."""
    children = []

    def start(bus):
        ours, theirs = socket.socketpair()
        reader, writer = os.pipe()
        os.write(writer, encode_config((bus,)))
        os.close(writer)
        ledger = tmp_path / f"ledger{len(children)}.jsonl"
        command = [sys.executable, "-m", "dxlrun.simulation", "--config-fd", str(reader)]
        command += ["--control-fd", str(theirs.fileno()), "--ledger", str(ledger)]
        child = subprocess.Popen(command, pass_fds=(reader, theirs.fileno()), start_new_session=True)
        children.append((child, ours))
        os.close(reader)
        theirs.close()
        ours.settimeout(60)

        def finish():
            ours.close()
            assert child.wait(60) == 0
            return read_ledger(ledger)

        return json.loads(ours.recv(4096))["ports"][bus.name], finish

    yield start
    for child, ours in children:
        child.kill()
        child.wait()
        ours.close()


class Ticks:
    """Goals of one servo, number by number: what the arrays of a whole bus are compared with."""

    @staticmethod
    def position(servo: ServoPlan, position: float) -> int:
        """Return the goal position of a joint angle, rad: the nearest that the joint's limits allow."""
        theta = servo.direction * position + servo.reference
        return min(max(round(theta / servo.rad_per_tick), servo.lower_tick), servo.upper_tick)

    @staticmethod
    def speed(servo: ServoPlan, velocity: float) -> int:
        """Return the moving speed in ticks of a speed, rad/s.

        Its magnitude counts, rounded down. NaN gives 0, the maximum in joint mode; 0 rad/s so gives 1 tick.
        """
        if math.isnan(velocity):
            return 0
        most = servo.max_speed_tick
        return min(max(math.floor(min(abs(velocity) / servo.rad_s_per_tick + 1e-6, most)), 1), most)

    @staticmethod
    def block(servo: ServoPlan, position: int, speed: int) -> bytes:
        """Return the goal block of a servo; without a place for a speed, of the position alone."""
        layout = servo.goal
        block = bytearray(layout.length)
        for place, value in ((layout.position, position), (layout.speed, speed)):
            if place is not None:
                signed = place.encoding == "twos_complement"
                block[place.offset : place.offset + place.size] = value.to_bytes(
                    place.size, "little", signed=signed
                )
        return bytes(block)


@pytest.fixture(scope="session")
def ticks():
    return Ticks
