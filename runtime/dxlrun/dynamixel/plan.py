"""From joints and control tables to the plan of one bus: every packet of the cycle, its times, its cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dxlrun.control_table import ControlItem, ControlTable
from dxlrun.dynamixel.bus_plan import (
    BusPlan,
    Field,
    GoalLayout,
    ServoPlan,
    StateLayout,
    TorqueLimit,
)
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.line import Line
from dxlrun.dynamixel.reads import choose_reads
from dxlrun.dynamixel.transaction import BROADCAST_ID, Transaction

MOST_SPARE = 2
"""Two longer forms of a read tell its late replies from the newest (`exchange`)."""


@dataclass(frozen=True, slots=True)
class Wiring:
    """One joint and the servo that moves it, as `bus_plan` needs them."""

    joint: str
    row: int
    """Row of the joint in the state and goal arrays of the whole robot."""
    servo_id: int
    table: ControlTable
    reference: float
    """rad, counted from the servo's raw 0"""
    direction: int
    lower: float
    """rad, joint angle"""
    upper: float
    """rad, joint angle"""


def bus_plan(
    *,
    name: str,
    port: str,
    baud_rate: int,
    latency_ns: int,
    return_delay_ns: int,
    joints: Sequence[Wiring],
    protocol: float = 1.0,
    split: bool = False,
) -> BusPlan:
    """Prepare everything that goes over one serial line.

    `latency_ns` is what the adapter adds to each request, `return_delay_ns` what each servo waits before it
    answers. Raises ValueError when the servos cannot share one cycle.
    """
    line = Line(baud_rate, latency_ns, return_delay_ns, dialect_of(protocol))
    servos = tuple(_servo(joint) for joint in joints)
    goals = [_empty_goals(name, line, layout, servos) for layout in goal_layouts(servos)]
    reads = choose_reads(line, servos, [joint.table for joint in joints], goals)
    return BusPlan(
        name=name,
        port=port,
        protocol=protocol,
        baud_rate=baud_rate,
        latency_ns=latency_ns,
        return_delay_ns=return_delay_ns,
        servos=servos,
        groups=reads.groups,
        reads=reads.plain,
        limp=(
            *_torque_off(line, servos),
            *(line.write(servo.servo_id, servo.torque_address, b"\0") for servo in servos),
        ),
        torque_reads=tuple(line.read(servo.servo_id, servo.torque_address, 1) for servo in servos),
        budget=reads.budget,
        fast=reads.fast,
        ways=reads.ways,
        split=split,
    )


def plan_line(plan: BusPlan) -> Line:
    """Return the line of a plan, as the robot file assumes it."""
    return Line(plan.baud_rate, plan.latency_ns, plan.return_delay_ns, dialect_of(plan.protocol))


def readable(table: ControlTable, start: int, end: int) -> bool:
    """Say whether the addresses from `start` up to before `end` all belong to items."""
    items = table.items.values()
    known = {address for item in items for address in range(item.address, item.address + item.size)}
    return known.issuperset(range(start, end))


def goal_layouts(servos: Sequence[ServoPlan]) -> tuple[GoalLayout, ...]:
    """Return the different goal layouts of servos; each needs a sync write of its own."""
    return tuple(dict.fromkeys(servo.goal for servo in servos))


def _empty_goals(name: str, line: Line, layout: GoalLayout, servos: Sequence[ServoPlan]) -> bytes:
    """Return a sync write of zeros to everybody of one layout, to know its size; it is never sent."""
    count = sum(servo.goal == layout for servo in servos)
    most = line.dialect.MOST_GOAL_BYTES // (layout.length + 1)
    if count > most:
        raise ValueError(
            f"bus {name} has {count} servos; the goals of {most} fit one sync write: "
            "put the others on a second bus"
        )
    return line.dialect.sync_write_records(layout.address, layout.length, bytes((layout.length + 1) * count))


def _torque_off(line: Line, servos: Sequence[ServoPlan]) -> list[Transaction]:
    """Return torque off for everybody at once; nobody answers.

    Where torque enable stands at several addresses nobody may be told to write at another's.
    """
    addresses = dict.fromkeys(servo.torque_address for servo in servos)
    if len(addresses) == 1:
        return [line.write(BROADCAST_ID, address, b"\0") for address in addresses]
    return [
        line.unanswered(
            line.dialect.sync_write_records(
                address, 1, b"".join(bytes((s.servo_id, 0)) for s in servos if s.torque_address == address)
            )
        )
        for address in addresses
    ]


def _servo(joint: Wiring) -> ServoPlan:
    table = joint.table
    ends = sorted(
        (joint.direction * angle + joint.reference) / table.rad_per_tick
        for angle in (joint.lower, joint.upper)
    )
    # inwards, so that no goal is outside; 1e-6 ticks forgive the rounding of degrees
    lower, upper = math.ceil(ends[0] - 1e-6), math.floor(ends[1] + 1e-6)
    hardware_error = table.items.get("hardware_error_status")
    return ServoPlan(
        joint=joint.joint,
        row=joint.row,
        servo_id=joint.servo_id,
        model=table.model,
        model_number=table.model_number,
        reference=joint.reference,
        direction=joint.direction,
        rad_per_tick=table.rad_per_tick,
        max_tick=table.max_tick,
        rad_s_per_tick=table.rad_s_per_tick,
        max_speed_tick=table.max_speed_tick,
        effort_per_tick=table.effort_per_tick,
        lower_tick=max(table.min_tick, lower),
        upper_tick=min(table.max_tick, upper),
        state=_state_layout(table),
        goal=_goal_layout(table),
        torque_address=table.items["torque_enable"].address,
        hardware_error_address=None if hardware_error is None else hardware_error.address,
        torque_limit=_torque_limit(table),
    )


def _torque_limit(table: ControlTable) -> TorqueLimit | None:
    """Return where a model's torque is limited; see `dynamixel.torque_limit` for the manual's pages."""
    for name, full in (("torque_limit", "max_torque"), ("goal_pwm", "pwm_limit")):
        item, own = table.items.get(name), table.items.get(full)
        if item is not None and own is not None and item.size == own.size:
            words = name.replace("_", " ").title().replace("Pwm", "PWM")
            return TorqueLimit(f"{words} ({item.address})", item.address, own.address, item.size)
    return None


def _state_layout(table: ControlTable) -> StateLayout:
    """Return the one block that holds position, speed and load or current.

    Raises ValueError when they do not stand together: an address without an item cannot be read.
    """
    names = ("present_position", table.present_speed_item, table.effort_item)
    items = [table.items[name] for name in names]
    start = min(item.address for item in items)
    end = max(item.address + item.size for item in items)
    if not readable(table, start, end):
        raise ValueError(f"{table.model}: {', '.join(names)} do not stand in one block, so no read gets all")
    position, velocity, effort = (_field(item, start) for item in items)
    spare = 0
    while spare < MOST_SPARE and readable(table, start, end + spare + 1):
        spare += 1
    return StateLayout(start, end - start, position, velocity, effort, spare)


def _goal_layout(table: ControlTable) -> GoalLayout:
    """Return the block of goal position and, when it stands beside it, of the speed toward it."""
    position, speed = table.items["goal_position"], table.items[table.goal_speed_item]
    start = min(position.address, speed.address)
    if abs(position.address - speed.address) != (speed.size if start == speed.address else position.size):
        return GoalLayout(position.address, position.size, _field(position, position.address), None)
    length = position.size + speed.size
    return GoalLayout(start, length, _field(position, start), _field(speed, start))


def _field(item: ControlItem, start: int) -> Field:
    return Field(item.address - start, item.size, item.encoding)
