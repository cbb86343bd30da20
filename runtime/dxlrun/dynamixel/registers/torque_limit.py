"""Torque limit: how strong each servo may be, less of it for a policy, and all of it again at a start-up.

Protocol 1.0: Torque Limit (34), which begins as Max Torque (14) (e-Manual AX-12A). Protocol 2.0: Goal PWM
(100), which in position control limits the PWM, up to PWM Limit (36) (e-Manual XM430-W350); XL-320 has Torque
Limit (35). All of them are RAM: what was reduced stays so until power-off, unless it is written again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan, TorqueLimit
from dxlrun.dynamixel.registers.inspection import persist, setup_line, who
from dxlrun.dynamixel.wire.dialect import dialect_of
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.mode import Mode


@dataclass(slots=True)
class TorqueLimits:
    """What is known of the limits of one bus' servos."""

    full: list[int] = field(default_factory=list)
    """The servos' own limits in ticks, in the order of the plan's; 0: it has none that is known."""
    problems: list[str] = field(default_factory=list)
    restored: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what its limit had been."""


def restore(plan: BusPlan) -> Program[TorqueLimits]:
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
        full = yield from persist(line.read(servo.servo_id, place.full_address, place.size))
        now = yield from persist(line.read(servo.servo_id, place.address, place.size))
        if not (full.answered and now.answered):
            found.problems.append(f"{who(plan, servo)} did not answer when its torque limit was read")
            continue
        wanted, present = (int.from_bytes(reply.parameters[: place.size], "little") for reply in (full, now))
        found.full[-1] = wanted
        if present != wanted and _limits(servo, servo.start_mode):
            data = wanted.to_bytes(place.size, "little")
            written = yield from persist(line.write(servo.servo_id, place.address, data))
            if written.answered:
                text = f"{place.name} was {present} and is {wanted} again"
                found.restored.append((servo.joint, text))
            else:
                found.problems.append(f"{who(plan, servo)} did not acknowledge {place.name}")
    return found


def reduced(plan: BusPlan, full: Sequence[int], fraction: float, modes: Sequence[Mode] = ()) -> list[bytes]:
    """Return the packets that leave each servo a fraction of its own limit, one tick at least.

    `modes`: in which the servos are; one whose mode is changing is left alone.
    """
    by_place: dict[TorqueLimit, list[tuple[ServoPlan, int]]] = {}
    for index, (servo, own) in enumerate(zip(plan.servos, full, strict=True)):
        if modes and not _limits(servo, modes[index]):
            continue
        if servo.torque_limit is not None and own:
            by_place.setdefault(servo.torque_limit, []).append((servo, max(1, round(own * fraction))))
    packets = []
    for place, servos in by_place.items():
        records = b"".join(
            bytes((servo.servo_id,)) + ticks.to_bytes(place.size, "little") for servo, ticks in servos
        )
        packets.append(dialect_of(plan.protocol).sync_write_records(place.address, place.size, records))
    return packets


def _limits(servo: ServoPlan, mode: Mode) -> bool:
    """Say whether what limits the torque does so in a mode: where Goal PWM is the goal it would drive it."""
    place = servo.torque_limit
    if place is None or mode is Mode.UNKNOWN:
        return False
    return all(goal.address != place.address for goal in servo.mode_plan(mode).goals)
