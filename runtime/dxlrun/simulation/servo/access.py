"""Which writes a simulated servo refuses, and with which error; `[i]` marks what no manual has.

A write is refused as a whole [i].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum, unique
from types import MappingProxyType

from dxlrun.dynamixel.control_table import ControlItem, ControlTable
from dxlrun.simulation.servo.memory import Memory, Run, in_range
from dxlrun.simulation.wire.protocol1 import ErrorBit
from dxlrun.simulation.wire.protocol2 import ErrorNumber

_LIMITS_OF_GOALS = {
    "goal_pwm": "pwm_limit",
    "goal_current": "current_limit",
    "goal_torque": "torque_limit",
    "goal_velocity": "velocity_limit",
}
_LIMITS_OF_PROFILES = {"profile_velocity": "velocity_limit", "profile_acceleration": "acceleration_limit"}
"""On P and PRO(A) these "cannot exceed" their limits (e-Manual, Profile Velocity (560)); of Y it is inferred
[i], on X they may."""

_GOALS = frozenset(("goal_pwm", "goal_current", "goal_velocity", "goal_position"))
_NOTHING = (1 << 64, -1 << 64)
_TURNS = 256
"""Reach of extended position control to either side (e-Manual, X series, Goal Position (116): 1,048,575)."""


_MULTI_TURN_GOAL = 28_672
"""Reach of multi-turn mode to either side (e-Manual, MX series, Goal Position (30))."""
_MULTI_TURN_LIMIT = 4095


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

_POSITION = int(OperatingMode.POSITION)


class LockRules:
    """Protocol 1.0: Lock (47) closes the EEPROM until the power is cut."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory

    def refusal(self, run: Run) -> int:
        """Return the error bits with which a write would be refused; 0 when it would not.

        A cell that no item owns, a read-only item, a locked one and a value out of its range are each a range
        error [i]; a goal outside the angle limits is an angle limit error (e-Manual, Goal Position (30)).

        A Moving Speed with a direction bit is taken in joint mode too [i]: the manual has only "0 ~ 1,023
        can be used", but pypot writes the bit to every motor with `orientation: indirect`, and Poppy moves.
        """
        if not run.cells.items:
            return ErrorBit.RANGE
        error = 0
        for item in run.cells.items:
            error |= self._refusal_of(item, run.after[item.name])
        return error

    def _refusal_of(self, item: ControlItem, wire: int) -> int:
        memory = self._memory
        if item.access == "R" or not self._in_range(item, wire):
            return ErrorBit.RANGE
        if memory.get("lock") == 1 and (item.area == "EEPROM" or (item.name == "lock" and wire == 0)):
            return ErrorBit.RANGE
        if (
            item.name == "goal_torque"
            and abs(item.decode(wire.to_bytes(2, "little"))) > memory["torque_limit"]
        ):
            return ErrorBit.RANGE  # e-Manual, Goal Torque (71): it cannot be bigger than Torque Limit
        if wheel_mode(memory):
            return 0
        return ErrorBit.ANGLE_LIMIT if _beyond_angle_limits(memory, item.name, wire) else 0

    def _in_range(self, item: ControlItem, wire: int) -> bool:
        """Return whether a value may be: in multi-turn mode goals count turns, in two's complement."""
        if item.name == "goal_position" and multi_turn_mode(self._memory):
            return abs(wire - (wire >> 15 << 16)) <= _MULTI_TURN_GOAL
        return in_range(item, wire)


class TorqueRules:
    """Protocol 2.0: the EEPROM is closed while Torque Enable is 1."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._choices = _choices(memory.table)
        self._signed = frozenset(item.name for item in memory.table.items.values() if item.signed)
        self._allowed: dict[str, tuple[int, int]] = {}
        """Least and greatest value that was allowed: what lies between them is allowed as well, until another
        item than a goal changes."""
        decisive = [
            item.name
            for item in memory.table.items.values()
            if item.access == "RW" and not item.name.startswith(("goal_", "profile_"))
        ]
        memory.watch(decisive, self._allowed.clear)
        bounded = memory.table.items["torque_enable"].address == TORQUE_ENABLE_OF_P
        limits = _LIMITS_OF_GOALS | (_LIMITS_OF_PROFILES if bounded else {})
        self._limits = {name: limit for name, limit in limits.items() if limit in memory}
        goal = memory.table.items.get("goal_position")
        self._has_one_turn = (
            goal is not None
            and (goal.maximum - goal.minimum + 1) * memory.table.rad_per_tick < 0.99 * math.tau
        )

    def refusal(self, run: Run) -> int:
        """Return the error number with which a write would be refused; 0 when it would not.

        Part of an item is a length error (e-Manual, Protocol 2.0, "Error": Data Length Error). Where several
        items are refused, the error is that of the first [i].
        """
        cells = run.cells
        if not cells.items or cells.read_only or (cells.eeprom and self._memory.get("torque_enable")):
            return ErrorNumber.ACCESS
        if not cells.whole:
            return ErrorNumber.DATA_LENGTH
        for item in cells.items:
            name = item.name
            wire = run.after[name]
            value = wire - (wire >> 8 * item.size - 1 << 8 * item.size) if name in self._signed else wire
            least, greatest = self._allowed.get(name, _NOTHING)
            if least <= value <= greatest:
                continue
            if error := self._refusal_of(item, wire):
                return error
            if name not in self._choices and item.encoding != "sign_magnitude":
                self._allowed[name] = min(least, value), max(greatest, value)
        return 0

    def _refusal_of(self, item: ControlItem, wire: int) -> int:
        memory = self._memory
        if not self._in_range(item, wire):
            return ErrorNumber.DATA_RANGE
        if item.name in _GOALS and watchdog_expired(memory):
            return ErrorNumber.DATA_RANGE
        if self._beyond_limit(item, wire):
            return ErrorNumber.DATA_LIMIT
        return 0

    def _in_range(self, item: ControlItem, wire: int) -> bool:
        """Return whether a value may be: a goal of many turns where the mode is not that of one turn."""
        memory = self._memory
        if (listed := self._choices.get(item.name)) is not None:
            return wire in listed
        if item.name != "goal_position" or self._one_turn():
            return in_range(item, wire) or self._within_wide_limits(item, wire)
        highest = round(_TURNS * math.tau / memory.table.rad_per_tick) - 1
        return abs(item.decode(wire.to_bytes(item.size, "little"))) <= max(highest, item.maximum)

    def _within_wide_limits(self, item: ControlItem, wire: int) -> bool:
        """Return whether a goal is one that only the position limits bound: those of Y reach over turns."""
        limit = self._memory.table.items.get("max_position_limit")
        return item.name == "goal_position" and limit is not None and in_range(limit, wire)

    def _one_turn(self) -> bool:
        """Return whether the goal stays within a turn: by the operating mode, or as a gripper has no more."""
        return self._has_one_turn or self._memory.get("operating_mode", _POSITION) == _POSITION

    def _beyond_limit(self, item: ControlItem, wire: int) -> bool:
        memory = self._memory
        limit = self._limits.get(item.name)
        if limit is None and item.name != "goal_position":
            return False
        value = item.decode(wire.to_bytes(item.size, "little"))
        if limit is not None:
            return abs(value) > memory[limit]
        if "max_position_limit" in memory and self._one_turn():
            lowest, highest = memory.ticks("min_position_limit"), memory.ticks("max_position_limit")
            return not lowest <= value <= highest
        return not wheel_mode(memory) and _beyond_angle_limits(memory, item.name, wire)


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


def _beyond_angle_limits(memory: Memory, name: str, wire: int) -> bool:
    if name != "goal_position" or "cw_angle_limit" not in memory or multi_turn_mode(memory):
        return False
    return not memory["cw_angle_limit"] <= wire <= memory["ccw_angle_limit"]


def _choices(table: ControlTable) -> Mapping[str, frozenset[int]]:
    """Return the items whose values the e-Manual lists one by one, with these; any other is out of range.

    Sections "Operating Mode" and "Protocol Type" of the models' pages.
    """
    listed = {"operating_mode": _operating_modes(table), "protocol_type": _protocol_types(table)}
    return MappingProxyType({name: frozenset(each) for name, each in listed.items() if name in table.items})


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
