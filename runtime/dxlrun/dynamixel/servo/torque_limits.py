"""Torque limits of servos: what a policy reduced, given back.

Protocol 1.0: Torque Limit (34), which begins as Max Torque (14) (e-Manual AX-12A). 2.0: Goal PWM (100), which
in position control limits the PWM, up to PWM Limit (36) (e-Manual XM430-W350); XL-320 has Torque Limit (35).
All of them are RAM: what a policy reduced stays so until power-off, unless it is written again.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.channels.events import EventCode, Severity
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.plan.findings import Findings
from dxlrun.dynamixel.servo.access import Access, first_reach
from dxlrun.dynamixel.wire.dialect import dialect_of, sync_writes
from dxlrun.plan.bus_plan import BusPlan, ModePlan, ServoPlan, TorqueLimit
from dxlrun.plan.transaction import Program

SILENT = "did not answer when its torque limit was read"


def restore_torque_limits(plan: BusPlan, found: Findings) -> Program[list[int]]:
    """Give every servo all of its torque again, after its goal is where it stands.

    One that was weak and held may have sagged: with an old goal it would spring back. Returns the servos' own
    limits in ticks, in the order of the plan's; 0: it has none that is known.
    """
    own: list[int] = []
    for servo in plan.servos:
        one, place = first_reach(plan, servo), servo.torque_limit
        own.append(0)
        if place is None:
            continue
        limits = yield from _own_and_present(one, place)
        if limits is None:
            found.problems.append(f"{one} {SILENT}")
            continue
        own[-1], present = limits
        if present != own[-1] and _limits(servo, servo.start_mode):
            data = own[-1].to_bytes(place.size, "little")
            if (yield from one.write_bytes(place.address, data)).answered:
                text = f"{place.name} was {present} and is {own[-1]} again"
                found.note(EventCode.SETUP, Severity.INFO, servo.joint, text)
            else:
                found.problems.append(f"{one} did not acknowledge {place.name}")
    return own


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


def unlimit(one: Access, mode: Mode) -> Program[str]:
    """Give a servo all of its torque again in a mode without a limit, where another one has limited it.

    It holds already: with an old goal it would spring back. Returns what went wrong, or nothing. One that
    shut itself down is left alone: the write would revive it.
    """
    servo, place = one.servo, one.servo.torque_limit
    limited = any(limits_positions(servo, each) for each in servo.modes)
    if place is None or not limited or limits_positions(servo, servo.mode_plan(mode)):
        return ""
    limits = yield from _own_and_present(one, place)
    if limits is None:
        return SILENT
    own, present = limits
    if present in {0, own}:
        return ""
    # its answer may be anything
    return (yield from one.write("torque_limit", min(own, one.items["torque_limit"].maximum)))


def limits_positions(servo: ServoPlan, mode: ModePlan) -> bool:
    """Return whether the effort of positions is limited by what policies reduce, too: Torque Limit (34)."""
    place = servo.torque_limit
    return (
        mode.mode is Mode.EFFORT_POSITION
        and place is not None
        and any(goal.address == place.address for goal in mode.goals)
    )


def _own_and_present(one: Access, place: TorqueLimit) -> Program[tuple[int, int] | None]:
    own = yield from one.read_bytes(place.full_address, place.size)
    present = yield from one.read_bytes(place.address, place.size)
    if not (own.answered and present.answered):
        return None
    return own.word(place.size), present.word(place.size)


def _limits(servo: ServoPlan, mode: Mode) -> bool:
    """Return whether the torque limit limits in a mode; where Goal PWM is the goal, it would drive."""
    place = servo.torque_limit
    if place is None or mode is Mode.UNKNOWN:
        return False
    return all(goal.address != place.address for goal in servo.mode_plan(mode).goals)
