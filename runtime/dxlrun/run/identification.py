"""Identification: what servos on real ports are and hold, asked before a run; nothing is written to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from dxlrun.clock import MonotonicClock
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.pump import run
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.port.ports import SerialPort, SerialPorts
from dxlrun.dynamixel.port.serial_open import open_serial
from dxlrun.dynamixel.servo.checks import survey
from dxlrun.dynamixel.servo.identify import identify
from dxlrun.dynamixel.servo.registers import RegisterDifference, compare
from dxlrun.dynamixel.servo.retry import extend_timeouts, setup_line
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.errors import StartUpError
from dxlrun.run.channels.packets import NoPackets


@dataclass(frozen=True, slots=True)
class RegisterRow:
    """One declared register and what the servo holds there."""

    joint: str
    item: str
    address: int
    area: str
    """`EEPROM` or `RAM`."""
    declared: int
    """The integer on the wire, as `found`."""
    found: int | None
    """None: it did not answer."""
    action: str
    """What a run would do: `nothing`, `write`, or empty where it would not start."""


@dataclass(slots=True)
class Found:
    """What the servos said, in the order of the plans."""

    registers: list[RegisterRow] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    """Why a run would not start, one sentence each."""
    remarks: list[str] = field(default_factory=list)
    """What else is otherwise than the robot file assumes."""

    @property
    def as_declared(self) -> bool:
        """True when a run would start, and would write no register."""
        return not self.problems and all(row.found == row.declared for row in self.registers)


def ask_servos(buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    """Return the models of the servos of `joints`, by joint; opens their ports, and lets go of them.

    Raises StartUpError with a sentence for every servo that cannot be identified, PortError when a port
    cannot be opened or is gone.
    """
    asked = [bus for bus in buses if any(servo.joint in joints for servo in bus.servos)]
    with _lines(asked) as ports:
        found = identify(asked, joints, ports, MonotonicClock())
    problems = [one.problem for one in found.values() if one.problem]
    if problems:
        raise StartUpError("\n".join(problems))
    return {joint: one.model for joint, one in found.items()}


def look(buses: Sequence[BusPlan]) -> Found:
    """Look at every servo as a start does, and at every declared register; opens the ports, writes nothing.

    Raises PortError when a port cannot be opened or is gone.
    """
    clock = MonotonicClock()
    with _lines(buses) as ports:
        lines = [
            Bus(index, plan, port, clock, NoPackets())
            for index, (plan, port) in enumerate(zip(buses, ports.ports, strict=True))
        ]
        found = run([extend_timeouts(_look(plan)) for plan in buses], lines, ports, clock)
    for line in lines:
        if line.failure is not None:
            raise line.failure
    together = Found()
    for one in found:
        if one is not None:
            together.registers += one.registers
            together.problems += one.problems
            together.remarks += one.remarks
    if together.problems:
        together.registers = [replace(row, action="") for row in together.registers]
    return together


def _look(plan: BusPlan) -> Program[Found]:
    surveyed = yield from survey(plan, take_over=False)
    found = Found(
        problems=surveyed.problems, remarks=[f"{who}: {what}" for who, what in surveyed.differences]
    )
    answered = {joint for joint, _ in surveyed.servos}
    for servo in plan.servos:
        differences = [RegisterDifference(register, None) for register in servo.registers]
        if servo.joint in answered:
            differences = list((yield from compare(plan, servo, servo.registers, setup_line(plan))))
        found.registers += [_row(plan, servo, one) for one in differences]
    return found


def _row(plan: BusPlan, servo: ServoPlan, one: RegisterDifference) -> RegisterRow:
    register = one.register
    item = control_table(servo.model, plan.protocol).items[register.name]
    action = "write" if one.differs else "nothing"
    return RegisterRow(servo.joint, item.name, item.address, item.area, register.value, one.found, action)


@contextmanager
def _lines(buses: Sequence[BusPlan]) -> Iterator[SerialPorts]:
    """Open the ports of some buses for this process alone, and let go of them."""
    opened = []
    try:
        for bus in buses:
            opened.append(open_serial(bus.port, bus.baud_rate))
        yield SerialPorts(
            [SerialPort(port.fileno(), bus.port) for port, bus in zip(opened, buses, strict=True)]
        )
    finally:
        for port in opened:
            port.close()
