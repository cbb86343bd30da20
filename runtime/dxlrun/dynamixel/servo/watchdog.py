"""Bus Watchdog: a servo of Protocol 2.0 stops by itself when no instruction comes any more.

Armed last at the start, so that nothing but a cyclic exchange keeps it from tripping, and disarmed at the
end. After it has stopped a servo it reads -1, and the servo refuses goals until 0 is written (e-Manual
XM430-W350, Bus Watchdog (98)). Protocol 1.0 has none: there the guardian cuts the torque when the loop dies.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.dynamixel.control_table import ControlItem, control_table
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import retry
from dxlrun.dynamixel.wire.dialect import dialect_of, sync_writes
from dxlrun.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.plan.transaction import Program

UNIT_NS = 20_000_000  # One step of the register (e-Manual XM430-W350, Bus Watchdog (98))
MOST_TICKS = 127  # The longest time; beyond it stand the values that say that it has stopped
RAMP = "profile_acceleration"
"""It is 0 after a servo was stopped, as is Profile Velocity (e-Manual XM430-W350, Bus Watchdog (98), step 4
of the example)."""
RETURN_SPEED = 1.5
"""rad/s, no faster does a returning servo go to its goal, which may have moved on: a step that no gate saw
has to be a slow one."""
_FOLLOWED = {0: "goal_current", 1: "goal_velocity", 16: "goal_pwm"}
"""What a servo follows that is led to no position, by Operating Mode (e-Manual XM430-W350, (11))."""
LEAST_PERIODS = 3  # It must outlast two lost cycles (failures.md)


def tripped(item: ControlItem, raw: int) -> bool:
    """Return whether a value is that of a Bus Watchdog that ran out and stopped its servo."""
    return item.name == "bus_watchdog" and raw in (-1, (1 << 8 * item.size) - 1)


def shown(item: ControlItem, raw: int) -> str:
    """Return a value of an item as messages show it: that of a tripped Bus Watchdog is `255 (tripped)`.

    e-Manual XM430-W350, Bus Watchdog (98): -1 is "Bus Watchdog Error Status".
    """
    return f"{raw} (tripped)" if tripped(item, raw) else str(raw)


def arm(plan: BusPlan, servo: ServoPlan) -> Program[str]:
    """Arm a servo's watchdog, where the plan wants it and the model has one; return what went wrong."""
    if not plan.watchdog_ticks or (item := item_of(plan, servo)) is None:
        return ""
    return (yield from _write(plan, servo, item, plan.watchdog_ticks))


def disarm(plan: BusPlan, servo: ServoPlan) -> Program[str]:
    """Clear a servo's watchdog if it is armed or has stopped the servo; return what went wrong.

    Also where the plan wants none: an earlier run that was killed may have left it armed. A servo that it
    stopped with torque moves to its old goal [i], at full speed as its profile was reset: it gets a slow
    one before. One that is led to no position would go on with its old velocity or effort: that becomes 0
    right behind, or its torque is switched off.
    """
    if (item := item_of(plan, servo)) is None:
        return ""
    line = plan_line(plan)
    reply = yield from retry(line.read(servo.servo_id, item.address, item.size))
    if reply.answered and reply.word(item.size) == 0:
        return ""
    if not (reply.answered and tripped(item, reply.word(item.size))):
        return (yield from _write(plan, servo, item, 0))
    items = control_table(servo.model, plan.protocol).items
    speed, mode = items["profile_velocity"], items["operating_mode"]
    slow = max(1, round(RETURN_SPEED / speed.scale))
    yield from retry(line.write(servo.servo_id, speed.address, slow.to_bytes(speed.size, "little")))
    # with the byte behind it, as torque enable is one byte, too: a late answer to that is none to this
    found = yield from retry(line.read(servo.servo_id, mode.address, mode.size + 1))
    if not found.answered:
        return f"{plan.label(servo)} did not answer when its {mode.title} was read"
    problem = yield from _write(plan, servo, item, 0)
    if (goal := items.get(_FOLLOWED.get(found.parameters[0], ""))) is not None:
        stopped = yield from retry(line.write(servo.servo_id, goal.address, bytes(goal.size)))
        if not stopped.answered:
            yield from retry(line.write(servo.servo_id, servo.torque_address, b"\0"))
            problem = problem or f"{plan.label(servo)} did not acknowledge {goal.title} = 0"
    return problem


def revive(plan: BusPlan, servo: ServoPlan) -> Program[str]:
    """Clear and arm a servo's watchdog again after no instruction came for too long."""
    return (yield from disarm(plan, servo)) or (yield from arm(plan, servo))


def longer_ns(plan: BusPlan) -> int:
    """Return how much longer than usual a reply may be awaited while servos are armed."""
    return plan.watchdog_ticks * UNIT_NS // 3


def disarm_all(plan: BusPlan) -> Program[list[str]]:
    """Clear every servo of a bus, before torque is switched on or after; return what went wrong."""
    found = []
    for servo in plan.servos:
        found.append((yield from disarm(plan, servo)))
    return [problem for problem in found if problem]


def release_all(plan: BusPlan) -> Program[list[str]]:
    """Disarm the servos of a bus that keep holding; return which were not disarmed, and why.

    One that its watchdog has stopped stays stopped: cleared, it would go on to its old goal [i], at full
    speed as its profile was reset, with no loop that could stop it. One that does not answer stops by itself.
    While all answer, a read of all that are left keeps them from tripping before their turn.
    """
    line, problems, all_answer = plan_line(plan), [], True
    left = [(servo, item) for servo in plan.servos if plan.watchdog_ticks and (item := item_of(plan, servo))]
    while left:
        if all_answer:
            reads = [(servo.servo_id, item.address, item.size) for servo, item in left]
            all_answer = (yield line.read_many(reads)).answered
        servo, item = left.pop(0)
        reply = yield from retry(line.read(servo.servo_id, item.address, item.size))
        if not reply.answered:
            problem = f"did not answer when its {item.title} was read: it may stop by itself"
            problems.append(f"{plan.label(servo)} {problem}")
        elif tripped(item, reply.word(item.size)):
            problems.append(f"{plan.label(servo)} was stopped by its {item.title} and stays where it stopped")
        elif problem := (yield from _write(plan, servo, item, 0)):
            problems.append(problem)
    return problems


def to_all(plan: BusPlan, servos: Sequence[ServoPlan], ticks: int) -> list[bytes]:
    """Return the packets that write the same to these servos; none where the plan wants no watchdog."""
    if not plan.watchdog_ticks:
        return []
    items = [(servo.servo_id, item) for servo in servos if (item := item_of(plan, servo))]
    writes = ((servo_id, item.address, ticks.to_bytes(item.size, "little")) for servo_id, item in items)
    return sync_writes(dialect_of(plan.protocol), writes)


def has_one(plan: BusPlan, servo: ServoPlan) -> bool:
    """Return whether a servo's watchdog is armed by the plan."""
    return bool(plan.watchdog_ticks) and item_of(plan, servo) is not None


def item_of(plan: BusPlan, servo: ServoPlan) -> ControlItem | None:
    """Return the item of a servo's watchdog, None where the model has none."""
    return control_table(servo.model, plan.protocol).items.get("bus_watchdog")


def _write(plan: BusPlan, servo: ServoPlan, item: ControlItem, ticks: int) -> Program[str]:
    line = plan_line(plan)
    yield from retry(line.write(servo.servo_id, item.address, ticks.to_bytes(item.size, "little")))
    back = yield from retry(line.read(servo.servo_id, item.address, item.size))
    if not back.answered:
        return f"{plan.label(servo)} did not answer when its {item.title} was read back"
    if (found := back.word(item.size)) != ticks:
        return f"{plan.label(servo)} was given {item.title} = {ticks}, but has {found}"
    return ""
