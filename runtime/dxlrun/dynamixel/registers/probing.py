"""Probing: what must be tried on the line before the first cycle, because no register and no manual tells it.

Programs of transactions, for a bus whose servos were inspected; they only read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dxlrun.dynamixel.control_table import ControlItem, control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.reads import state_read
from dxlrun.dynamixel.registers.inspection import persist, setup_line, who
from dxlrun.dynamixel.wire.transaction import Program

RETURN_DELAY_STEP_NS = 2_000
"""Unit of Return Delay Time (e-Manual AX-12A (5), XM430-W350 (9))."""


@dataclass(slots=True)
class Probed:
    """What was found out about the cyclic reads of one bus."""

    return_delays: dict[int, int] = field(default_factory=dict)
    """What each servo waits before it answers, by ID, ns."""
    refused: dict[int, str] = field(default_factory=dict)
    """Groups that do not answer the fast form, and why, in a sentence without its subject."""


def probe_reads(plan: BusPlan) -> Program[Probed]:
    """Read the return delay of every servo, and try the fast form on every group that is to be read by it."""
    found = Probed()
    for servo in plan.servos:
        raw = yield from _register(plan, servo, "return_delay_time")
        if raw is not None:
            found.return_delays[servo.servo_id] = raw * RETURN_DELAY_STEP_NS
    line = setup_line(plan)
    for number, (group, fast) in enumerate(zip(plan.groups, plan.fast, strict=True)):
        if fast:
            servos = [plan.servos[index] for index in group]
            reply = yield from persist(state_read(line, servos, fast=True))
            if not reply.answered:
                found.refused[number] = yield from _why(plan, servos)
    return found


def extra_ns(plan: BusPlan, refused: Mapping[int, str]) -> int:
    """Return how much longer a cycle takes when these groups are read by the form that every servo knows."""
    line = plan_line(plan)
    both = [
        (state_read(line, servos), state_read(line, servos, fast=True))
        for servos in ([plan.servos[index] for index in plan.groups[number]] for number in refused)
    ]
    return sum(plain.due_ns - fast.due_ns for plain, fast in both)


def _why(plan: BusPlan, servos: list[ServoPlan]) -> Program[str]:
    """Find who cannot know the fast form."""
    old: list[str] = []
    needed: set[int] = set()
    for servo in servos:
        first = control_table(servo.model, plan.protocol).fast_sync_read_firmware
        found = yield from _register(plan, servo, "firmware_version")
        if first is not None and found is not None and found < first:
            old.append(f"{who(plan, servo)} has {found}")
            needed.add(first)
    if not old:
        return "though their firmware should know it"
    numbers = " or ".join(f"{number}" for number in sorted(needed))
    return f"as it needs firmware {numbers} and {', '.join(old)}"


def _register(plan: BusPlan, servo: ServoPlan, name: str) -> Program[int | None]:
    item: ControlItem | None = control_table(servo.model, plan.protocol).items.get(name)
    if item is None:
        return None
    reply = yield from persist(setup_line(plan).read(servo.servo_id, item.address, item.size))
    return item.decode(reply.parameters) if reply.answered else None
