"""Which writes a simulated servo or device refuses, and with which error; `[i]` marks what no manual has.

A write is refused as a whole [i]. Each item has a few rules: an error, and which values do not have it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from enum import IntEnum, unique

from dxlrun.dynamixel.control_table import SIGN_BIT, ControlItem, ControlTable
from dxlrun.simulation.servo.memory import Memory, Run
from dxlrun.simulation.wire.protocol1 import ErrorBit
from dxlrun.simulation.wire.protocol2 import ErrorNumber

Rule = tuple[int, Callable[[int], bool]]
"""An error, and whether a value of the item does not have it, with its sign where it has one."""

Rules = Callable[[Memory, ControlItem], Iterator[Rule]]
"""The rules of an item, in the order in which they count; they depend on items that are no goals."""

_LIMITS_OF_GOALS = {
    "goal_pwm": "pwm_limit",
    "goal_current": "current_limit",
    "goal_torque": "torque_limit",
    "goal_velocity": "velocity_limit",
}
_LIMITS_OF_PROFILES = {"profile_velocity": "velocity_limit", "profile_acceleration": "acceleration_limit"}
"""On P and PRO(A) these "cannot exceed" their limits (e-Manual, Profile Velocity (560)); of Y it is inferred
[i], on X they may."""

GOALS = frozenset(("goal_pwm", "goal_current", "goal_velocity", "goal_position"))
_TURNS = 256
"""Reach of extended position control to either side (e-Manual, X series, Goal Position (116): 1,048,575)."""
_MULTI_TURN_GOAL = 28_672
"""Reach of multi-turn mode to either side (e-Manual, MX series, Goal Position (30))."""
_MULTI_TURN_LIMIT = 4095
_MAGNITUDE = (1 << SIGN_BIT) - 1


@unique
class OperatingMode(IntEnum):
    """Operating Mode (11); the position limits hold in POSITION."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


TORQUE_ENABLE_OF_P = 512  # Address of Torque Enable on P, PRO(A), RH-P12-RN(A) and Y


class Access:
    """The rules of a memory's items, looked up once until an item changes that is no goal."""

    def __init__(self, memory: Memory, rules: Rules) -> None:
        self._memory, self._rules = memory, rules
        self._known: dict[str, tuple[Rule, ...]] = {}
        decisive = [
            item.name
            for item in memory.table.items.values()
            if item.access == "RW" and not item.name.startswith(("goal_", "profile_"))
        ]
        memory.watch(decisive, self._known.clear)

    def refusal(self, run: Run) -> int:
        """Return the error with which a write would be refused; 0 when it would not.

        Protocol 1.0: the error bits of all its items; a cell that no item owns is a range error [i].
        Protocol 2.0: the first error; the EEPROM is closed while the torque is on, and part of an item is a
        length error (e-Manual, Protocol 2.0, "Error": Data Length Error).
        """
        cells, memory = run.cells, self._memory
        if memory.table.protocol == 1.0:
            error = 0 if cells.items else int(ErrorBit.RANGE)
            for each in self._errors(run):
                error |= each
            return error
        if not cells.items or cells.read_only or (cells.eeprom and memory.get("torque_enable")):
            return ErrorNumber.ACCESS
        return next(self._errors(run), 0) if cells.whole else ErrorNumber.DATA_LENGTH

    def _errors(self, run: Run) -> Iterator[int]:
        """Yield the first error of each item that has one."""
        for item in run.cells.items:
            wire = run.after[item.name]
            value = wire - (wire >> 8 * item.size - 1 << 8 * item.size) if item.signed else wire
            rules = self._known.get(item.name)
            if rules is None:
                rules = self._known[item.name] = tuple(self._rules(self._memory, item))
            for error, lets in rules:
                if not lets(value):
                    yield error
                    break


def _nothing(value: int) -> bool:
    return False


def _between(lowest: int, highest: int) -> Callable[[int], bool]:
    return range(lowest, highest + 1).__contains__


def device_rules(memory: Memory, item: ControlItem) -> Iterator[Rule]:
    """Yield the rules of a device's item: its range."""
    error = ErrorBit.RANGE if memory.table.protocol == 1.0 else ErrorNumber.DATA_RANGE
    yield error, _between(item.minimum, item.maximum) if item.access == "RW" else _nothing


def lock_rules(memory: Memory, item: ControlItem) -> Iterator[Rule]:
    """Yield the rules of an item of Protocol 1.0, where Lock (47) closes the EEPROM until the power is cut.

    A read-only item, a locked one and a value out of its range are range errors [i]; a goal outside the angle
    limits is an angle limit error (e-Manual, Goal Position (30)).

    A Moving Speed with a direction bit is taken in joint mode too [i]: the manual has only "0 ~ 1,023 can be
    used", but pypot writes the bit to every motor with `orientation: indirect`, and Poppy moves.
    """
    if item.name == "goal_position" and multi_turn_mode(memory):  # it counts turns, in two's complement
        yield ErrorBit.RANGE, lambda wire: abs(wire - (wire >> 15 << 16)) <= _MULTI_TURN_GOAL
    else:
        yield from device_rules(memory, item)
    if memory.get("lock") == 1 and (item.area == "EEPROM" or item.name == "lock"):
        yield ErrorBit.RANGE, bool if item.name == "lock" else _nothing
    if item.name == "goal_torque":  # e-Manual, Goal Torque (71): it cannot be bigger than Torque Limit
        limit = memory["torque_limit"]
        yield ErrorBit.RANGE, lambda wire: wire & _MAGNITUDE <= limit
    if item.name == "goal_position":
        yield from _angle_limits(memory, ErrorBit.ANGLE_LIMIT)


def torque_rules(memory: Memory, item: ControlItem) -> Iterator[Rule]:
    """Yield the rules of an item of Protocol 2.0."""
    name, table = item.name, memory.table
    one_turn = name == "goal_position" and _one_turn(memory)
    if name == "operating_mode":
        yield ErrorNumber.DATA_RANGE, _operating_modes(table).__contains__
    elif name == "protocol_type":
        yield ErrorNumber.DATA_RANGE, _protocol_types(table).__contains__
    elif one_turn:  # or a goal that only the position limits bound: those of Y reach over turns
        limit = table.items.get("max_position_limit", item)
        lowest, highest = min(item.minimum, limit.minimum), max(item.maximum, limit.maximum)
        yield ErrorNumber.DATA_RANGE, _between(lowest, highest)
    elif name == "goal_position":
        reach = max(round(_TURNS * math.tau / table.rad_per_tick) - 1, item.maximum)
        yield ErrorNumber.DATA_RANGE, _between(-reach, reach)
    else:
        yield from device_rules(memory, item)
    if name in GOALS and watchdog_expired(memory):
        yield ErrorNumber.DATA_RANGE, _nothing
    bounded = table.items["torque_enable"].address == TORQUE_ENABLE_OF_P
    limits = _LIMITS_OF_GOALS | (_LIMITS_OF_PROFILES if bounded else {})
    if name in limits and limits[name] in memory:
        most = memory[limits[name]]
        yield ErrorNumber.DATA_LIMIT, _between(-most, most)
    elif one_turn and "max_position_limit" in memory:
        lowest, highest = memory.ticks("min_position_limit"), memory.ticks("max_position_limit")
        yield ErrorNumber.DATA_LIMIT, _between(lowest, highest)
    elif name == "goal_position":
        yield from _angle_limits(memory, ErrorNumber.DATA_LIMIT)


def _angle_limits(memory: Memory, error: int) -> Iterator[Rule]:
    if "cw_angle_limit" in memory and not multi_turn_mode(memory) and not wheel_mode(memory):
        yield error, _between(memory["cw_angle_limit"], memory["ccw_angle_limit"])


def _one_turn(memory: Memory) -> bool:
    """Return whether the goal stays within a turn: by the operating mode, or as a gripper has no more."""
    goal = memory.table.items["goal_position"]
    has_one = (goal.maximum - goal.minimum + 1) * memory.table.rad_per_tick < 0.99 * math.tau
    return has_one or memory.get("operating_mode", OperatingMode.POSITION) == OperatingMode.POSITION


def watchdog_expired(memory: Memory) -> bool:
    """Return whether Bus Watchdog (98) shows that its time ran out: -1, which no host can write."""
    item = memory.table.items.get("bus_watchdog")
    return item is not None and memory["bus_watchdog"] > item.maximum


def wheel_mode(memory: Memory) -> bool:
    """Return whether a servo with angle limits turns without end (e-Manual, CW/CCW Angle Limit (6, 8)).

    Both limits are 0, or, where the model has it, Control Mode (11) is 1 (XL-320).
    """
    if "control_mode" in memory:
        return memory["control_mode"] == 1
    return memory.get("cw_angle_limit") == 0 and memory.get("ccw_angle_limit") == 0


def multi_turn_mode(memory: Memory) -> bool:
    """Return whether a servo of Protocol 1.0 counts turns: both angle limits are 4095 (e-Manual, MX)."""
    if "multi_turn_offset" not in memory:
        return False
    return memory["cw_angle_limit"] == memory["ccw_angle_limit"] == _MULTI_TURN_LIMIT


# The values that the e-Manual lists one by one: sections "Operating Mode" and "Protocol Type" of the pages


def _operating_modes(table: ControlTable) -> tuple[int, ...]:
    item = table.items.get("operating_mode")
    if item is not None and item.minimum == 1:
        return 1, 3  # L42-10-S300-R
    if item is None or item.maximum == 3:
        return 0, 1, 3  # Y
    if item.maximum == 4:
        return 0, 1, 3, 4  # PRO
    if item.maximum == 5:
        return 0, 5  # RH-P12-RN, RH-P12-RN(A)
    if table.items["torque_enable"].address == TORQUE_ENABLE_OF_P:
        return 0, 1, 3, 4, 16
    return (0, 1, 3, 4, 5, 16) if "goal_current" in table.items else (1, 3, 4, 16)


def _protocol_types(table: ControlTable) -> tuple[int, ...]:
    item = table.items.get("protocol_type")
    if item is None or item.minimum == item.maximum:
        return (2,)  # Y
    if item.maximum == 10:
        return 2, 10  # P: Modbus-RTU
    if item.maximum == 22:
        return 2, 20, 21, 22  # X330, X335: S.BUS, iBUS, RC-PWM
    return 1, 2
