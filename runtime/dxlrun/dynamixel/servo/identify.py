"""Identify: which model answers under an ID, for joints whose robot file says `model: auto`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from dxlrun.clock import Clock
from dxlrun.dynamixel.control_table import models_by_number
from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.pump import run
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.servo.checks import LISTEN_NS
from dxlrun.dynamixel.servo.retry import extend_timeouts, retry, setup_line
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply
from dxlrun.run.channels.packets import NoPackets, PacketSink

_IDENTITY_LENGTH = 3
"""Model number (2) and firmware version (1): the answer to a ping of Protocol 2.0, bytes 0..2 in 1.0."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What answered for one joint; either `model` or `problem` is empty."""

    joint: str
    model: str
    """Name of the control table."""
    number: int
    """Model number that the servo reports; -1 when it does not answer."""
    firmware: int
    problem: str
    """Why there is no model, one sentence."""


def identify(
    plans: Sequence[BusPlan],
    joints: Collection[str],
    ports: Ports,
    clock: Clock,
    *,
    packets: PacketSink | None = None,
    beat: Callable[[], None] = lambda: None,
) -> Mapping[str, Identity]:
    """Read the model numbers of the servos of some joints; return their models, by joint.

    `plans` are made with any model of the bus' protocol: only ports, IDs and times count. Writes nothing to a
    servo. Raises PortError when a line is gone.
    """
    sink = NoPackets() if packets is None else packets
    buses = [
        Bus(index, plan, port, clock, sink)
        for index, (plan, port) in enumerate(zip(plans, ports.ports, strict=True))
    ]
    found = run([extend_timeouts(_ask(plan, joints)) for plan in plans], buses, ports, clock, beat)
    for bus in buses:
        if bus.failure is not None:
            raise bus.failure
    return {one.joint: one for answers in found if answers is not None for one in answers}


def _ask(plan: BusPlan, joints: Collection[str]) -> Program[tuple[Identity, ...]]:
    line = setup_line(plan)
    yield listen(LISTEN_NS)
    identities: list[Identity] = []
    for servo in plan.servos:
        if servo.joint not in joints:
            continue
        reply = yield from retry(line.ping(servo.servo_id))
        if reply.answered and line.dialect.PING_LENGTH < _IDENTITY_LENGTH:
            reply = yield from retry(line.read(servo.servo_id, 0, _IDENTITY_LENGTH))
        identities.append(_identity(plan, servo, reply))
    return tuple(identities)


def _identity(plan: BusPlan, servo: ServoPlan, reply: Reply) -> Identity:
    name = plan.label(servo)
    if not reply.answered:
        how = (
            f"does not answer at {plan.baud_rate} bit/s: check power, cable, and ID"
            if reply.outcome is Outcome.TIMEOUT
            else "answers garbled: do two servos have its ID?"
        )
        return Identity(
            servo.joint, "", -1, 0, f"{name} {how}; its model is not known, so write it in the robot file"
        )
    number, firmware = reply.word(), reply.parameters[2]
    for table in models_by_number(number, plan.protocol):
        if table.firmware <= firmware:
            return Identity(servo.joint, table.model, number, firmware, "")
    problem = (
        f"{name} is model number {number}, firmware {firmware}, and no control table of Protocol "
        f"{plan.protocol} has it: a plug-in can add one"
    )
    return Identity(servo.joint, "", number, firmware, problem)
