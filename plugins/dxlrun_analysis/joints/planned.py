"""What the plan in a log says about the joints and the servos that move them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dxlrun.dynamixel.control_table import control_table
from dxlrun.log.reader import Log
from dxlrun_analysis.plan import LoggedBus, LoggedJoint, LoggedServo, plan_of

_TICK_RAD = math.tau / 4096
"""Where the log's plan does not have the servo's"""
_LIMITS = ("temperature_limit", "motor_temperature_limit")
_ACCELERATIONS = ("profile_acceleration", "goal_acceleration")


@dataclass(frozen=True, slots=True)
class PlannedJoint:
    """One joint, and what its servos can do there; m instead of rad of a linear one."""

    name: str = ""
    bus: str = ""
    servos: str = ""
    """As sentences name them"""
    hottest: float = math.nan
    """The temperature limit, deg C"""
    top_effort: float = math.nan
    """In the unit of its effort"""
    speed: float = math.inf
    """rad/s"""
    acceleration: float = math.inf
    """rad/s^2, of the profile that the robot file declares in its `registers`"""
    tick: float = _TICK_RAD
    """rad"""
    slowest: float = 0.0
    """rad/s; a speed of 0 would be none"""
    share: float = 1.0
    """m of a linear joint for each rad of its servo; 1 of one that turns"""
    logged: LoggedJoint = field(default_factory=lambda: LoggedJoint(""))


def planned_joints(log: Log) -> tuple[PlannedJoint, ...]:
    """Return the joints in the order of the log; of those that its plan does not have the names."""
    plan = plan_of(log)
    movers = plan.movers
    found = []
    for name in log.joints:
        joint, mine = plan.joint(name), movers.get(name, ())
        if not mine:
            found.append(PlannedJoint(name))
            continue
        found.append(
            PlannedJoint(
                name,
                mine[0].bus.name,
                ", ".join(f"servo {one.servo.servo_id} on bus {one.bus.name}" for one in mine),
                np.fmin.reduce([_hottest(one.bus, one.servo) for one in mine]).item(),
                1.0 if joint.top_effort is None else joint.top_effort,
                min(math.inf if limit is None else limit for limit in (joint.velocity, joint.top_speed)),
                sum(one.share * _acceleration(one.servo, one.bus.protocol) for one in mine),
                sum(one.share * one.servo.rad_per_tick for one in mine),
                sum(one.share * one.servo.rad_s_per_tick for one in mine),
                sum(one.share for one in mine) if joint.linear else 1.0,
                joint,
            )
        )
    return tuple(found)


def _acceleration(servo: LoggedServo, protocol: float | None) -> float:
    """Return the acceleration that a servo's registers declare; 0 there is none."""
    declared = {each.name: each.value for each in servo.registers}
    for name in _ACCELERATIONS:
        if value := declared.get(name):
            try:
                return value * control_table(servo.model, protocol).items[name].scale
            except LookupError:  # a plug-in's model that is not installed here
                return math.inf
    return math.inf


def _hottest(bus: LoggedBus, servo: LoggedServo) -> float:
    """Return the temperature limit of a servo, deg C: the robot file's, or its model's as shipped."""
    declared: Mapping[str, int] = {each.name: each.value for each in servo.registers}
    try:
        items = control_table(servo.model, bus.protocol).items
    except LookupError:  # a plug-in's model that is not installed here
        return math.nan
    for name in _LIMITS:
        value = declared.get(name, items[name].initial if name in items else None)
        if value:
            return value * items[name].scale
    return math.nan
