"""Torque off on every servo, acknowledged and read back: the last packets at every end of a run.

If a robot keeps its torque at the end, `stand` stops the joints that follow no position. This module needs
neither numpy nor the loop, because the guardian uses it after the loop process died.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
from msgspec.structs import replace

from dxlrun.dynamixel.servo import mode_switches
from dxlrun.dynamixel.servo.item_access import Access, access_servo
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.exchange.bus_engine import Lines
from dxlwire.modes import Mode
from dxlwire.plan.line import listen_transaction
from dxlwire.plan.placement import extend
from dxlwire.plan.retry import limit_patience
from dxlwire.transaction import Program, Reply, TransactionOutcome

LONGER_NS = (0, 60_000_000, 180_000_000)
"""Additional timeout of the read-back in each attempt, ns.

Noise rarely hits three times, and hosts and adapters rarely stall for so long; a cut cable always fails.
"""
LIMIT_NS = 1_000_000_000
LATE_NS = 20_000_000
"""Listening time after a missing reply, ns: a request that was sent twice is answered twice, and the log
should have both replies.
"""
SETTLE_NS = 500_000
"""Listening time before torque off, ns, for a reply that is still being sent: it would collide with the
broadcast.
"""
_HOLD = (Mode.POSITION, Mode.EFFORT_POSITION)
"""Modes with a position goal, which a servo holds without a host; in the other modes it keeps moving."""


class LimpOutcome(msgspec.Struct, frozen=True):
    """Result of torque off for one servo: confirmed by a read, or the reason why not."""

    bus: str
    joint: str
    servo_id: int
    confirmed: bool  # torque enable was read back as 0
    detail: str  # reason why it was not confirmed

    def __str__(self) -> str:
        return f"{self.joint} (ID {self.servo_id} on bus {self.bus}): {self.detail}"


def limp(lines: Lines, deadline_ns: int | None = None) -> tuple[LimpOutcome, ...]:
    """Switch torque off on every servo of all lines and read it back; return the result for each servo.

    Does not raise: a lost line is part of the result.

    Args:
        lines: The robot's lines.
        deadline_ns: No servo is tried again after this time; None: one second from now.
    """
    end_ns = lines.clock.now_ns() + LIMIT_NS if deadline_ns is None else deadline_ns
    results = lines.run_programs(
        [limit_patience(_limp(plan, lines.clock.now_ns, end_ns)) for plan in lines.plans]
    )
    outcomes: list[LimpOutcome] = []
    for plan, bus, result in zip(lines.plans, lines.buses, results, strict=True):
        gone = f"torque off could not be sent: {bus.failure}"
        outcomes += result if result is not None else (_outcome(plan, servo, gone) for servo in plan.servos)
    return tuple(outcomes)


def stand(lines: Lines) -> tuple[str, ...]:
    """Stop every servo that has torque and follows a velocity, an effort or a PWM, when a run ends with
    torque on.

    A servo that does not accept a goal of 0, or whose mode cannot be read, loses its torque. Does not raise.

    Returns:
        A sentence for each such servo.
    """
    found = lines.run_programs([limit_patience(_stand(plan)) for plan in lines.plans])
    return tuple(sentence for one in found for sentence in one or ())


def _limp(plan: BusPlan, now_ns: Callable[[], int], deadline_ns: int) -> Program[tuple[LimpOutcome, ...]]:
    """Switch torque off on one bus: first with a broadcast, then servo by servo with read-back; return the
    results.

    A servo that did not confirm is tried again after the other servos. Each servo is tried at least once, but
    none again after `deadline_ns`.
    """
    yield listen_transaction(SETTLE_NS)
    for broadcast in plan.limp:
        _ = yield broadcast  # `yield from` would send the reply to a tuple
    every = [access_servo(plan, servo) for servo in plan.servos]
    details = dict.fromkeys(range(len(plan.servos)), "torque off was not sent")
    late = False
    for longer_ns in LONGER_NS:
        for index in [index for index, detail in details.items() if detail]:
            if longer_ns and now_ns() >= deadline_ns:
                break
            acknowledged, back = yield from _off(every[index], longer_ns)
            details[index] = _detail(acknowledged, back)
            late = late or not (acknowledged.answered and back.answered)
    if late:
        yield listen_transaction(LATE_NS)
    return tuple(_outcome(plan, servo, details[index]) for index, servo in enumerate(plan.servos))


def _stand(plan: BusPlan) -> Program[list[str]]:
    yield listen_transaction(SETTLE_NS)
    sentences: list[str] = []
    left: list[tuple[Access, str]] = []
    for servo in plan.servos:
        one = access_servo(plan, servo)
        problem = yield from _stop(one)
        if problem is None:
            continue
        if not problem:
            sentences.append(f"{one} was stopped: its goal is 0")
        elif (yield from _is_off(one, LONGER_NS[0])):
            sentences.append(f"{one} could not be stopped and is limp: {problem}")
        else:
            left.append((one, problem))
    # Retry only now: a servo that still moves must not wait for a silent one.
    for longer_ns in LONGER_NS[1:]:
        for one, problem in tuple(left):
            if (yield from _is_off(one, longer_ns)):
                left.remove((one, problem))
                sentences.append(f"{one} could not be stopped and is limp: {problem}")
    for one, problem in left:
        sentences.append(f"{one} may keep moving: {problem}; torque off was not confirmed")
    return sentences


def _stop(one: Access) -> Program[str | None]:
    """Stop a servo that follows no position; return the reason for a failure, empty on success, None if it
    needs no stop.
    """
    mode = yield from mode_switches.mode_now(one)
    if mode is Mode.UNKNOWN:
        # The start may have placed the servo so that it counts turns, which the plan of the file lacks.
        mode = yield from mode_switches.mode_now(access_servo(one.plan, extend(one.servo, one.table)))
    if mode in _HOLD:
        return None
    torque = yield from one.read_torque()
    if torque.answered and torque.parameters[0] == 0:
        return None
    if mode is Mode.UNKNOWN:
        return "its mode is unknown"
    return (yield from mode_switches.hold_servo(one, mode)).problem


def _off(one: Access, longer_ns: int) -> Program[tuple[Reply, Reply]]:
    """Write torque off to a servo once and read it back; return the acknowledgement and the reply to the
    read.
    """
    acknowledged = yield one.writing(one.servo.torque_address, b"\0")
    read = one.reading(one.servo.torque_address, 1)
    back = yield replace(read, timeout_ns=read.timeout_ns + longer_ns)
    return acknowledged, back


def _is_off(one: Access, longer_ns: int) -> Program[bool]:
    _, back = yield from _off(one, longer_ns)
    return back.answered and back.parameters[0] == 0


def _detail(acknowledged: Reply, back: Reply) -> str:
    if back.answered:
        enabled = back.parameters[0]
        return "" if enabled == 0 else f"torque enable reads {enabled} after torque off was written"
    if acknowledged.answered:
        return "torque off was acknowledged, but the read-back got no answer"
    if TransactionOutcome.GARBLED in (acknowledged.outcome, back.outcome):
        return "torque off was sent, but only garbled bytes came back"
    return "torque off was sent, but the servo does not answer"


def _outcome(plan: BusPlan, servo: ServoPlan, detail: str) -> LimpOutcome:
    return LimpOutcome(plan.name, servo.joint, servo.servo_id, not detail, detail)
