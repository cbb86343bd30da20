"""Joints as the plan in a log describes them, with the limits of the servos that move them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dxlrun import LINEAR, Log
from dxlrun.tooling.plans import JointPlan
from dxlrun_analysis.plan_excerpt import UNKNOWN_JOINT, Mover, plan_of
from dxlwire import ControlTable, Fault, HardwareErrors, find_table

_TICK_RAD = math.tau / 4096  # For a servo that is not in the plan of the log
_NEAREST = (
    (np.fmin, ("temperature_limit", "motor_temperature_limit")),
    (np.fmax, ("min_voltage_limit",)),
    (np.fmin, ("max_voltage_limit",)),
)
"""Limits of a joint with several servos: the first limit that one of them reaches. Reduction, and names of
the control table item."""
_GAINS = ("position_p_gain", "p_gain")
_SOFTEST = 3.0  # Bounds the influence of a very low gain
_ACCELERATIONS = ("profile_acceleration", "goal_acceleration")


@dataclass(frozen=True, slots=True)
class PlannedJoint:
    """A joint of the plan in a log, with its limits and those of its servos; rad, or m if linear."""

    name: str = ""
    bus: str = ""
    servos: str = ""  # Servos as sentences name them
    hottest: float = math.nan  # Temperature limit, deg C
    lowest_volts: float = math.nan
    highest_volts: float = math.nan  # Limits of the supply of its servos, V
    top_effort: float = math.nan  # In the unit of its effort
    speed: float = math.inf  # rad/s
    acceleration: float = math.inf  # rad/s^2, of the profile that the robot file declares in its `registers`
    tick: float = _TICK_RAD  # rad
    # rad/s of one tick; a raw speed of 0 would mean no limit.
    slowest: float = 0.0
    share: float = 1.0  # m of a linear joint per rad of its servo; 1 for a rotary joint
    softness: float = 1.0  # Ratio of the model's default gain to the gain in the robot file, 1 to 3
    alike: str = ""  # Models and registers; joints with the same ones follow alike
    wraps: bool = False  # Its position jumps between the ends of its range once per turn (wheel mode)
    logged: JointPlan = UNKNOWN_JOINT
    errors: tuple[HardwareErrors, ...] = ()  # Error bits of its servos' models, without duplicates

    def faults(self, value: int) -> frozenset[Fault]:
        """Return the faults that a raw value of the item `hardware_error` reports.

        If a joint has servos of several models, a bit counts as a fault if any of the models defines it.
        """
        return frozenset(fault for errors in self.errors for fault in errors.faults(value))


def planned_joints(log: Log) -> tuple[PlannedJoint, ...]:
    """Return the joints in the order of the log. A joint that is not in the plan has only its name."""
    plan = plan_of(log)
    movers = plan.movers
    found = []
    for name in log.joints:
        joint, mine = plan.joint(name), movers.get(name, ())
        if not mine:
            found.append(PlannedJoint(name))
            continue
        hottest, lowest, highest = (
            float(nearest.reduce([_register(one, names, math.nan, shipped=True) for one in mine]))
            for nearest, names in _NEAREST
        )
        found.append(
            PlannedJoint(
                name,
                mine[0].bus.name,
                ", ".join(f"servo {one.servo.servo_id} on bus {one.bus.name}" for one in mine),
                hottest,
                lowest,
                highest,
                1.0 if joint.top_effort is None else joint.top_effort,
                joint.highest_speed,
                sum(one.share * _register(one, _ACCELERATIONS, math.inf) for one in mine),
                sum(one.share * one.servo.rad_per_tick for one in mine),
                sum(one.share * one.servo.rad_s_per_tick for one in mine),
                sum(one.share for one in mine) if joint.unit is LINEAR else 1.0,
                max(_softness(one) for one in mine),
                ", ".join(sorted(f"{one.servo.model} {one.servo.declared}" for one in mine)),
                joint.continuous and any(_counts_one_turn(one) for one in mine),
                joint,
                tuple({one.servo.model: table.errors for one in mine if (table := _table(one))}.values()),
            )
        )
    return tuple(found)


def _counts_one_turn(one: Mover) -> bool:
    """Return whether the servo's position item has fewer than 4 bytes, so that it cannot count turns; the
    same test as `ServoPlan.wraps`."""
    table = _table(one)
    return table is not None and table.items["present_position"].size < 4


def _table(one: Mover) -> ControlTable | None:
    try:
        return find_table(one.servo.model, one.bus.protocol)
    except LookupError:  # The model of a plug-in that is not installed here
        return None


def _register(one: Mover, names: tuple[str, ...], otherwise: float, *, shipped: bool = False) -> float:
    """Return the value, in its physical unit, of the first item of `names` that the robot file declares.
    With `shipped`, the model's default also counts; without a value, return `otherwise`."""
    return _first_value(one, names, one.servo.declared, otherwise, shipped=shipped)


def _first_value(
    one: Mover, names: tuple[str, ...], declared: Mapping[str, int], otherwise: float, *, shipped: bool
) -> float:
    table = _table(one)
    if table is None:
        return otherwise
    items = table.items
    for name in names:
        value = declared.get(name, items[name].initial if shipped and name in items else None)
        if value:
            return value * items[name].scale
    return otherwise


def _softness(one: Mover) -> float:
    softness = _first_value(one, _GAINS, {}, math.nan, shipped=True) / _register(one, _GAINS, math.nan)
    return min(max(1.0, softness), _SOFTEST)  # 1.0 if either gain is unknown
