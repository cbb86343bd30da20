"""Torque limits of servos: registers that policies reduce, restored at start-up, on a servo's return and
after a mode change.

Protocol 1.0: Torque Limit (34), whose initial value is Max Torque (14) (e-Manual AX-12A). 2.0: Goal PWM
(100), which in position control limits the PWM, up to PWM Limit (36) (e-Manual XM430-W350); XL-320 has Torque
Limit (35). All of them are RAM: a lower value stays until power-off, unless the register is written again.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import Access, first_reach
from dxlwire.bus_plan import BusPlan, ModePlan, ServoPlan
from dxlwire.modes import Mode
from dxlwire.transaction import Program
from dxlwire.wire.dialect import dialect_of, sync_writes

SILENT = "did not answer when its torque limit was read"


def restore_torque_limits(plan: BusPlan, found: Findings) -> Program[list[int]]:
    """Raise the torque limit of every servo of a bus to its own full limit at start-up, after torque on.

    Returns:
        The servos' own limits in ticks, in the order of the plan; 0: not known.
    """
    own: list[int] = []
    for servo in plan.servos:
        own.append((yield from restore_torque_limit(first_reach(plan, servo), servo.start_mode, found)))
    return own


def restore_torque_limit(one: Access, mode: Mode, found: Findings) -> Program[int]:
    """Raise the torque limit of a servo that holds its present position to its own full limit.

    Before that, an old goal would make it spring back. A policy, a mode with an effort limit or another
    program may have lowered the limit. It is not changed in a mode that uses the register as its goal, nor in
    a servo of Protocol 1.0 whose limit is 0: that servo shut itself down, and the write would revive it.

    Returns:
        The servo's own limit in ticks; 0: not known.
    """
    place = one.servo.torque_limit
    if place is None:
        return 0
    full = yield from one.read_bytes(place.full_address, place.size)
    limit = yield from one.read_bytes(place.address, place.size)
    if not (full.answered and limit.answered):
        found.problems.append(f"{one} {SILENT}")
        return 0
    own, present = full.word(place.size), limit.word(place.size)
    shut_down = present == 0 and one.plan.protocol == 1.0
    if present != own and not shut_down and _limits(one.servo, mode):
        item = next(each for each in one.items.values() if each.address == place.address)
        value = min(own, item.maximum)  # the servo's reply may contain any value
        if problem := (yield from one.write_item(item.name, value)):
            found.problems.append(f"{one} {problem}")
        else:
            found.add_event(one.servo.joint, texts.torque_limit_restored(place.name, present, value))
    return own


def reduced_torque_limits(
    plan: BusPlan, full: Sequence[int], fraction: float, modes: Sequence[Mode]
) -> list[bytes]:
    """Return the packets that set the torque limit of each servo to a fraction of its own limit, at least one
    tick.

    Args:
        plan: The bus.
        full: The servos' own limits in ticks; 0: not known.
        fraction: Fraction of the own limit, 0 to 1.
        modes: Present modes of the servos; UNKNOWN (the mode is changing) omits a servo.
    """
    writes = [
        # At least one tick: 0 would look like a shutdown.
        (servo.servo_id, place.address, max(1, round(own * fraction)).to_bytes(place.size, "little"))
        for servo, own, mode in zip(plan.servos, full, modes, strict=True)
        if (place := servo.torque_limit) is not None and own and _limits(servo, mode)
    ]
    return sync_writes(dialect_of(plan.protocol), writes)


def limits_positions(servo: ServoPlan, mode: ModePlan) -> bool:
    """Return True if the servo's effort goal in effort-position mode is written to the torque limit register
    that policies reduce.
    """
    place = servo.torque_limit
    return (
        mode.mode is Mode.EFFORT_POSITION
        and place is not None
        and any(goal.address == place.address for goal in mode.goals)
    )


def _limits(servo: ServoPlan, mode: Mode) -> bool:
    """Return True if the torque limit register only limits in a mode. Where it is itself the goal, as Goal
    PWM, a write would move the servo.
    """
    place = servo.torque_limit
    if place is None or mode is Mode.UNKNOWN:
        return False
    return all(goal.address != place.address for goal in servo.mode_plan(mode).goals)
