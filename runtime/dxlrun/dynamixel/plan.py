"""From joints and control tables to the plan of one bus: every packet of the cycle, its times, its cost."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from dxlrun.control_table import ControlTable
from dxlrun.dynamixel import protocol1
from dxlrun.dynamixel.bus_plan import Budget, BusPlan, ServoPlan
from dxlrun.dynamixel.line import Line
from dxlrun.dynamixel.transaction import BROADCAST_ID

STATE_ITEMS = ("present_position", "present_speed", "present_load")
"""Read together each cycle: 36..41, six bytes."""
GOAL_ITEMS = ("goal_position", "moving_speed")
"""Written together each cycle: 30..33, four bytes."""
STATE_LENGTH = 6
GOAL_LENGTH = 4
MOST_SERVOS = (0xFF - 4) // (GOAL_LENGTH + 1)
"""One sync write holds the goals of 50 servos: LEN is one byte."""


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
) -> BusPlan:
    """Prepare everything that goes over one serial line of Protocol 1.0.

    `latency_ns` is what the adapter adds to each request, `return_delay_ns` what each servo waits before it
    answers. Raises ValueError when the servos cannot share one cycle.
    """
    if len(joints) > MOST_SERVOS:
        raise ValueError(
            f"bus {name} has {len(joints)} servos; the goals of {MOST_SERVOS} fit one sync write: "
            "put the others on a second bus"
        )
    line = Line(baud_rate, latency_ns, return_delay_ns)
    servos = tuple(_servo(joint) for joint in joints)
    for joint in joints:
        _check_layout(joint.table)
    reads = tuple(
        line.read(joint.servo_id, joint.table.items["present_position"].address, STATE_LENGTH)
        for joint in joints
    )
    return BusPlan(
        name=name,
        port=port,
        protocol=1.0,
        baud_rate=baud_rate,
        latency_ns=latency_ns,
        return_delay_ns=return_delay_ns,
        servos=servos,
        reads=reads,
        limp=(
            line.write(BROADCAST_ID, _torque_address(joints), b"\0"),
            *(line.write(joint.servo_id, _torque_address(joints), b"\0") for joint in joints),
        ),
        torque_reads=tuple(line.read(joint.servo_id, _torque_address(joints), 1) for joint in joints),
        budget=_budget(line, sum(len(read.packet) for read in reads), len(joints)),
    )


def _servo(joint: Wiring) -> ServoPlan:
    table = joint.table
    ends = sorted(
        (joint.direction * angle + joint.reference) / table.rad_per_tick
        for angle in (joint.lower, joint.upper)
    )
    # inwards, so that no goal is outside; 1e-6 ticks forgive the rounding of degrees
    lower, upper = math.ceil(ends[0] - 1e-6), math.floor(ends[1] + 1e-6)
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
        lower_tick=max(0, lower),
        upper_tick=min(table.max_tick, upper),
    )


def _torque_address(joints: Sequence[Wiring]) -> int:
    addresses = {joint.table.items["torque_enable"].address for joint in joints}
    if len(addresses) > 1:
        raise ValueError("the servos of one bus must have torque enable at one address")
    return addresses.pop() if addresses else 24


def _check_layout(table: ControlTable) -> None:
    """Make sure that the items of one packet stand side by side, as the cycle decodes them."""
    for names in (STATE_ITEMS, GOAL_ITEMS):
        items = [table.items[name] for name in names]
        for before, item in itertools.pairwise(items):
            if item.address != before.address + 2 or before.size != 2 or item.size != 2:
                raise ValueError(f"{table.model}: {' and '.join(names)} do not stand side by side")
    if table.items["goal_position"].address != 30:
        raise ValueError(f"{table.model}: goal position stands at another address than 30")


def _budget(line: Line, request_bytes: int, servos: int) -> Budget:
    """Cost of one cycle (protocol.md, Time budget): the sync write has no reply, so no latency counts."""
    goals = protocol1.OVERHEAD + 2 + servos * (GOAL_LENGTH + 1)
    replies = servos * (protocol1.OVERHEAD + STATE_LENGTH)
    return Budget(
        request_bytes=request_bytes + goals,
        reply_bytes=replies,
        wire_ns=line.wire_ns(request_bytes + goals + replies),
        return_delay_ns=servos * line.return_delay_ns,
        latency_ns=servos * line.latency_ns,
    )
