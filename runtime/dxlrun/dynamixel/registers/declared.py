"""Registers as the robot file declares them: compared, only differences written, each read back.

Programs of transactions; nothing here waits. EEPROM wears, and a servo of Protocol 2.0 refuses to write it
while it holds torque (e-Manual XM430-W350, Control Table of EEPROM Area), so then it is never written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dxlrun.dynamixel.control_table import ControlItem, control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.dynamixel.plan.line import Line
from dxlrun.dynamixel.registers.inspection import ATTEMPTS, called, persist, setup_line, shown, who
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply


@dataclass(slots=True)
class Settled:
    """What came of the declared registers of one servo."""

    problems: list[str] = field(default_factory=list)
    """Why it does not have them, one sentence each."""
    written: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what was written: `Position P Gain (84) was 640 and is 800`."""
    silent: bool = False
    """True when the servo answered nothing, so that nothing was written."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A declared register and what the servo has there."""

    register: RegisterValue
    found: int | None
    """The integer on the wire, signed where the item is; None: it could not be read."""

    @property
    def differs(self) -> bool:
        """True when it has to be written."""
        return self.found is not None and self.found != self.register.value


def compare(
    plan: BusPlan, servo: ServoPlan, registers: Sequence[RegisterValue], line: Line
) -> Program[tuple[Difference, ...]]:
    """Read registers of one servo; writes nothing."""
    found = []
    for register in registers:
        reply = yield from persist(line.read(servo.servo_id, register.address, register.size))
        found.append(Difference(register, _integer(_item(plan, servo, register), reply)))
    return tuple(found)


def settle_registers(plan: BusPlan, servo: ServoPlan) -> Program[Settled]:
    """Write the registers of one servo that differ from the robot file, and read them back.

    Nothing is written when one cannot be read, and no EEPROM while the servo holds torque.
    """
    return (yield from settle(plan, servo, servo.registers, setup_line(plan)))


def settle(
    plan: BusPlan, servo: ServoPlan, registers: Sequence[RegisterValue], line: Line
) -> Program[Settled]:
    """Do so with these registers. `line`: how long a reply may take; before the start the longest time."""
    settled = Settled()
    differences = yield from compare(plan, servo, registers, line)
    silent = [one.register for one in differences if one.found is None]
    if silent:
        settled.silent = len(silent) == len(differences)
        settled.problems.append(
            f"{who(plan, servo)} did not answer when {_names(plan, servo, silent)} was read"
        )
        return settled
    differing = [one for one in differences if one.differs]
    stored = [one.register for one in differing if one.register.eeprom]
    if stored and (problem := (yield from _torqued(plan, servo, stored, line))):
        settled.problems.append(f"{who(plan, servo)} {problem}")
        return settled
    for one in differing:
        problem = yield from write_register(plan, servo, one.register, line)
        item = _item(plan, servo, one.register)
        if problem or one.found is None:
            settled.problems.append(f"{who(plan, servo)} {problem}")
        else:
            text = f"{called(item)} was {shown(item, one.found)} and is {one.register.value}"
            settled.written.append((servo.joint, text))
    return settled


def merged(registers: Sequence[RegisterValue], newer: RegisterValue) -> tuple[RegisterValue, ...]:
    """Return registers with one of them changed, or one more behind the others."""
    found = {one.name: one for one in registers}
    found[newer.name] = newer
    return tuple(found.values())


def settle_bus(plan: BusPlan) -> Program[Settled]:
    """Do so with every servo of a bus, whatever became of the one before."""
    together = Settled()
    for servo in plan.servos:
        settled = yield from settle_registers(plan, servo)
        together.problems += settled.problems
        together.written += settled.written
    return together


def write_register(plan: BusPlan, servo: ServoPlan, register: RegisterValue, line: Line) -> Program[str]:
    """Write one register and read it back; return what went wrong, or nothing.

    The read-back decides, and whether to try again: an acknowledgement may be lost, or switched off by Status
    Return Level, and EEPROM wears.
    """
    item = _item(plan, servo, register)
    problem = ""
    for _ in range(ATTEMPTS):
        written = yield line.write(servo.servo_id, register.address, register.data)
        if written.outcome is Outcome.REFUSED:
            return f"refuses {called(item)} = {register.value}: {line.dialect.describe_error(written.error)}"
        back = yield from persist(line.read(servo.servo_id, register.address, register.size))
        found = _integer(item, back)
        if found == register.value:
            return ""
        problem = f"was given {called(item)} = {register.value}, but has {found}"
        if found is None:
            problem = f"did not answer when {called(item)} was read back"
    return problem


def _torqued(plan: BusPlan, servo: ServoPlan, stored: Sequence[RegisterValue], line: Line) -> Program[str]:
    reply = yield from persist(line.read(servo.servo_id, servo.torque_address, 1))
    names = _names(plan, servo, stored)
    if not reply.answered:
        return f"did not answer when its torque was asked for, so {names} was not written"
    if reply.parameters[0]:
        return (
            f"holds torque, so {names} in its EEPROM was not written: switch its torque off and start again, "
            "without --take-over"
        )
    return ""


def _item(plan: BusPlan, servo: ServoPlan, register: RegisterValue) -> ControlItem:
    return control_table(servo.model, plan.protocol).items[register.name]


def _integer(item: ControlItem, reply: Reply) -> int | None:
    if not reply.answered:
        return None
    return int.from_bytes(reply.parameters[: item.size], "little", signed=item.signed)


def _names(plan: BusPlan, servo: ServoPlan, registers: Sequence[RegisterValue]) -> str:
    return ", ".join(called(_item(plan, servo, register)) for register in registers)
