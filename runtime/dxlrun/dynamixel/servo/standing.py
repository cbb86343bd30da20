"""Standing: what a robot that is left with its torque on needs where a joint is led by no position.

The loop lets such joints stand before it ends; when it died the guardian does. Needs no numpy, as `limp`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.pump import run
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.registers import modes
from dxlrun.dynamixel.registers.inspection import persist, who
from dxlrun.dynamixel.servo.limp import LONGER_NS, SETTLE_NS
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.mode import Mode
from dxlrun.run.channels.packets import PacketSink

_HOLD = (Mode.POSITION, Mode.EFFORT_POSITION)
"""Modes in which a servo holds by itself what it was told last; in the others it goes on moving."""


def stand(
    plans: Sequence[BusPlan],
    ports: Ports,
    clock: Clock,
    packets: PacketSink,
    beat: Callable[[], None] = lambda: None,
) -> tuple[str, ...]:
    """Stop every joint that has torque and is led by a velocity, an effort or a PWM; return a sentence each.

    One that does not take a goal of 0 loses its torque, as one whose mode cannot be read. Raises nothing.
    """
    buses = [
        Bus(index, plan, port, clock, packets)
        for index, (plan, port) in enumerate(zip(plans, ports.ports, strict=True))
    ]
    found = run([_stand(plan) for plan in plans], buses, ports, clock, beat)
    return tuple(sentence for one in found for sentence in one or ())


def _stand(plan: BusPlan) -> Program[list[str]]:
    yield listen(SETTLE_NS)
    said: list[str] = []
    left: dict[int, str] = {}
    for index, servo in enumerate(plan.servos):
        problem = yield from _stopped(plan, index)
        if problem is None:
            continue
        if not problem:
            said.append(f"{who(plan, servo)} stands: its goal is 0")
        elif (yield from _off(plan, index, LONGER_NS[0])):
            said.append(_cut(plan, servo, problem))
        else:
            left[index] = problem
    for longer_ns in LONGER_NS[1:]:  # only now: who still moves does not wait for who is silent
        for index, problem in list(left.items()):
            if (yield from _off(plan, index, longer_ns)):
                del left[index]
                said.append(_cut(plan, plan.servos[index], problem))
    for index, problem in left.items():
        name = who(plan, plan.servos[index])
        said.append(f"{name} may go on moving: {problem}, and torque off was not confirmed")
    return said


def _stopped(plan: BusPlan, index: int) -> Program[str | None]:
    """Let a servo stand; return why it does not, empty when it does, None where nothing was to be done."""
    servo = plan.servos[index]
    mode = yield from modes.mode_now(plan, servo)
    if mode in _HOLD:
        return None
    torque = yield from persist(plan.torque_reads[index])
    if torque.answered and torque.parameters[0] == 0:
        return None
    if mode is Mode.UNKNOWN:
        return "its mode is not known"
    return (yield from modes.hold(plan, servo, servo.mode_plan(mode))).problem


def _cut(plan: BusPlan, servo: ServoPlan, problem: str) -> str:
    return f"{who(plan, servo)} has no torque, as {problem}"


def _off(plan: BusPlan, index: int, longer_ns: int) -> Program[bool]:
    """Switch a servo's torque off; return whether that was read back."""
    yield [write for write in plan.limp if write.awaited][index]
    read = plan.torque_reads[index]
    back = yield replace(read, timeout_ns=read.timeout_ns + longer_ns)
    return back.answered and back.parameters[0] == 0
