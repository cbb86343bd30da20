"""Registers of a servo as declared: compared, only differences written, each read back; torque limits.

EEPROM wears, and a servo of Protocol 2.0 refuses to write it while it holds torque (e-Manual XM430-W350,
Control Table of EEPROM Area), so then it is never written.

Torque limit of Protocol 1.0: Torque Limit (34), which begins as Max Torque (14) (e-Manual AX-12A). Of 2.0:
Goal PWM (100), which in position control limits the PWM, up to PWM Limit (36) (e-Manual XM430-W350); XL-320
has Torque Limit (35). All of them are RAM: what a policy reduced stays so until power-off, unless it is
written again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import ControlItem, control_table
from dxlrun.dynamixel.plan.line import Line
from dxlrun.dynamixel.plan.retry import ATTEMPTS, retry, setup_line
from dxlrun.dynamixel.servo.watchdog import shown, tripped
from dxlrun.dynamixel.wire.dialect import dialect_of, sync_writes
from dxlrun.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.plan.transaction import Outcome, Program, Reply


class Settled(msgspec.Struct):
    """What came of the declared registers of one servo."""

    problems: list[str] = []  # Why it does not have them, one sentence each
    written: list[tuple[str, str]] = []
    """Joint, and what was written: `Position P Gain (84) was 640 and is 800`."""
    found: dict[str, int] = {}  # What the servo had before, by item
    silent: bool = False  # True when the servo answered nothing, so that nothing was written


class RegisterDifference(msgspec.Struct, frozen=True):
    """A declared register and what the servo has there."""

    register: RegisterValue
    found: int | None
    """The integer on the wire, signed where the item is; None: it could not be read."""

    @property
    def differs(self) -> bool:
        """True when it has to be written."""
        return self.found is not None and self.found != self.register.value


class TorqueLimits(msgspec.Struct):
    """What is known of the torque limits of one bus' servos."""

    full: list[int] = []
    """The servos' own limits in ticks, in the order of the plan's; 0: it has none that is known."""
    problems: list[str] = []
    restored: list[tuple[str, str]] = []  # Joint, and what its limit had been


def compare(
    plan: BusPlan, servo: ServoPlan, registers: Sequence[RegisterValue], line: Line
) -> Program[tuple[RegisterDifference, ...]]:
    """Read registers of one servo; writes nothing."""
    found = []
    for register in registers:
        reply = yield from retry(line.read(servo.servo_id, register.address, register.size))
        found.append(RegisterDifference(register, _integer(_item(plan, servo, register), reply)))
    return tuple(found)


def settle(
    plan: BusPlan, servo: ServoPlan, registers: Sequence[RegisterValue], line: Line
) -> Program[Settled]:
    """Write the registers that a servo has otherwise, and read them back.

    Nothing is written when one cannot be read, and no EEPROM while the servo holds torque. `line`: how long a
    reply may take; before the start the longest time.
    """
    settled = Settled()
    differences = yield from compare(plan, servo, registers, line)
    settled.found = {one.register.name: one.found for one in differences if one.found is not None}
    silent = [one.register for one in differences if one.found is None]
    if silent:
        settled.silent = len(silent) == len(differences)
        settled.problems.append(
            f"{plan.label(servo)} did not answer when {_names(plan, servo, silent)} was read"
        )
        return settled
    differing = [one for one in differences if one.differs]
    stored = [one.register for one in differing if one.register.eeprom]
    if stored and (problem := (yield from _torqued(plan, servo, stored, line))):
        settled.problems.append(f"{plan.label(servo)} {problem}")
        return settled
    for one in differing:
        problem = yield from write_register(plan, servo, one.register, line)
        item = _item(plan, servo, one.register)
        if problem or one.found is None:
            settled.problems.append(f"{plan.label(servo)} {problem}")
        else:
            text = f"{item.title} was {shown(item, one.found)} and is {one.register.value}"
            settled.written.append((servo.joint, text))
    return settled


def settle_bus(plan: BusPlan) -> Program[Settled]:
    """Write what the robot file declares for the servos of a bus, each whatever became of the one before."""
    together = Settled()
    for servo in plan.servos:
        settled = yield from settle(plan, servo, servo.registers, setup_line(plan))
        together.problems += settled.problems
        together.written += settled.written
    return together


def merged(registers: Sequence[RegisterValue], newer: RegisterValue) -> tuple[RegisterValue, ...]:
    """Return registers with one of them changed, or one more behind the others."""
    found = {one.name: one for one in registers}
    found[newer.name] = newer
    return tuple(found.values())


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
            return f"refuses {item.title} = {register.value}: {line.dialect.describe_error(written.error)}"
        back = yield from retry(line.read(servo.servo_id, register.address, register.size))
        found = _integer(item, back)
        if found == register.value:
            return ""
        problem = f"was given {item.title} = {register.value}, but has {found}"
        if found is None:
            problem = f"did not answer when {item.title} was read back"
    return problem


def meaning(item: ControlItem, value: int) -> str:
    """Return a value of an item with its unit; empty for what has none."""
    if tripped(item, value):
        return "tripped"
    if not item.unit and item.encoding != "float32":
        return ""
    quantity = item.value(value.to_bytes(item.size, "little", signed=item.signed))
    if not item.unit:
        return f"{quantity:.6g}"
    if item.unit == "s" and abs(quantity) < 1:
        return f"{quantity * 1e3:.6g} ms" if abs(quantity) >= 1e-3 else f"{quantity * 1e6:.6g} us"
    if item.unit.startswith("rad"):
        return f"{math.degrees(quantity):.6g} {item.unit.replace('rad', 'deg')}"
    return f"{quantity * 100:.6g} %" if item.unit == "1" else f"{quantity:.6g} {item.unit}"


def restore_torque_limits(plan: BusPlan) -> Program[TorqueLimits]:
    """Give every servo all of its torque again, after its goal is where it stands.

    One that was weak and held may have sagged: with an old goal it would spring back.
    """
    found = TorqueLimits()
    line = setup_line(plan)
    for servo in plan.servos:
        place = servo.torque_limit
        found.full.append(0)
        if place is None:
            continue
        full = yield from retry(line.read(servo.servo_id, place.full_address, place.size))
        now = yield from retry(line.read(servo.servo_id, place.address, place.size))
        if not (full.answered and now.answered):
            found.problems.append(f"{plan.label(servo)} did not answer when its torque limit was read")
            continue
        most, present = (reply.word(place.size) for reply in (full, now))
        found.full[-1] = most
        if present != most and _limits(servo, servo.start_mode):
            data = most.to_bytes(place.size, "little")
            written = yield from retry(line.write(servo.servo_id, place.address, data))
            if written.answered:
                text = f"{place.name} was {present} and is {most} again"
                found.restored.append((servo.joint, text))
            else:
                found.problems.append(f"{plan.label(servo)} did not acknowledge {place.name}")
    return found


def reduced_torque_limits(
    plan: BusPlan, full: Sequence[int], fraction: float, modes: Sequence[Mode]
) -> list[bytes]:
    """Return the packets that leave each servo a fraction of its own limit, one tick at least.

    `modes`: in which the servos are; one whose mode is changing is left alone.
    """
    writes = [
        (servo.servo_id, place.address, max(1, round(own * fraction)).to_bytes(place.size, "little"))
        for servo, own, mode in zip(plan.servos, full, modes, strict=True)
        if (place := servo.torque_limit) is not None and own and _limits(servo, mode)
    ]
    return sync_writes(dialect_of(plan.protocol), writes)


def _limits(servo: ServoPlan, mode: Mode) -> bool:
    """Return whether the torque limit limits in a mode; where Goal PWM is the goal, it would drive."""
    place = servo.torque_limit
    if place is None or mode is Mode.UNKNOWN:
        return False
    return all(goal.address != place.address for goal in servo.mode_plan(mode).goals)


def _torqued(plan: BusPlan, servo: ServoPlan, stored: Sequence[RegisterValue], line: Line) -> Program[str]:
    reply = yield from retry(line.read(servo.servo_id, servo.torque_address, 1))
    names = _names(plan, servo, stored)
    if not reply.answered:
        return f"did not answer when its torque was read, so {names} was not written"
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
    return ", ".join(_item(plan, servo, register).title for register in registers)
