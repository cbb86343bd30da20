"""Planning: builds the plan of one bus, with packets, times and cost of a cycle, from joints and control
tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from dxlwire.bus_plan import (
    BusPlan,
    DevicePlan,
    GoalLayout,
    ModePlan,
    RegisterValue,
    Scale,
    ServoPlan,
    StateLayout,
    TorqueLimit,
    members_of,
)
from dxlwire.control_table import ControlTable
from dxlwire.control_table.device_table import WAITS, DeviceTable
from dxlwire.joint_unit import ROTARY, JointUnit
from dxlwire.modes import Mode
from dxlwire.plan.line import MOST_SPARE, Line
from dxlwire.plan.mode_plan import (
    LACKS,
    can_count_turns,
    field,
    mode_plans,
    own_limits,
    position_layout,
    position_reach,
)
from dxlwire.plan.placement import OFFSET, extend, place_servo
from dxlwire.plan.reads import choose_reads, read_budget, read_by
from dxlwire.transaction import BROADCAST_ID, Transaction
from dxlwire.wire.dialect import Dialect, dialect_of, sync_writes

Item = TypeVar("Item")


class Wiring(msgspec.Struct, frozen=True):
    """One joint and its servo as described in the robot file; input of `bus_plan`."""

    joint: str
    row: int  # Row of the joint in the state and goal arrays of the whole robot
    servo_id: int
    table: ControlTable
    reference: float  # rad, counted from the servo's raw 0
    direction: int
    lower: float  # rad or m, in the joint's terms
    upper: float  # rad or m, in the joint's terms
    settings: tuple[RegisterValue, ...] = ()
    """Register values that the servo should have, in the order of writing."""
    continuous: bool = False
    """True for a wheel, or for a joint that counts several turns; without limits `lower` and `upper` are
    infinite."""
    start_mode: Mode | None = None
    """Mode that start-up selects; None: VELOCITY for a wheel, else POSITION."""
    ratio: float = 1.0  # Movement of the joint per radian of the servo, rad or m
    unit: JointUnit = ROTARY  # Unit of the joint's positions
    name: str = ""  # Unique name of the servo if several servos move one joint


def bus_plan(
    *,
    name: str,
    port: str,
    baud_rate: int,
    latency_ns: int,
    return_delay_ns: int,
    joints: Sequence[Wiring],
    devices: Sequence[tuple[DevicePlan, DeviceTable]] = (),
    protocol: float = 1.0,
) -> BusPlan:
    """Return the plan of one serial line with its servos and devices.

    Args:
        name: Name of the bus.
        port: Device path, or `sim`.
        baud_rate: bit/s.
        latency_ns: Latency that the adapter adds to each request.
        return_delay_ns: Time that each servo waits before it answers.
        joints: The joints with their servos.
        devices: The devices with their tables.
        protocol: 1.0 or 2.0.

    Raises:
        ValueError: The servos cannot share one cycle.
    """
    line = Line(baud_rate, latency_ns, return_delay_ns, dialect_of(protocol))
    servos = tuple(_servo(joint) for joint in joints)
    goals = [packet for layout in goal_layouts(servos) for packet in _empty_goals(line, layout, servos)]
    plans = tuple(plan for plan, _ in devices)
    able = [joint.table.capabilities for joint in joints]
    able += [
        frozenset() if WAITS in table.capabilities else table.capabilities
        for plan, table in devices
        for _ in plan.blocks
    ]
    members = members_of(servos, plans)
    reads = choose_reads(line, members, able, goals)
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
        limp=tuple(_torque_off(line, servos)),
        budget=read_budget(line, reads.chosen, goals),
        fast=reads.fast,
        read_by=read_by(protocol, members, reads),
        devices=plans,
    )


def plan_line(plan: BusPlan) -> Line:
    """Return the timing of a bus as planned, which builds transactions."""
    return Line(
        plan.baud_rate,
        plan.latency_ns,
        plan.return_delay_ns,
        dialect_of(plan.protocol),
        device_margin_ns=plan.device_margin_ns,
    )


def torque_off_ns(plan: BusPlan) -> int:
    """Return the time to switch torque off on a bus, ns: a broadcast, then a write and a read of each
    servo."""
    line, total_ns = plan_line(plan), sum(each.due_ns for each in plan.limp)
    for servo in plan.servos:
        write = line.write_range(servo.servo_id, servo.torque_address, b"\0")
        read = line.read_range(servo.servo_id, servo.torque_address, 1)
        total_ns += write.due_ns + read.due_ns + 2 * plan.latency_ns
    return total_ns


def goal_layouts(servos: Sequence[ServoPlan]) -> tuple[GoalLayout, ...]:
    """Return the distinct goal blocks of servos in their start modes; each needs its own sync write."""
    return tuple(dict.fromkeys(goal for servo in servos for goal in servo.mode_plan(servo.start_mode).goals))


def goal_parts(dialect: Dialect, layout: GoalLayout, servos: Sequence[Item]) -> list[Sequence[Item]]:
    """Split servos that share one goal block into parts that fit one sync write each."""
    most = dialect.MOST_GOAL_BYTES // (layout.length + 1)
    return [servos[start : start + most] for start in range(0, len(servos), most)]


def _empty_goals(line: Line, layout: GoalLayout, servos: Sequence[ServoPlan]) -> list[bytes]:
    """Return sync writes of zeros to all servos of one layout. They only provide sizes and are never sent."""
    here = [servo for servo in servos if layout in servo.mode_plan(servo.start_mode).goals]
    return [
        line.dialect.sync_write(
            layout.address, layout.length, {servo.servo_id: bytes(layout.length) for servo in part}
        )
        for part in goal_parts(line.dialect, layout, here)
    ]


def _torque_off(line: Line, servos: Sequence[ServoPlan]) -> list[Transaction]:
    """Return transactions that switch torque off on all these servos, without a reply.

    Each address of Torque Enable gets its own sync write if models differ in it."""
    addresses = dict.fromkeys(servo.torque_address for servo in servos)
    if len(addresses) == 1:
        return [line.write_range(BROADCAST_ID, address, b"\0") for address in addresses]
    writes = ((servo.servo_id, servo.torque_address, b"\0") for servo in servos)
    return [line.unanswered(packet) for packet in sync_writes(line.dialect, writes)]


def _servo(joint: Wiring) -> ServoPlan:
    table = joint.table
    ends = sorted(
        (joint.direction * angle / joint.ratio + joint.reference) / table.rad_per_tick
        for angle in (joint.lower, joint.upper)
    )
    reach = position_reach(table, joint.continuous)
    # A joint that crosses raw 0 counts turns, where the model can.
    extended = (
        not joint.continuous
        and can_count_turns(table)
        and (math.ceil(ends[0] - 1e-6) < reach[0] or math.floor(ends[1] + 1e-6) > reach[1])
    )
    reach = position_reach(table, continuous=True) if extended else reach
    # Round inwards so that no goal is outside; 1e-6 ticks absorb the rounding of degrees.
    lower = math.ceil(max(ends[0], reach[0]) - 1e-6)
    upper = math.floor(min(ends[1], reach[1]) + 1e-6)
    hardware_error = table.items.get(table.errors.item)
    # A torque in Nm applies to the joint. A current or a fraction of the maximum stays that of the servo.
    effort = 1.0 / joint.ratio if table.effort_unit == "Nm" else 1.0
    modes = tuple(
        replace(mode, effort=None if mode.effort is None else _scaled(mode.effort, effort))
        for mode in mode_plans(table, lower, upper, joint.continuous)
    )
    plan = ServoPlan(
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
        effort_per_tick=table.effort_per_tick * effort,
        lower_tick=lower,
        upper_tick=upper,
        state=_state_layout(table, counts_turns=joint.continuous),
        goal=position_layout(table),
        torque_address=table.items["torque_enable"].address,
        hardware_error_address=None if hardware_error is None else hardware_error.address,
        torque_limit=_torque_limit(table),
        modes=modes,
        start_mode=_start_mode(joint, modes),
        own_limits=own_limits(table),
        continuous=joint.continuous,
        settings=tuple(setting for setting in joint.settings if setting.write),
        expected=tuple(setting for setting in joint.settings if not setting.write),
        ratio=joint.ratio,
        unit=joint.unit,
        name=joint.name,
    )
    plan = extend(plan, table) if extended else plan
    offsets = [setting.value for setting in joint.settings if setting.name == OFFSET]
    return place_servo(plan, table, offsets[0]) if offsets else plan


def _scaled(scale: Scale, factor: float) -> Scale:
    return Scale(scale.per_tick * factor, scale.most)


def _start_mode(joint: Wiring, modes: Sequence[ModePlan]) -> Mode:
    """Return the mode in which a servo starts. Raises ValueError if the model does not have it."""
    wanted = joint.start_mode or (Mode.VELOCITY if joint.continuous else Mode.POSITION)
    if any(plan.mode == wanted for plan in modes):
        return wanted
    raise ValueError(f"{joint.table.model} of {joint.joint} {LACKS[wanted]}")


def _torque_limit(table: ControlTable) -> TorqueLimit | None:
    """Return the register that limits the torque of a model; None if it has none. `torque_limits.py` names
    the pages of the manual."""
    for name, full in (("torque_limit", "max_torque"), ("goal_pwm", "pwm_limit")):
        item, own = table.items.get(name), table.items.get(full)
        if item is not None and own is not None and item.size == own.size:
            words = name.replace("_", " ").title().replace("Pwm", "PWM")
            return TorqueLimit(f"{words} ({item.address})", item.address, own.address, item.size)
    return None


def _state_layout(table: ControlTable, *, counts_turns: bool) -> StateLayout:
    """Return the single block that holds position, speed and load or current.

    Raises ValueError if other addresses between them are not items: these cannot be read."""
    names = ("present_position", table.present_speed_item, table.effort_item)
    items = [table.items[name] for name in names]
    start = min(item.address for item in items)
    end = max(item.address + item.size for item in items)
    if not table.readable(start, end):
        raise ValueError(
            f"{table.model}: {', '.join(names)} are not in one block, so one read cannot get all"
        )
    position, velocity, effort = (field(item, start) for item in items)
    if counts_turns:
        # Negative turns are in two's complement, also in the 16 bits of multi-turn mode.
        position = replace(position, encoding="twos_complement")
    spare = table.spare(end, MOST_SPARE)
    return StateLayout(start, end - start, position, velocity, effort, spare)
