"""Inspection before a run: reads the connected models, and finds the problems that a start would find;
nothing is written.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager

import msgspec
from msgspec.structs import replace

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import choose_remedy
from dxlrun.dynamixel.servo.checks import LISTEN_NS, inspect_servo, survey
from dxlrun.dynamixel.servo.item_access import Access, first_reach
from dxlrun.dynamixel.servo.mode_switches import read_limits, servo_limits
from dxlrun.dynamixel.servo.registers import read_registers
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import StartUpError
from dxlrun.plan.loop_plan import JointPlan
from dxlwire.bus.programs import identity
from dxlwire.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlwire.control_table import ControlTable, FoundDeviation, find_table, models_by_number
from dxlwire.packets import PacketSink
from dxlwire.plan.line import listen_transaction
from dxlwire.plan.retry import extend_timeouts, retry, setup_line
from dxlwire.transaction import Program, Reply, Result, TransactionOutcome

NOWHERE: Mapping[str, PacketSink] = {}  # no bus logs its packets
NO_JOINTS: Mapping[int, JointPlan] = {}
Opened = Callable[[BusPlan], AbstractContextManager[TunablePort]]
"""Function that opens the port of a bus."""


def open_bus(plan: BusPlan) -> TunablePort:
    """Open the port of a bus. Raises PortError."""
    return TunablePort(plan.port, plan.baud_rate, rs485=plan.rs485, boot_ns=plan.boot_ns)


class Identity(msgspec.Struct, frozen=True):
    """Result of reading the model of one joint's servo; either `model` or `problem` is empty."""

    joint: str
    model: str  # name of the control table
    problem: str  # reason for the missing model, one sentence


class RegisterRow(msgspec.Struct, frozen=True):
    """One register that the robot file declares, with its value in the servo."""

    joint: str
    item: str
    address: int
    area: str  # `EEPROM` or `RAM`
    declared: int  # integer on the wire, like `found`
    found: int | None  # None: no answer
    action: str  # action of a run: `nothing`, `write`, or empty if it would not start


class DeviationRow(msgspec.Struct, frozen=True):
    """One setting of a servo that differs from the factory's and that a start would report."""

    joint: str
    servo: str  # `ID 4 on bus main`
    item: str
    address: int
    area: str  # `EEPROM` or `RAM`
    found: int  # integer on the wire, like `factory`
    factory: int
    effect: str  # effect of the value: a verb with its object


class InspectionResult(msgspec.Struct):
    """Result of an inspection of all servos of a robot, in the order of the plans."""

    compared: int = 0  # number of servos that were compared with the file
    registers: list[RegisterRow] = []
    deviations: list[DeviationRow] = []
    problems: list[str] = []  # reasons why a run would not start, one sentence each
    remarks: list[str] = []  # other differences from the robot file

    @property
    def as_declared(self) -> bool:
        """True if a run would start and would write no register."""
        return not self.problems and all(row.found == row.declared for row in self.registers)


def read_models(
    buses: Sequence[BusPlan], joints: Sequence[str], packets: Mapping[str, PacketSink] = NOWHERE
) -> Mapping[str, str]:
    """Read which model each servo with `model: auto` in the robot file is, bus by bus.

    Args:
        buses: Plans of the lines.
        joints: Joints with `model: auto`.
        packets: Log of each bus's packets, by its name.

    Returns:
        The model of each of the joints.

    Raises:
        StartUpError: Servos cannot be identified; a sentence for each.
        PortError: A port cannot be opened or is gone.
    """
    concerned = [bus for bus in buses if any(servo.joint in joints for servo in bus.servos)]
    found = identify(concerned, joints, packets)
    problems = [one.problem for one in found.values() if one.problem]
    if problems:
        raise StartUpError("\n".join(problems))
    return {joint: one.model for joint, one in found.items()}


def inspect_buses(
    buses: Sequence[BusPlan],
    packets: Mapping[str, PacketSink] = NOWHERE,
    joints: Mapping[int, JointPlan] = NO_JOINTS,
    opened: Opened = open_bus,
) -> InspectionResult:
    """Check every servo and every declared register as a start does, without writing, bus by bus.

    Args:
        buses: Plans of the lines.
        packets: Log of each bus's packets, by its name.
        joints: Joint of each servo that moves one alone, by row; registers are compared with the joint's
            limits.
        opened: Opens the port of a bus.

    Raises:
        PortError: A port cannot be opened or is gone.
    """
    together = InspectionResult()
    for plan in buses:
        one = _run(_look(plan, joints), plan, packets, opened)
        together.compared += one.compared
        together.registers += one.registers
        together.deviations += one.deviations
        together.problems += one.problems
        together.remarks += one.remarks
    if together.problems:
        together.registers = [replace(row, action="") for row in together.registers]
    return together


def compare_servos(tool: ToolLine, plan: BusPlan, servos: Sequence[ServoPlan]) -> Findings:
    """Compare connected servos of one bus with the robot file, as a start does, and with `stored_registers`.
    Writes nothing.

    Args:
        tool: The line of their bus.
        plan: The bus.
        servos: The connected servos of the bus.

    Returns:
        Findings whose `problems` name each servo that does not answer or differs.
    """
    tool.speak(plan.protocol, plan.baud_rate)
    return tool.run_program(extend_timeouts(_compare_servos(plan, servos)))


def _compare_servos(plan: BusPlan, servos: Sequence[ServoPlan]) -> Program[Findings]:
    survey = Findings()
    for servo in servos:
        one = first_reach(plan, servo)
        reply = yield from retry(one.line.ping(servo.servo_id))
        if not reply.answered:
            how = "does not answer" if reply.outcome is TransactionOutcome.TIMEOUT else "answers garbled"
            survey.problems.append(f"{plan.label(servo)} {how} at {plan.baud_rate} bit/s")
            continue
        if not (yield from inspect_servo(one, survey, take_over=True)):
            continue
        table = find_table(servo.model, plan.protocol)
        stored = stored_registers(table, plan, servo)
        present = yield from read_registers(one, stored)
        for each in stored:
            title, raw = table.items[each.name].title, present[each.name]
            if raw is None:
                survey.problems.append(f"{one} did not answer when {title} was read")
            elif raw != each.value:
                survey.problems.append(f"{one} has {title} = {raw}, not {each.value}")
    return survey


def stored_registers(table: ControlTable, plan: BusPlan, servo: ServoPlan) -> tuple[RegisterValue, ...]:
    """Return the EEPROM registers that a servo should have: those that the robot file declares or expects,
    and the return delay of its bus.

    RAM registers are omitted, because every run writes them.
    """
    declared = [one for one in (*servo.settings, *servo.expected) if one.eeprom]
    item = table.items.get("return_delay_time")
    if item is not None and all(one.name != item.name for one in declared):
        raw = round(plan.return_delay_ns / 2_000)
        if item.minimum <= raw <= item.maximum:
            declared.append(RegisterValue(item.address, item.size, raw, item.name, True))
    return tuple(declared)


def identify(
    plans: Sequence[BusPlan],
    joints: Collection[str],
    packets: Mapping[str, PacketSink] = NOWHERE,
    opened: Opened = open_bus,
) -> Mapping[str, Identity]:
    """Read the model numbers of the servos of these joints; return model or problem of each, by joint.

    The plans can have any model of the bus' protocol: only ports, IDs and times are used.

    Raises:
        PortError: A port cannot be opened or is gone.
    """
    found = [_run(_identify(plan, joints), plan, packets, opened) for plan in plans]
    return {one.joint: one for identities in found for one in identities}


def _run(
    program: Program[Result], plan: BusPlan, packets: Mapping[str, PacketSink], opened: Opened
) -> Result:
    """Run a program with longer timeouts on the port of a bus, and return its result; raises PortError."""
    with opened(plan) as port:
        tool = ToolLine(port, packets.get(plan.name))
        tool.speak(plan.protocol, plan.baud_rate)
        return tool.run_program(extend_timeouts(program))


def _look(plan: BusPlan, joints: Mapping[int, JointPlan]) -> Program[InspectionResult]:
    surveyed = Findings()
    yield from survey(plan, False, surveyed)
    remarks = [f"{joint}: {text}" for joint, text in surveyed.texts(EventCode.REGISTER_DIFFERS)]
    answered = [joint for joint, _ in surveyed.texts(EventCode.SETUP)]  # One text for each servo
    found = InspectionResult(len(answered), problems=surveyed.problems, remarks=remarks)
    found.deviations = [_deviation(*one) for one in surveyed.deviations]
    for servo in plan.servos:
        present: dict[str, int | None] = {}
        if servo.joint in answered:
            present = yield from read_registers(first_reach(plan, servo), servo.settings)
            found.remarks += yield from _tighter_limits(first_reach(plan, servo), joints.get(servo.row))
        found.registers += [_row(plan, servo, one, present.get(one.name)) for one in servo.settings]
    return found


def _tighter_limits(one: Access, joint: JointPlan | None) -> Program[list[str]]:
    """Return a sentence for each limit register of a servo that is tighter than the limits of its joint in
    the robot file.
    """
    if joint is None:
        return []
    limits = servo_limits(one, (yield from read_limits(one)))
    joint = replace(joint, servo_limits=limits)
    tighter = [own for own in limits if joint.exceeds_file_limit(own.interface)]
    return [f"{joint.name}: {joint.describe_servo_limit(own)}" for own in tighter]


def _deviation(joint: str, servo: str, one: FoundDeviation) -> DeviationRow:
    item = one.item
    return DeviationRow(joint, servo, item.name, item.address, item.area, one.found, one.factory, one.effect)


def _row(plan: BusPlan, servo: ServoPlan, wanted: RegisterValue, found: int | None) -> RegisterRow:
    item = find_table(servo.model, plan.protocol).items[wanted.name]
    action = "nothing" if found in (None, wanted.value) else "write"
    return RegisterRow(servo.joint, item.name, item.address, item.area, wanted.value, found, action)


def _identify(plan: BusPlan, joints: Collection[str]) -> Program[tuple[Identity, ...]]:
    line = setup_line(plan)
    yield listen_transaction(LISTEN_NS)
    identities: list[Identity] = []
    for servo in plan.servos:
        if servo.joint not in joints:
            continue
        _, reply = yield from identity(line, servo.servo_id)
        identities.append(_identity(plan, servo, reply))
    return tuple(identities)


def _identity(plan: BusPlan, servo: ServoPlan, reply: Reply) -> Identity:
    name = plan.label(servo)
    if not reply.answered:
        remedy = choose_remedy(plan.port, "check power, cable, and ID", simulated="check its ID")
        how = (
            f"does not answer at {plan.baud_rate} bit/s: {remedy}"
            if reply.outcome is TransactionOutcome.TIMEOUT
            else "sends garbled replies: do two servos have its ID?"
        )
        problem = f"{name} {how}; its model is unknown: write it in the robot file"
        return Identity(servo.joint, "", problem)
    number, firmware = reply.word(), reply.parameters[2]
    if tables := models_by_number(number, plan.protocol, firmware):
        return Identity(servo.joint, tables[0].model, "")
    problem = (
        f"{name} has model number {number}, firmware {firmware}, without a control table of Protocol "
        f"{plan.protocol}: add one with a plug-in"
    )
    return Identity(servo.joint, "", problem)
