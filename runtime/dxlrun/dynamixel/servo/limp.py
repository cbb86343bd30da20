"""Limp: torque off on every servo, acknowledged and read back; the last thing that is sent on every way out.

Needs neither numpy nor the loop: the guardian does it after the loop died.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.bus import Bus
from dxlrun.dynamixel.exchange.pump import run
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply
from dxlrun.run.channels.packets import PacketSink

LONGER_NS = (0, 60_000_000, 180_000_000)
"""A write and its read-back are tried so often, and the read-back is awaited so much longer each time.

Noise rarely hits three times, and hosts and adapters rarely stand still for so long; a cut cable always does.
"""
LATE_NS = 20_000_000
"""After silence: what was asked twice is answered twice, and the log is to have all that was said."""
SETTLE_NS = 500_000
"""Time that a half-sent reply may still take: it would collide with the broadcast."""


@dataclass(frozen=True, slots=True)
class LimpOutcome:
    """What came of torque off for one servo."""

    bus: str
    joint: str
    servo_id: int
    confirmed: bool
    """True when torque enable was read back as 0."""
    detail: str
    """Why it was not confirmed."""

    def __str__(self) -> str:
        return f"{self.joint} (ID {self.servo_id} on bus {self.bus}): {self.detail}"


def torque_off(
    plan: BusPlan, now_ns: Callable[[], int], deadline_ns: int
) -> Program[tuple[LimpOutcome, ...]]:
    """Switch torque off everywhere on one bus: all at once first, then servo by servo with read-back.

    Who did not confirm it is tried again when everybody had a turn. After `deadline_ns` nobody is tried
    again, but everybody once.
    """
    yield listen(SETTLE_NS)
    for everybody in plan.limp:
        if not everybody.awaited:
            yield everybody
    writes = [write for write in plan.limp if write.awaited]
    details = dict.fromkeys(range(len(plan.servos)), "it was not tried")
    late = False
    for longer_ns in LONGER_NS:
        for index in [index for index, detail in details.items() if detail]:
            if longer_ns and now_ns() >= deadline_ns:
                break
            acknowledged = yield writes[index]
            read = plan.torque_reads[index]
            back = yield replace(read, timeout_ns=read.timeout_ns + longer_ns)
            details[index] = _detail(acknowledged, back)
            late = late or not (acknowledged.answered and back.answered)
    if late:
        yield listen(LATE_NS)
    return tuple(_outcome(plan, servo, details[index]) for index, servo in enumerate(plan.servos))


def _detail(acknowledged: Reply, back: Reply) -> str:
    if back.answered:
        enabled = back.parameters[0]
        return "" if enabled == 0 else f"torque enable reads {enabled} after torque off was written"
    if acknowledged.answered:
        return "torque off was acknowledged, but the read-back got no answer"
    if Outcome.GARBLED in (acknowledged.outcome, back.outcome):
        return "torque off was sent, but only garbled bytes came back"
    return "torque off was sent, but the servo does not answer"


def _outcome(plan: BusPlan, servo: ServoPlan, detail: str) -> LimpOutcome:
    return LimpOutcome(plan.name, servo.joint, servo.servo_id, not detail, detail)


def limp_buses(
    plans: Sequence[BusPlan],
    buses: Sequence[Bus],
    ports: Ports,
    clock: Clock,
    *,
    deadline_ns: int,
    beat: Callable[[], None] = lambda: None,
) -> tuple[LimpOutcome, ...]:
    """Switch torque off on all lines at once and return what came of it, per servo; raises nothing."""
    results = run([torque_off(plan, clock.now_ns, deadline_ns) for plan in plans], buses, ports, clock, beat)
    outcomes: list[LimpOutcome] = []
    for plan, bus, result in zip(plans, buses, results, strict=True):
        gone = f"torque off could not be sent: {bus.failure}"
        outcomes += result if result is not None else (_outcome(plan, servo, gone) for servo in plan.servos)
    return tuple(outcomes)


def limp(
    plans: Sequence[BusPlan],
    ports: Ports,
    clock: Clock,
    packets: PacketSink,
    *,
    limit_ns: int = 1_000_000_000,
    beat: Callable[[], None] = lambda: None,
) -> tuple[LimpOutcome, ...]:
    """Drain the lines and switch torque off on every servo; for somebody who just took the ports over.

    `limit_ns` bounds the retries, counted from now; `beat` is called while replies are awaited. Raises
    nothing: a line that is gone is in the outcome.
    """
    buses = [
        Bus(index, plan, port, clock, packets)
        for index, (plan, port) in enumerate(zip(plans, ports.ports, strict=True))
    ]
    return limp_buses(plans, buses, ports, clock, deadline_ns=clock.now_ns() + limit_ns, beat=beat)
