"""Bus Watchdog: register of a servo of Protocol 2.0 that stops the servo when it receives no more
instructions.

It is armed last at start-up, because only the cyclic exchange keeps it from tripping, and disarmed at the
end. After it has stopped a servo it reads -1, and the servo refuses goals until 0 is written (e-Manual
XM430-W350, Bus Watchdog (98)). Protocol 1.0 has no watchdog: there the guardian cuts the torque when the loop
process dies.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import Access, access_servo
from dxlrun.dynamixel.servo.registers import tripped
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.plan.bus_watchdog import UNIT_NS, has_watchdog, watchdog_item
from dxlwire.transaction import Program
from dxlwire.wire.dialect import dialect_of, sync_writes

RAMP = "profile_acceleration"
"""Register of a servo that a watchdog stop sets to 0, as it does Profile Velocity (e-Manual XM430-W350, Bus
Watchdog (98), step 4 of the example).
"""
RETURN_SPEED = 1.5
"""Highest speed (rad/s) of a returning servo toward its goal. The goal may have moved far, in a step that no
limit has checked.
"""
_FOLLOWED = {0: "goal_current", 1: "goal_velocity", 16: "goal_pwm"}
"""Goal register that a servo follows in the modes without a position goal, by value of Operating Mode
(e-Manual XM430-W350, (11)).
"""


def arm(one: Access) -> Program[str]:
    """Write the planned timeout to a servo's Bus Watchdog; return the problem. Empty on success, or if plan
    or model has none.
    """
    if not has_watchdog(one.plan, one.servo):
        return ""
    return (yield from _write(one, one.plan.watchdog_ticks))


def disarm(one: Access) -> Program[str]:
    """Write 0 to a servo's Bus Watchdog if it is armed or has tripped; return the problem, empty on success.

    This is done even if the plan requires no watchdog: an earlier run that was killed may have left it armed.
    After the clear a servo that was stopped with torque moves to its old goal [i], at full speed because its
    profile was reset. It therefore gets a slow profile velocity first. A servo without a position goal would
    continue with its old velocity or effort: its goal becomes 0 right after the clear, or else its torque is
    switched off.
    """
    if (item := watchdog_item(one.plan, one.servo)) is None:
        return ""
    reply = yield from one.read_bytes(item.address, item.size)
    if reply.answered and reply.word(item.size) == 0:
        return ""
    if not (reply.answered and tripped(item, reply.word(item.size))):
        return (yield from _write(one, 0))
    speed, mode = one.items["profile_velocity"], one.items["operating_mode"]
    # At least 1: Profile Velocity 0 means no limit (e-Manual XM430-W350, Profile Velocity (112)).
    slow = max(1, round(RETURN_SPEED / speed.scale))
    yield from one.write_bytes(speed.address, slow.to_bytes(speed.size, "little"))
    found = yield from one.read_items([mode.name])
    if found is None:
        return f"{one} did not answer when its {mode.title} was read"
    problem = yield from _write(one, 0)
    if (goal := one.items.get(_FOLLOWED.get(found[mode.name], ""))) is not None:
        stopped = yield from one.write_bytes(goal.address, bytes(goal.size))
        if not stopped.answered:
            yield from one.torque_off()
            problem = problem or f"{one} did not acknowledge {goal.title} = 0"
    return problem


def revive(one: Access) -> Program[str]:
    """Clear a servo's tripped Bus Watchdog and arm it again, after a pause in the instructions; return the
    problem, empty on success.
    """
    return (yield from disarm(one)) or (yield from arm(one))


def longer_ns(plan: BusPlan) -> int:
    """Return by how much (ns) the timeout of a reply may be extended without tripping the Bus Watchdogs; 0 if
    none is planned.
    """
    return plan.watchdog_ticks * UNIT_NS // 3


def disarm_all(plan: BusPlan, found: Findings) -> Program[None]:
    """Clear the Bus Watchdog of every servo of a bus before torque on; problems go to `found`."""
    for servo in plan.servos:
        if problem := (yield from disarm(access_servo(plan, servo))):
            found.problems.append(problem)


def release_all(plan: BusPlan) -> Program[list[str]]:
    """Disarm the Bus Watchdogs of a bus whose servos keep their torque after the run; return a sentence for
    each servo not disarmed.

    A servo that its watchdog has stopped stays stopped: after a clear it would move to its old goal [i], at
    full speed because its profile was reset, without a loop that could stop it. A servo that does not answer
    stops when its watchdog trips. While all servos answer, one read of all remaining servos keeps their
    watchdogs from tripping.
    """
    problems, all_answer = [], True
    armed = [
        (access_servo(plan, servo), item)
        for servo in plan.servos
        if plan.watchdog_ticks and (item := watchdog_item(plan, servo))
    ]
    while armed:
        if all_answer:
            reads = [(one.servo.servo_id, item.address, item.size) for one, item in armed]
            all_answer = (yield armed[0][0].line.read_many(reads)).answered
        one, item = armed.pop(0)
        reply = yield from one.read_bytes(item.address, item.size)
        if not reply.answered:
            problem = f"did not answer when its {item.title} was read; the watchdog may still stop it"
            problems.append(f"{one} {problem}")
        elif tripped(item, reply.word(item.size)):
            problems.append(f"{one} was stopped by its {item.title} and stays stopped")
        elif problem := (yield from _write(one, 0)):
            problems.append(problem)
    return problems


def to_all(plan: BusPlan, servos: Sequence[ServoPlan], ticks: int) -> list[bytes]:
    """Return the packets that write one Bus Watchdog timeout (in steps of UNIT_NS) to all these servos; empty
    if none is planned.
    """
    if not plan.watchdog_ticks:
        return []
    items = [(servo.servo_id, item) for servo in servos if (item := watchdog_item(plan, servo))]
    writes = ((servo_id, item.address, ticks.to_bytes(item.size, "little")) for servo_id, item in items)
    return sync_writes(dialect_of(plan.protocol), writes)


def _write(one: Access, ticks: int) -> Program[str]:
    problem = yield from one.write_item("bus_watchdog", ticks)
    return problem and f"{one} {problem}"
