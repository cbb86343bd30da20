"""Hosts: programs that exchange with servos; ours, the maker's SDK, and rustypot, each in one call a cycle.

All read and write the same registers. The others are asked for raw bytes and given prepared ones, which is
less than a program needs; ours also turns them into SI units, and keeps every packet for the log.
"""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from dxlrun.assembly import assemble
from dxlrun.bench.case import Case, Registers
from dxlrun.clock import MonotonicClock
from dxlrun.commands import NoCommands
from dxlrun.compile.plan import Plan
from dxlrun.control.loop import StopFlag
from dxlrun.control.plugins import load_plugins
from dxlrun.cycle import CycleRecord
from dxlrun.dynamixel.port import SerialPort, SerialPorts
from dxlrun.errors import InputError
from dxlrun.events import EventCode, Severity
from dxlrun.packets import PACKET_SLOT, NoPackets, PacketBatch, packet_slots
from dxlrun.ring import RingWriter, create

PATIENCE_S = 1.0
"""rustypot waits so long for a reply; the SDK has a time of its own."""
_IDLE_NS = 50_000_000


class Host(Protocol):
    """A program with a line of its own."""

    def start(self) -> None:
        """Do what must be done once; servos answer."""
        ...

    def exchange(self) -> bool:
        """Read every servo and write every goal; False when a reply was lost."""
        ...

    def mend(self) -> None:
        """Come back to whole exchanges after a lost reply; servos answer."""
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...


@dataclass(frozen=True, slots=True)
class HostKind:
    """How a host is called, and made."""

    name: str
    what: str
    """For a person."""
    module: str
    """What must be installed for it."""
    make: Callable[[str, Case, Plan], Host]

    @property
    def missing(self) -> bool:
        """True when it is not installed here."""
        return find_spec(self.module) is None


class _Events:
    """Takes events and forgets them."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str) -> None:
        """Forget it."""


@dataclass(frozen=True, slots=True)
class _Sinks:
    """Where our loop's parts would put what they have."""

    packets: PacketBatch | NoPackets
    events: _Events
    commands: NoCommands

    def begin(self, record: CycleRecord) -> None:
        """Forget it."""

    def append(self, record: CycleRecord) -> None:
        """Forget it."""


class Ours:
    """The exchange of our loop: `DynamixelHardware` as a run assembles it, on a real descriptor."""

    def __init__(self, path: str, plan: Plan, *, recorded: bool) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._descriptor)
        self._ring = -1
        packets: PacketBatch | NoPackets = NoPackets()
        if recorded:
            servos = sum(len(bus.servos) for bus in plan.buses)
            self._ring = create("bench", PACKET_SLOT, packet_slots(1_000_000, servos))
            packets = PacketBatch(RingWriter(self._ring))
        self._commit = packets.commit
        robot = assemble(
            plan,
            load_plugins(),
            ports=SerialPorts([SerialPort(self._descriptor, path)]),
            clock=MonotonicClock(),
            sinks=_Sinks(packets, _Events(), NoCommands()),
            beat=lambda: None,
            stop=StopFlag(),
            take_over=True,
        )
        self._hardware = robot.hardware
        self._valid = robot.record.states.valid
        self._goal = robot.record.goals.position
        self._goals = self._goal.copy(), self._goal.copy()
        self._turn = 0

    def start(self) -> None:
        """Run the start-up of a run."""
        self._hardware.start()
        self._goals = self._goal.copy(), self._goal + 0.002  # rad: more than a tick

    def exchange(self) -> bool:
        """Read, set other goals, write, and hand the packets on, as a cycle does."""
        self._hardware.read()
        self._turn = 1 - self._turn
        self._goal[:] = self._goals[self._turn]
        self._hardware.write()
        self._commit()
        return bool(self._valid.all())

    def mend(self) -> None:
        """Exchange, and use the gap for what is owed to a servo that was silent."""
        self.exchange()
        self._hardware.idle(time.monotonic_ns() + _IDLE_NS)

    def close(self) -> None:
        """Close the line and the ring."""
        os.close(self._descriptor)
        if self._ring >= 0:
            os.close(self._ring)


class Sdk:
    """The groups of dynamixel-sdk; Protocol 1.0 has no sync read, an AX no bulk read: one by one."""

    def __init__(self, path: str, case: Case, registers: Registers) -> None:
        import dynamixel_sdk as sdk

        self._good = sdk.COMM_SUCCESS
        self._ids, self._registers = case.ids, registers
        self._port = sdk.PortHandler(path)
        if not self._port.setBaudRate(case.baud_rate):
            raise InputError(f"dynamixel-sdk does not know the rate {case.baud_rate} bit/s")
        self._packets = sdk.PacketHandler(case.protocol)
        address, length = registers.read_address, registers.read_length
        self._read = sdk.GroupSyncRead(self._port, self._packets, address, length)
        self._write = sdk.GroupSyncWrite(
            self._port, self._packets, registers.write_address, len(registers.goals[0])
        )
        for each in case.ids:
            self._read.addParam(each)
            self._write.addParam(each, list(registers.goals[0]))
        self._goals = [list(goal) for goal in registers.goals]
        self._turn = 0
        self._ask = self._one_by_one if case.protocol == 1.0 else self._together

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Read by a group, or one by one; write by a group."""
        good = self._ask()
        self._turn = 1 - self._turn
        goal = self._goals[self._turn]
        for each in self._ids:
            self._write.changeParam(each, goal)
        return bool(self._write.txPacket() == self._good) and good

    def mend(self) -> None:
        """Throw away what is left, and exchange."""
        self._port.clearPort()
        self.exchange()

    def close(self) -> None:
        """Close the line."""
        self._port.closePort()

    def _together(self) -> bool:
        return bool(self._read.txRxPacket() == self._good)

    def _one_by_one(self) -> bool:
        one, address, length = (
            self._packets.readTxRx,
            self._registers.read_address,
            self._registers.read_length,
        )
        good = [one(self._port, each, address, length)[1] == self._good for each in self._ids]
        return all(good)


class Rustypot:
    """rustypot's raw-address calls; Protocol 1.0 as for the SDK."""

    def __init__(self, path: str, case: Case, registers: Registers) -> None:
        import rustypot

        make = rustypot.AxPyController if case.protocol == 1.0 else rustypot.Xl430PyController
        self._bus = make(path, case.baud_rate, PATIENCE_S)
        self._ids, self._registers = list(case.ids), registers
        self._goals = [[list(goal) for _ in case.ids] for goal in registers.goals]
        self._turn = 0
        self._ask = self._one_by_one if case.protocol == 1.0 else self._together

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Read in one call, or one by one; write in one call."""
        try:
            self._ask()
            self._turn = 1 - self._turn
            self._bus.sync_write_raw_data(self._ids, self._registers.write_address, self._goals[self._turn])
        except RuntimeError:  # what it raises for a lost reply
            return False
        return True

    def mend(self) -> None:
        """Exchange; it throws away what is left by itself."""
        self.exchange()

    def close(self) -> None:
        """Close the line."""
        self._bus.close()

    def _together(self) -> None:
        self._bus.sync_read_raw_data(self._ids, self._registers.read_address, self._registers.read_length)

    def _one_by_one(self) -> None:
        read, address, length = (
            self._bus.read_raw_data,
            self._registers.read_address,
            self._registers.read_length,
        )
        for each in self._ids:
            read(each, address, length)


HOSTS: Sequence[HostKind] = (
    HostKind(
        "ours",
        "dxlrun, every packet kept for the log",
        "dxlrun",
        lambda path, case, plan: Ours(path, plan, recorded=True),
    ),
    HostKind(
        "unrecorded",
        "dxlrun without a log",
        "dxlrun",
        lambda path, case, plan: Ours(path, plan, recorded=False),
    ),
    HostKind(
        "sdk",
        "dynamixel-sdk's groups",
        "dynamixel_sdk",
        lambda path, case, plan: Sdk(path, case, Registers.of(plan)),
    ),
    HostKind(
        "rustypot",
        "rustypot's raw-address calls",
        "rustypot",
        lambda path, case, plan: Rustypot(path, case, Registers.of(plan)),
    ),
)
"""Who can be measured."""
