"""Mode plans: registers, goals and units of each mode of a servo model, derived from its control table.

Protocol 2.0: Operating Mode (11), or Control Mode (11) of the XL-320 (e-Manual XM430-W350, XL-320). Protocol
1.0: the angle limits, both 0 for wheel mode, both at the highest tick for multi-turn mode (e-Manual MX-28,
CW/CCW Angle Limit (6, 8)), and Torque Control Mode Enable (70) of MX-64 and MX-106.

Effort limit of a position: Goal Current (102) in a mode of its own. In Protocol 1.0 it is Torque Limit (34)
in joint mode (e-Manual AX-12A, Torque Limit (34)): the fraction of the maximum, and never 0, which indicates
a shutdown.

In wheel mode an AX, RX, DX, EX or XL-320 does not control its speed. Moving Speed (32) is then a fraction
of full output (e-Manual AX-12A, Moving Speed (32)). That is `pwm`; as `velocity` it is the fraction of the
no-load speed, which a loaded servo does not reach [i]."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

from msgspec.structs import replace

from dxlwire.bus_plan import (
    Field,
    GoalLayout,
    ModePlan,
    OwnLimit,
    RegisterValue,
    Scale,
    ServoPlan,
)
from dxlwire.control_table import ControlItem, ControlTable
from dxlwire.modes import Mode

_CURRENT, _VELOCITY, _POSITION, _EXTENDED, _CURRENT_BASED, _PWM = 0, 1, 3, 4, 5, 16
"""Values of Operating Mode (11) that select the modes of these names."""
_WHEEL, _JOINT = 1, 2  # Control Mode (11) of the XL-320
_EXTENDED_TURNS = 256
"""Range of extended position control in either direction, revolutions (e-Manual XM430-W350, Goal Position
(116): 1,048,575 ticks)."""
_MULTI_TURN_TICKS = 28_672
"""Range of multi-turn mode in either direction, ticks (e-Manual MX-28, Goal Position (30))."""
_FULL = 1023
"""Moving Speed (32) at full output in wheel mode, and maximum of Goal Torque (71), without direction bit."""
_ADDRESS_OF_P = 512
"""Address of Torque Enable on P and PRO(A) servos, which identifies them: they have no current-based
position control."""


_NAMES: Mapping[str, int] = MappingProxyType(
    {
        "current": _CURRENT,
        "velocity": _VELOCITY,
        "position": _POSITION,
        "extended_position": _EXTENDED,
        "current_based_position": _CURRENT_BASED,
        "pwm": _PWM,
    }
)

LACKS: Mapping[Mode, str] = MappingProxyType(
    {
        Mode.POSITION: "has no multi-turn mode for a continuous joint",
        Mode.VELOCITY: "has no velocity mode",
        Mode.EFFORT: "has no torque or current mode",
        Mode.PWM: "has no PWM mode",
        Mode.EFFORT_POSITION: "has no position mode with an effort limit",
    }
)
"""Text for a model that does not have a mode; it follows the model's name."""


def position_reach(table: ControlTable, continuous: bool) -> tuple[int, int]:
    """Return the lowest and highest goal position of a model, ticks. `continuous`: over many turns, if the
    model can."""
    if continuous and _EXTENDED in operating_modes(table):
        turns = round(_EXTENDED_TURNS * math.tau / table.rad_per_tick) - 1
        return -turns, turns
    if continuous and "multi_turn_offset" in table.items:
        return -_MULTI_TURN_TICKS, _MULTI_TURN_TICKS
    return table.min_tick, table.max_tick


def mode_plans(
    table: ControlTable, lower_tick: int, upper_tick: int, continuous: bool
) -> tuple[ModePlan, ...]:
    """Return the plans of all modes that a model has.

    A model that cannot count turns has no position control for a `continuous` joint.

    Args:
        table: Control table of the model.
        lower_tick: Lowest goal position within the joint's limits and `position_reach`.
        upper_tick: Highest goal position within the joint's limits and `position_reach`.
        continuous: The joint is a wheel or turns more than once.
    """
    ends = (lower_tick, upper_tick)
    if "operating_mode" in table.items:
        return tuple(_by_operating_mode(table, ends, continuous))
    return tuple(_by_angle_limits(table, ends, continuous))


def can_count_turns(table: ControlTable) -> bool:
    """Return True if a model has Extended Position Control Mode in place of Position Control Mode."""
    return {_POSITION, _EXTENDED} <= set(operating_modes(table))


def has_one_turn(found: Mapping[str, int]) -> bool:
    """Return True if the register values in `found`, by name, select Position Control Mode."""
    return found.get("operating_mode") == _POSITION


def counting_turns(modes: Sequence[ModePlan]) -> tuple[ModePlan, ...]:
    """Return the plans of modes with Extended Position Control Mode in place of Position Control Mode."""
    return tuple(
        replace(
            mode,
            operating=tuple(
                replace(register, value=_EXTENDED)
                if (register.name, register.value) == ("operating_mode", _POSITION)
                else register
                for register in mode.operating
            ),
        )
        for mode in modes
    )


def mode_in(servo: ServoPlan, found: Mapping[str, int]) -> Mode:
    """Return the mode that the register values in `found`, by name, select; UNKNOWN if the plan has none for
    them.

    If two modes have the same registers, as velocity and PWM in wheel mode, the start mode wins."""
    for plan in sorted(servo.modes, key=lambda plan: plan.mode != servo.start_mode):
        if in_mode(plan, found):
            return plan.mode
    return Mode.UNKNOWN


def model_modes(table: ControlTable, continuous: bool) -> tuple[Mode, ...]:
    """Return the modes that a model has, for a joint that is continuous or not."""
    return tuple(plan.mode for plan in mode_plans(table, table.min_tick, table.max_tick, continuous))


def controls_speed(table: ControlTable) -> bool:
    """Return True if a model controls its speed in velocity mode; in wheel mode of Protocol 1.0 only MX
    models do."""
    return "operating_mode" in table.items or "resolution_divider" in table.items


def in_mode(wanted: ModePlan, found: Mapping[str, int]) -> bool:
    """Return True if the register values in `found`, by name, select this mode.

    Any pair of angle limits in ascending order selects joint mode. A pair in descending order selects no
    mode: it belongs to a servo whose mode change was interrupted after one of the two writes."""
    values = {register.name: register.value for register in wanted.operating}
    low, high = values.pop("cw_angle_limit", None), values.pop("ccw_angle_limit", None)
    if any(found.get(name) != value for name, value in values.items()):
        return False
    if low is not None and low != high:
        return found.get("cw_angle_limit", 0) < found.get("ccw_angle_limit", 0)
    return low is None or found.get("cw_angle_limit") == found.get("ccw_angle_limit") == low


def own_limits(table: ControlTable) -> tuple[OwnLimit, ...]:
    """Return the registers of a model that hold its own limits, in ticks of the goal. The servo refuses a
    goal beyond them."""
    places: list[tuple[Literal["speed", "effort", "pwm"], str]] = [
        ("speed", "velocity_limit"),
        ("effort", "current_limit"),
        ("pwm", "pwm_limit"),
    ]
    if limits_torque(table) or "goal_torque" in table.items:
        places.append(("effort", "max_torque" if "max_torque" in table.items else "torque_limit"))
    return tuple(
        OwnLimit(of, item.name, item.address, item.size)
        for of, name in places
        if (item := table.items.get(name)) is not None
    )


def limits_torque(table: ControlTable) -> bool:
    """Return True if Torque Limit (34) can limit the effort of a position goal, as in Protocol 1.0."""
    return table.protocol == 1.0 and "torque_limit" in table.items


def position_layout(table: ControlTable) -> GoalLayout:
    """Return the block of the goal position, which includes the speed toward it if the two items are
    adjacent."""
    position, speed = table.items["goal_position"], table.items[table.goal_speed_item]
    start = min(position.address, speed.address)
    if abs(position.address - speed.address) != (speed.size if start == speed.address else position.size):
        return GoalLayout(position.address, position.size, position=field(position, position.address))
    length = position.size + speed.size
    return GoalLayout(start, length, position=field(position, start), speed=field(speed, start))


def _by_operating_mode(table: ControlTable, ends: tuple[int, int], continuous: bool) -> list[ModePlan]:
    """Return the mode plans of a model with Operating Mode (e-Manual, section of that name, by model)."""
    items, listed = table.items, operating_modes(table)
    # PRO; its Goal Torque counts current as well
    effort = "goal_current" if "goal_current" in items else "goal_torque"
    current = _scale(table, effort, _effort_of_ampere(table))
    to_goal = Scale(table.rad_s_per_tick, table.max_speed_tick)
    plain = ModePlan(Mode.UNKNOWN, (), (), *ends, table.rad_s_per_tick)
    found: list[ModePlan] = []

    def add(number: int, change: ModePlan) -> None:
        found.append(replace(change, operating=(_value(table, "operating_mode", number),)))

    position = replace(plain, mode=Mode.POSITION, goals=(position_layout(table),), speed=to_goal)
    limited = position
    if _CURRENT_BASED in listed:
        # The effort goes first. Otherwise the servo would briefly pursue the new position with the old limit.
        goals = (_alone(items[effort], "effort"), *position.goals)
        limited = replace(position, goals=goals, effort=current)
    if not continuous and _POSITION in listed:
        add(_POSITION, position)
    elif not continuous:
        add(_CURRENT_BASED, limited)
    elif _EXTENDED in listed:
        add(_EXTENDED, position)
    if _VELOCITY in listed:
        layout, speed = _alone(items["goal_velocity"], "speed"), _scale(table, "goal_velocity")
        add(_VELOCITY, replace(plain, mode=Mode.VELOCITY, goals=(layout,), speed=speed))
    if _CURRENT in listed:
        layout = _alone(items[effort], "effort")
        add(_CURRENT, replace(plain, mode=Mode.EFFORT, goals=(layout,), effort=current))
        if _CURRENT_BASED in listed and not continuous:
            add(_CURRENT_BASED, replace(limited, mode=Mode.EFFORT_POSITION))
    if _PWM in listed:
        layout, scale = _alone(items["goal_pwm"], "pwm"), _scale(table, "goal_pwm")
        add(_PWM, replace(plain, mode=Mode.PWM, goals=(layout,), pwm=scale))
    return found


def operating_modes(table: ControlTable) -> tuple[int, ...]:
    """Return the values of Operating Mode that a model supports, or an empty tuple without that item
    (e-Manual, by model)."""
    item = table.items.get("operating_mode")
    if item is None:
        return ()
    ends = {
        (_VELOCITY, _POSITION): (_VELOCITY, _POSITION),  # L42-10-S300-R
        (_CURRENT, _POSITION): (_CURRENT, _VELOCITY, _POSITION),  # Y
        (_CURRENT, _EXTENDED): (_CURRENT, _VELOCITY, _POSITION, _EXTENDED),  # PRO
        (_CURRENT, _CURRENT_BASED): (_CURRENT, _CURRENT_BASED),  # RH-P12-RN, RH-P12-RN(A)
    }
    if (listed := ends.get((item.minimum, item.maximum))) is not None:
        return listed
    if table.items["torque_enable"].address == _ADDRESS_OF_P:
        return _CURRENT, _VELOCITY, _POSITION, _EXTENDED, _PWM
    if "goal_current" in table.items:
        return _CURRENT, _VELOCITY, _POSITION, _EXTENDED, _CURRENT_BASED, _PWM
    return _VELOCITY, _POSITION, _EXTENDED, _PWM


def mode_numbers(table: ControlTable) -> dict[str, int]:
    """Return the values of Operating Mode, or of Control Mode of the XL-320, that a model supports, by name;
    empty without that item."""
    if "control_mode" in table.items:
        return {"wheel": _WHEEL, "joint": _JOINT}
    return {name: number for name, number in _NAMES.items() if number in operating_modes(table)}


def _by_angle_limits(table: ControlTable, ends: tuple[int, int], continuous: bool) -> list[ModePlan]:
    """Return the mode plans of a model that chooses between joint and wheel by angle limits or Control
    Mode."""
    items = table.items
    many = continuous and "multi_turn_offset" in items
    controlled = controls_speed(table)
    wheel_unit = table.rad_s_per_tick if controlled else table.max_speed / _FULL
    plain = ModePlan(Mode.UNKNOWN, (), (), *ends, table.rad_s_per_tick)
    wheel = replace(plain, operating=_selected(table, (0, 0)), present_rad_s_per_tick=wheel_unit)
    found: list[ModePlan] = []
    if many or not continuous:
        limits = (table.max_tick, table.max_tick) if many else ends
        to_goal, layout = Scale(table.rad_s_per_tick, table.max_speed_tick), position_layout(table)
        if many:
            # Negative turns are in two's complement (e-Manual MX-28, Goal Position (30), Multi-turn Mode).
            layout = replace(layout, position=replace(layout.leading, encoding="twos_complement"))
        goals = (layout,)
        joint = replace(plain, mode=Mode.POSITION, operating=_selected(table, limits), goals=goals)
        found.append(replace(joint, speed=to_goal))
        if limits_torque(table) and not many:
            limit = (_alone(items["torque_limit"], "effort"), *goals)
            limited = replace(found[0], mode=Mode.EFFORT_POSITION, goals=limit)
            found.append(replace(limited, effort=Scale(1 / _FULL, _FULL)))
    goals = (_alone(items["moving_speed"], "speed"),)
    speed = Scale(wheel_unit, table.max_speed_tick)
    found.append(replace(wheel, mode=Mode.VELOCITY, goals=goals, speed=speed))
    if not controlled:
        goals = (_alone(items["moving_speed"], "pwm"),)
        found.append(replace(wheel, mode=Mode.PWM, goals=goals, pwm=Scale(1 / _FULL, _FULL)))
    if "goal_torque" in items:
        enabled = (_value(table, "torque_ctrl_mode_enable", 1),)
        goals, torque = (_alone(items["goal_torque"], "effort"),), Scale(1 / _FULL, _FULL)
        found.append(replace(plain, mode=Mode.EFFORT, operating=enabled, goals=goals, effort=torque))
    return found


def _selected(table: ControlTable, limits: tuple[int, int]) -> tuple[RegisterValue, ...]:
    """Return the register values that select joint mode with these limits, ticks, or wheel mode: both
    limits 0."""
    if "control_mode" in table.items:
        return (_value(table, "control_mode", _JOINT if any(limits) else _WHEEL),)
    chosen = [
        _value(table, name, limit)
        for name, limit in zip(("cw_angle_limit", "ccw_angle_limit"), limits, strict=True)
    ]
    if "torque_ctrl_mode_enable" in table.items:
        chosen.append(_value(table, "torque_ctrl_mode_enable", 0))
    return tuple(chosen)


def _effort_of_ampere(table: ControlTable) -> float:
    scale = table.items[table.effort_item].scale
    return table.effort_per_tick / scale if table.effort_item == "present_current" else 1.0


def _alone(item: ControlItem, of: Literal["speed", "effort", "pwm"]) -> GoalLayout:
    place = field(item, item.address)
    return GoalLayout(
        item.address,
        item.size,
        speed=place if of == "speed" else None,
        effort=place if of == "effort" else None,
        pwm=place if of == "pwm" else None,
    )


def _scale(table: ControlTable, name: str, factor: float = 1.0) -> Scale | None:
    item = table.items.get(name)
    return None if item is None else Scale(item.scale * factor, item.maximum)


def _value(table: ControlTable, name: str, value: int) -> RegisterValue:
    item = table.items[name]
    return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")


def field(item: ControlItem, start: int) -> Field:
    """Return place and encoding of an item in a block of bytes that begins at address `start`."""
    return Field(item.address - start, item.size, item.encoding)
