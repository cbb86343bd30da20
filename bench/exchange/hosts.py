"""Hosts: programs that exchange with servos; what is ours of them, and the list of all."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Protocol

import numpy as np

from dxlrun.channels.commands import NoCommands
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventBody
from dxlrun.channels.logged_packets import LONGEST_BATCH, PacketBatch, packet_capacity, split_packets
from dxlrun.channels.ring import Gap, Handover, RingReader, RingWriter, create
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.assembly import LoopHost, Sinks, assemble
from dxlrun_lab.late_servos import Sent
from dxlwire.bus.blocking_bus import ServoSet
from dxlwire.bus.programs import Addressed
from dxlwire.bus.servo_group import ServoGroup
from dxlwire.bus.session import Session, line_plan
from dxlwire.clock import MonotonicClock
from dxlwire.control_table import find_table
from dxlwire.packets import PacketKind, PacketLog
from dxlwire.port.ports import ReplyPolling, SerialPort, SerialPorts
from exchange.case import Case, Registers
from exchange.floor import Floor
from exchange.peers import Rustypot, Sdk

_MOST_RECOVERIES = 20
_IDLE_NS = 50_000_000
_TICKS = 2
"""By so much two goals in turn differ: a goal that does not change need not be written."""


class Host(Protocol):
    """A program with a line of its own."""

    def start(self) -> None:
        """Do what must be done once; servos answer."""
        ...

    def exchange(self) -> bool:
        """Read every servo and write every goal; False when a reply was lost."""
        ...

    def recover(self) -> None:
        """Come back to whole exchanges after a lost reply; servos answer."""
        ...

    def sent(self) -> Sent:
        """Return what it wrote and when, since the last call; nothing when that is unknown."""
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...


@dataclass(frozen=True, slots=True)
class HostKind:
    """How a host is called, and made."""

    name: str
    module: str
    """What must be installed for it."""
    make: Callable[[str, Case, Plan, bool], Host]
    """Takes the device, the case, its plan, and whether the peers shall turn bytes into values."""

    protocols: tuple[float, ...] = (1.0, 2.0)

    @property
    def missing(self) -> bool:
        """True when it is not installed here."""
        return find_spec(self.module) is None


class _Events:
    """Takes events and forgets them."""

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        """Forget it."""


class Ours:
    """The exchange of our loop: `DynamixelHardware` as a run assembles it, on a real descriptor."""

    def __init__(self, path: str, plan: Plan, *, recorded: bool = True, polled: bool = False) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._descriptor)
        self._ring = -1
        self._recorded: RingReader | None = None
        packets: PacketLog = PacketLog()
        if recorded:
            servos = sum(len(bus.servos) for bus in plan.buses)
            self._ring = create("bench", packet_capacity(1_000_000, servos), LONGEST_BATCH)
            packets = PacketBatch(RingWriter(self._ring))
            self._recorded = RingReader(self._ring)
        self._commit = packets.commit_packets
        host = LoopHost(
            # exchanges follow each other without a pause, so a share of the time would not be one of a period
            ports=SerialPorts(
                [SerialPort(self._descriptor, path)], polling=ReplyPolling(share=1.0) if polled else None
            ),
            clock=MonotonicClock(),
            sinks=Sinks(Handover(lambda kind, payload: None), packets, _Events(), NoCommands()),
        )
        robot = assemble(plan, load_plugins(), host, take_over=True)
        self._hardware = robot.hardware
        self._valid = robot.record.states.valid
        self._torque = robot.record.states.torque
        self._everybody = b"\1" * len(self._valid)
        self._goal = robot.record.goals.position
        self._goals = self._goal.copy(), self._goal.copy()
        ticks = {servo.row: servo.rad_per_tick for bus in plan.buses for servo in bus.servos}
        self._step = np.array([_TICKS * ticks[row] for row in range(len(self._goal))])
        self._turn = 0

    def start(self) -> None:
        """Run the start-up of a run."""
        self._hardware.start()
        self._goals = self._goal.copy(), self._goal + self._step

    def exchange(self) -> bool:
        """Read, set other goals, write, and hand the packets on, as a cycle does."""
        self._hardware.read_states()
        self._turn = 1 - self._turn
        self._goal[:] = self._goals[self._turn]
        self._hardware.write_goals()
        self._commit()
        return self._valid.tobytes() == self._everybody  # as cheap as what the peers return

    def recover(self) -> None:
        """Exchange, and use idle time for servos that did not answer, until all get goals again."""
        for _ in range(_MOST_RECOVERIES):
            self.exchange()
            now_ns = time.monotonic_ns()
            self._hardware.idle(now_ns + _IDLE_NS, now_ns)
            if (self._torque == Torque.ON).all():
                return

    def sent(self) -> Sent:
        """Return what the log would say of instructions; nothing when more was written than a ring holds."""
        found: list[tuple[int, int]] = []
        while self._recorded is not None and (record := self._recorded.read_record()) is not None:
            if isinstance(record, Gap):
                return ()  # bytes are counted: without some of them there is no result
            found += [
                (first_ns, len(data))
                for _, _, kind, _, first_ns, _, data in split_packets(record.payload)
                if kind == PacketKind.INSTRUCTION
            ]
        return found

    def close(self) -> None:
        """Close the line and the ring."""
        os.close(self._descriptor)
        if self._ring >= 0:
            os.close(self._ring)


class Script:
    """`dxlwire.Bus`, as a script uses it: SI units at both ends."""

    def __init__(self, path: str, case: Case, plan: Plan) -> None:
        (bus,) = plan.buses
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(descriptor)
        ports = SerialPorts([SerialPort(descriptor, path)])
        timing = line_plan(path, bus.baud_rate, case.protocol, bus.latency_ns)
        session = Session(ports, MonotonicClock(), timing, partial(os.close, descriptor))
        table = find_table(case.model, case.protocol)
        servos = ServoSet(ServoGroup(session, [Addressed(each, table) for each in case.ids]))
        self._session = session
        states = table.effort_item, table.present_speed_item, "present_position"
        self._read = servos.reader(*states)
        self._write = servos.writer("goal_position", table.goal_speed_item)
        self._goals = [np.full(case.servos, tick * table.rad_per_tick) for tick in Registers.of(plan).ticks]
        self._everybody = b"\1" * case.servos
        self._turn = 0

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Read, and write other goals."""
        state = self._read()
        self._turn = 1 - self._turn
        self._write(self._goals[self._turn], 0.0)
        return state.valid.tobytes() == self._everybody  # as in `Ours`

    def recover(self) -> None:
        """Exchange until the kernel reads again."""
        for _ in range(_MOST_RECOVERIES):
            self.exchange()

    def sent(self) -> Sent:
        """Nothing is known."""
        return ()

    def close(self) -> None:
        """Close the line."""
        self._session.close()


def _sdk(path: str, case: Case, plan: Plan, values: bool, *, fast: bool = False) -> Host:
    return Sdk(path, case, Registers.of(plan), values=values, fast=fast)


def _rustypot(path: str, case: Case, plan: Plan, values: bool, *, fast: bool = False) -> Host:
    return Rustypot(path, case, Registers.of(plan), values=values, fast=fast)


HOSTS: Sequence[HostKind] = (
    HostKind("ours", "dxlrun", lambda path, case, plan, _: Ours(path, plan)),
    HostKind("polled", "dxlrun", lambda path, case, plan, _: Ours(path, plan, polled=True)),
    HostKind("unrecorded", "dxlrun", lambda path, case, plan, _: Ours(path, plan, recorded=False)),
    HostKind("bus", "dxlwire", lambda path, case, plan, _: Script(path, case, plan)),
    HostKind("floor", "dxlrun", lambda path, case, plan, _: Floor(path, case, plan)),
    HostKind("sdk", "dynamixel_sdk", _sdk),
    HostKind("sdk-fast", "dynamixel_sdk", partial(_sdk, fast=True), (2.0,)),
    HostKind("rustypot", "rustypot", _rustypot),
    HostKind("rustypot-fast", "rustypot", partial(_rustypot, fast=True), (2.0,)),
)
"""The hosts that can be measured."""
