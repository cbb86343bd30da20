"""Access rules: which writes a simulated servo or device rejects, and with which error; `[i]` marks inferred
rules.

A write is rejected as a whole [i]. The table `access.toml` has the special items of servos."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from enum import IntEnum, unique
from pathlib import Path

import msgspec

from dxlsim.registers.memory import Memory, Run, signed
from dxlsim.wire.servo_protocol1 import ErrorBit
from dxlsim.wire.servo_protocol2 import StatusErrorNumber
from dxlwire.control_table import SIGN_BIT, ControlItem, ControlTable

ErrorOf = Callable[[Memory, ControlItem, int], int]
"""Returns the error with which a value of an item (signed if the item is) is rejected; 0: the value is
accepted."""

Bounds = tuple[int, int]  # Lowest and highest value
ANYTHING, NOTHING = (-1 << 62, 1 << 62), (1, 0)

RULES = (
    *("operating_mode", "min_position_limit", "max_position_limit", "cw_angle_limit", "ccw_angle_limit"),
    *("control_mode", "pwm_limit", "current_limit", "velocity_limit", "acceleration_limit", "torque_limit"),
    "bus_watchdog",
)
"""Items that decide which goals a servo accepts."""

_TURNS = 256
"""Range of extended position control in either direction, revolutions (e-Manual, X series, Goal Position
(116): 1,048,575 ticks)."""
# Range of multi-turn mode in either direction, ticks (e-Manual, MX series, Goal Position (30))
_MULTI_TURN_GOAL = 28_672
_MULTI_TURN_LIMIT = 4095
_MAGNITUDE = (1 << SIGN_BIT) - 1
TORQUE_ENABLE_OF_P = 512  # Address of Torque Enable on P, PRO(A), RH-P12-RN(A) and Y


class ShaftItems(msgspec.Struct, frozen=True):
    """Items whose writes may change the motion of one kind of shaft: `aims` only the goal, `others` more."""

    aims: frozenset[str]
    others: frozenset[str]


class _Values(msgspec.Struct, frozen=True):
    range: tuple[int, int]
    values: frozenset[int]
    torque_enable: int | None = None
    without: str = ""

    def fit(self, item: ControlItem, table: ControlTable) -> bool:
        return (
            self.range == (item.minimum, item.maximum)
            and self.torque_enable in (None, table.items["torque_enable"].address)
            and self.without not in table.items
        )


class AccessTable(msgspec.Struct, frozen=True):
    """Content of `access.toml`, which explains its keys."""

    identity: tuple[str, ...]
    goals: frozenset[str]
    gains: tuple[str, ...]
    profile: tuple[str, ...]
    joint_shaft: ShaftItems
    mode_shaft: ShaftItems
    limits: Mapping[str, str]
    limits_of_p: Mapping[str, str]
    values: Mapping[str, tuple[_Values, ...]]


ACCESS = msgspec.convert(tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")), AccessTable)


@unique
class OperatingMode(IntEnum):
    """Values of Operating Mode (11); the position limits apply in POSITION."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


def refusal(memory: Memory, run: Run, error_of: ErrorOf) -> int:
    """Return the error with which a servo or device rejects a write, or 0 if it accepts the write.

    Protocol 1.0: the error bits of all its items; a cell without an item is a range error [i]. Protocol
    2.0: the first error; the EEPROM is locked while torque is on, and a write of an incomplete item is a
    length error (e-Manual, Protocol 2.0, "Error": Data Length Error)."""
    cells = run.cells
    errors = (error_of(memory, item, signed(item, run.after[item.name])) for item in cells.items)
    if memory.table.protocol == 1.0:
        error = 0 if cells.items else int(ErrorBit.RANGE)
        for each in errors:
            error |= each
        return error
    if not cells.items or cells.read_only or (cells.eeprom and memory.get("torque_enable")):
        return StatusErrorNumber.ACCESS
    return next(filter(None, errors), 0) if cells.whole else StatusErrorNumber.DATA_LENGTH


def device_error(memory: Memory, item: ControlItem, value: int) -> int:
    """Return the error with which a device rejects a value: a range error outside the item's range; 0:
    accepted."""
    taken = item.access == "RW" and item.minimum <= value <= item.maximum
    return 0 if taken else ErrorBit.RANGE if memory.table.protocol == 1.0 else StatusErrorNumber.DATA_RANGE


def lock_error(memory: Memory, item: ControlItem, value: int) -> int:
    """Return the error with which a servo of Protocol 1.0 rejects a value; 0: accepted. Lock (47) locks the
    EEPROM until a power cycle.

    A read-only item, a locked item and a value out of range are range errors [i]; a goal outside the angle
    limits is an angle limit error (e-Manual, Goal Position (30)).

    A Moving Speed with a direction bit is accepted in joint mode too [i]. The manual only has "0 ~ 1,023
    can be used", but pypot writes the bit to every motor with `orientation: indirect`, and Poppy moves."""
    locked = memory.get("lock") == 1 and (not value if item.name == "lock" else item.area == "EEPROM")
    # e-Manual, Goal Torque (71): the value must not exceed Torque Limit.
    strong = item.name == "goal_torque" and value & _MAGNITUDE > memory["torque_limit"]
    if item.name == "goal_position" and multi_turn_mode(memory):
        value -= value >> 15 << 16  # Counts turns, in two's complement
    lowest, highest = _range_of(memory, item)
    if locked or strong or item.access != "RW" or not lowest <= value <= highest:
        return ErrorBit.RANGE
    lowest, highest = _limits_of(memory, item)
    return 0 if lowest <= value <= highest else ErrorBit.ANGLE_LIMIT


def torque_error(memory: Memory, item: ControlItem, value: int) -> int:
    """Return the error with which a servo of Protocol 2.0 rejects a value for its range or the servo's
    limits; 0: accepted."""
    known = next(
        (one.values for one in ACCESS.values.get(item.name, ()) if one.fit(item, memory.table)), None
    )
    lowest, highest = _range_of(memory, item)
    if not (lowest <= value <= highest if known is None else value in known):
        return StatusErrorNumber.DATA_RANGE
    lowest, highest = _limits_of(memory, item)
    return 0 if lowest <= value <= highest else StatusErrorNumber.DATA_LIMIT


def _range_of(memory: Memory, item: ControlItem) -> Bounds:
    """Return the values of an item that a servo has a meaning for, whatever its limits."""
    name, table = item.name, memory.table
    if table.protocol == 1.0:
        turns = name == "goal_position" and multi_turn_mode(memory)
        return (-_MULTI_TURN_GOAL, _MULTI_TURN_GOAL) if turns else (item.minimum, item.maximum)
    one_turn = name == "goal_position" and _one_turn(memory)
    lowest, highest = item.minimum, item.maximum
    if one_turn:  # Also for a goal that only the position limits bound: those of Y span several turns
        limit = table.items.get("max_position_limit", item)
        lowest, highest = min(lowest, limit.minimum), max(highest, limit.maximum)
    elif name == "goal_position":
        highest = max(round(_TURNS * math.tau / table.rad_per_tick) - 1, highest)
        lowest = -highest
    return (lowest, highest) if not watchdog_expired(memory) or name not in ACCESS.goals else NOTHING


def _limits_of(memory: Memory, item: ControlItem) -> Bounds:
    """Return the values of an item within the limits that the registers of a servo set."""
    name, table = item.name, memory.table
    if table.protocol == 1.0:
        return _angle_limits(memory, item)
    limit_name = ACCESS.limits.get(name, "")
    if name in ACCESS.limits_of_p and table.items["torque_enable"].address == TORQUE_ENABLE_OF_P:
        limit_name = ACCESS.limits_of_p[name]
    if limit_name in memory:
        return -memory[limit_name], memory[limit_name]
    if name == "goal_position" and "max_position_limit" in memory and _one_turn(memory):
        return memory.ticks("min_position_limit"), memory.ticks("max_position_limit")
    return _angle_limits(memory, item)


def _angle_limits(memory: Memory, item: ControlItem) -> Bounds:
    if item.name != "goal_position" or "cw_angle_limit" not in memory:
        return ANYTHING
    free = multi_turn_mode(memory) or wheel_mode(memory)
    return ANYTHING if free else (memory["cw_angle_limit"], memory["ccw_angle_limit"])


def accepted_goals(memory: Memory, item: ControlItem) -> Bounds:
    """Return the values of a goal that a servo accepts now without an error, all or those that are not
    negative."""
    ranges = _range_of(memory, item), _limits_of(memory, item)
    return max(lowest for lowest, _ in ranges), min(highest for _, highest in ranges)


def _one_turn(memory: Memory) -> bool:
    """Return True if goal positions are within one turn, because of the operating mode or of a gripper's
    travel."""
    goal = memory.table.items["goal_position"]
    has_one = (goal.maximum - goal.minimum + 1) * memory.table.rad_per_tick < 0.99 * math.tau
    return has_one or memory.get("operating_mode", OperatingMode.POSITION) == OperatingMode.POSITION


def watchdog_expired(memory: Memory) -> bool:
    """Return True if the Bus Watchdog (98) has stopped the servo: its value is then -1, which a host
    cannot write."""
    item = memory.table.items.get("bus_watchdog")
    return item is not None and memory["bus_watchdog"] > item.maximum


def wheel_mode(memory: Memory) -> bool:
    """Return True if a servo with angle limits is in wheel mode (e-Manual, CW/CCW Angle Limit (6, 8)).

    Both limits are 0; on the XL-320, Control Mode (11) is 1."""
    if "control_mode" in memory:
        return memory["control_mode"] == 1
    return memory.get("cw_angle_limit") == 0 and memory.get("ccw_angle_limit") == 0


def multi_turn_mode(memory: Memory) -> bool:
    """Return True if a servo of Protocol 1.0 counts turns: both angle limits are 4095 (e-Manual, MX)."""
    if "multi_turn_offset" not in memory:
        return False
    return memory["cw_angle_limit"] == memory["ccw_angle_limit"] == _MULTI_TURN_LIMIT
