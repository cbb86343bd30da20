"""Health in a bus' plan: Bus Watchdog, slow registers, and who gets torque back after a reboot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dxlrun.compile.checks.problems import Problems, suggestion
from dxlrun.control.policy_plan import GroupPolicy
from dxlrun.description import Description
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.plan.reads import slow_items
from dxlrun.dynamixel.registers.bus_watchdog import LEAST_PERIODS, MOST_TICKS, UNIT_NS, has_one

WATCHDOG_NS = 200_000_000
"""How long a servo of Protocol 2.0 goes on without instructions where the file is silent (failures.md)."""


def with_health(description: Description, plan: BusPlan, problems: Problems) -> BusPlan:
    """Return a bus' plan with what watches over its servos; says what of that cannot be."""
    described = description.robot.buses[plan.name]
    slow = described.slow_registers
    return replace(
        plan,
        servos=tuple(
            replace(
                servo,
                slow=slow_items(control_table(servo.model, plan.protocol))
                if slow.items is None
                else slow.items,
                torque_on_return=_returns(description, servo.joint) == "hold",
            )
            for servo in plan.servos
        ),
        watchdog_ticks=_watchdog_ticks(description, plan, problems),
        slow_period_ns=_slow_period_ns(description, plan, problems),
    )


def slowest_period_ns(buses: Sequence[BusPlan]) -> int:
    """Return the longest period in which no Bus Watchdog stops its servos, ns; 0: any."""
    armed = [bus.watchdog_ticks for bus in buses if any(has_one(bus, servo) for servo in bus.servos)]
    return min(armed) * UNIT_NS // LEAST_PERIODS if armed else 0


def group_policies(
    description: Description, rows: Mapping[str, int], problems: Problems
) -> tuple[GroupPolicy, ...]:
    """Return the groups of joints with a policy of their own for lost servos."""
    known = tuple(description.robot.joints)
    owner: dict[str, str] = {}
    found = []
    for name, group in description.robot.policies.groups.items():
        for index, joint in enumerate(group.joints):
            mark = description.marks.value("policies", "groups", name, "joints", index)
            if joint not in known:
                what = f"group {name} has joint {joint}, which the file does not have"
                problems.error(mark, what, suggestion(joint, known))
            elif owner.setdefault(joint, name) != name or group.joints.index(joint) < index:
                problems.error(mark, f"{joint} is in group {owner[joint]} already", "name each joint once")
        members = frozenset(rows[joint] for joint in group.joints if joint in rows)
        if group.on_lost_servo is not None:
            found.append(GroupPolicy(name, members, group.on_lost_servo))
    return tuple(found)


def _returns(description: Description, joint: str) -> str:
    policies = description.robot.policies
    for group in policies.groups.values():
        if joint in group.joints and group.on_returned_servo is not None:
            return group.on_returned_servo
    return policies.on_returned_servo


def _watchdog_ticks(description: Description, plan: BusPlan, problems: Problems) -> int:
    written = description.robot.buses[plan.name].bus_watchdog
    least_ns = math.ceil(LEAST_PERIODS * 1e9 / description.robot.loop.rate)
    if written == "auto":
        wanted_ns = max(WATCHDOG_NS, least_ns)
        return -(-wanted_ns // UNIT_NS) if plan.protocol == 2.0 and wanted_ns <= MOST_TICKS * UNIT_NS else 0
    if not written:
        return 0
    mark = description.marks.value("buses", plan.name, "bus_watchdog")
    if plan.protocol != 2.0:
        mend = "take it out; the guardian switches the torque off when the loop dies"
        problems.error(mark, f"bus {plan.name} has Protocol 1.0, which has no Bus Watchdog", mend)
        return 0
    if written < least_ns:
        what = (
            f"a Bus Watchdog of {written * 1e-6:g} ms would stop the servos of bus {plan.name} after a cycle"
        )
        mend = (
            f"write {-(-least_ns // UNIT_NS) * UNIT_NS * 1e-6:g} ms at least, three periods, or 0 ms for none"
        )
        problems.error(mark, f"{what} that comes to nothing", mend)
    if written > MOST_TICKS * UNIT_NS:
        what = f"a Bus Watchdog has {MOST_TICKS} steps of {UNIT_NS * 1e-6:g} ms"
        problems.error(mark, what, f"write {MOST_TICKS * UNIT_NS * 1e-9:g} s at most, or 0 ms for none")
        return 0
    return -(-written // UNIT_NS)


def _slow_period_ns(description: Description, plan: BusPlan, problems: Problems) -> int:
    slow = description.robot.buses[plan.name].slow_registers
    tables = [control_table(servo.model, plan.protocol).items for servo in plan.servos]
    known = tuple(dict.fromkeys(name for items in tables for name in items))
    for index, name in enumerate(slow.items or ()):
        if name not in known:
            mark = description.marks.value("buses", plan.name, "slow_registers", "items", index)
            problems.error(mark, f"no servo of bus {plan.name} has the item {name}", suggestion(name, known))
    return round(1e9 / slow.rate)
