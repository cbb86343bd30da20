"""Placement: where a servo counts its positions from: its Homing Offset and its turn.

The robot file counts the angle of a servo from raw 0 of its encoder. A servo reports that angle plus its
Homing Offset (e-Manual XM430-W350, Homing Offset (20)), and plus whole turns where it counts them. A placed
plan has the reference and the ticks that the servo reports, so everything that reads or sends positions
uses it as it is.

Position Control Mode has one turn. It ignores an offset beyond a quarter turn (e-Manual, same place), and
counts from raw 0 again when torque comes on (Present Position (132)). So a servo whose goals or whose offset
do not fit is placed in Extended Position Control Mode, which counts turns and loses them at power-off: the
turn is the one in which the servo is within its limits."""

from __future__ import annotations

import math
from collections.abc import Mapping

from msgspec.structs import replace

from dxlwire.bus_plan import ServoPlan
from dxlwire.control_table import ControlTable
from dxlwire.plan.mode_plan import can_count_turns, counting_turns, has_one_turn, position_reach

OFFSET = "homing_offset"  # Control table item


def place_servo(servo: ServoPlan, table: ControlTable, offset: int) -> ServoPlan:
    """Return the plan of a servo with this Homing Offset, ticks; the plan must not be placed yet."""
    placed = replace(servo.moved(offset), homing_offset=offset, unplaced_reference=servo.reference)
    if servo.continuous or servo.extended or (offset and not in_one_turn(placed, table)):
        return extend(placed, table)
    return placed


def present_offset(table: ControlTable, values: Mapping[str, int]) -> int:
    """Return the Homing Offset that Present Position contains in the servo's present mode, ticks.

    `values` are register values by item; a servo without Operating Mode or Homing Offset has 0."""
    offset = values.get(OFFSET, 0)
    ignored = 4 * abs(offset) > round(math.tau / table.rad_per_tick)
    return 0 if ignored and has_one_turn(values) else offset


def in_one_turn(placed: ServoPlan, table: ControlTable) -> bool:
    """Return True if Position Control Mode, with its single turn, reaches all goals of a placed servo."""
    most = placed.turn_ticks // 4
    # The factory's limits of a PH54 are narrower than its Goal Position.
    least, highest = (table.items[f"{end}_position_limit"].initial for end in ("min", "max"))
    fits = (least or table.min_tick) <= placed.lower_tick and placed.upper_tick <= (highest or table.max_tick)
    return fits and abs(placed.homing_offset or 0) <= most


def reaches_goals(placed: ServoPlan, table: ControlTable) -> bool:
    """Return True if a placed servo accepts all of its goals."""
    if placed.continuous or placed.extended or not placed.homing_offset:
        return True
    least, most = position_reach(table, continuous=False)
    return least <= placed.lower_tick and placed.upper_tick <= most


def extend(servo: ServoPlan, table: ControlTable) -> ServoPlan:
    """Return the plan of a servo that counts turns, if its model can; its goals are cut to what it counts."""
    if not servo.continuous and not can_count_turns(table):
        return servo
    least, most = position_reach(table, continuous=True)
    ends = {"lower_tick": max(servo.lower_tick, least), "upper_tick": min(servo.upper_tick, most)}
    modes = servo.modes if servo.continuous else counting_turns(servo.modes)
    return replace(
        servo,
        **ends,
        modes=tuple(replace(mode, **ends) for mode in modes),
        extended=not servo.continuous,
    )


def turns_within_limits(servo: ServoPlan, raw: int) -> list[ServoPlan]:
    """Return the plan for each turn in which a servo that reports `raw` ticks is within its limits."""
    turn = servo.turn_ticks
    first, last = -((servo.upper_tick - raw) // turn), (raw - servo.lower_tick) // turn
    return [servo.moved(number * turn) for number in range(first, last + 1)]


def nearest_turn(servo: ServoPlan, raw: int) -> ServoPlan:
    """Return the plan for the turn in which a servo that reports `raw` ticks is closest to its limits."""
    middle = (servo.lower_tick + servo.upper_tick) / 2
    return servo.moved(round((raw - middle) / servo.turn_ticks) * servo.turn_ticks)
