"""Checks register values of a robot file or a client against control tables, buses and joint limits.

The same items are reserved for dxlrun in the robot file and in requests of clients.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from dxlrun.compile.joints.compiled_servos import SettingsStage
from dxlrun.compile.joints.described_servos import DescribedServo, described_servos
from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.compile.problems import RobotFile
from dxlrun.description.reading import Description
from dxlrun.errors import Mark, what_and_fix
from dxlrun.features.registers import servo_key
from dxlwire.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlwire.control_table import ControlItem, ControlTable
from dxlwire.control_table.servo_models import perhaps_meant_item

_LEVEL = "status_return_level"
_LOWER = ("min_position_limit", "cw_angle_limit")
_UPPER = ("max_position_limit", "ccw_angle_limit")
_COMMANDED = ("controllers command it", "remove it; a controller sends it")
_MODE = (
    "the interfaces of the active controllers choose the mode",
    "remove it; choose other interfaces of controllers",
)
_ADDRESS = ("dxlrun finds the servo by it", "remove it; use `dxlrun servo` instead")
_SECOND_ID = ("a servo with a second ID executes the goals of another servo", "remove it")
_TICK = ("it changes the size of a tick", "remove it")
_OWN: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "id": _ADDRESS,
        "baud_rate": _ADDRESS,
        "baud_rate_bus": _ADDRESS,
        "protocol_type": _ADDRESS,
        "secondary_id": _SECOND_ID,
        "secondary_shadow_id": _SECOND_ID,
        "torque_enable": ("dxlrun switches the torque, after its checks", "remove it"),
        "operating_mode": _MODE,
        "control_mode": _MODE,
        "torque_ctrl_mode_enable": _MODE,
        "goal_position": _COMMANDED,
        "goal_velocity": _COMMANDED,
        "goal_current": _COMMANDED,
        "goal_pwm": _COMMANDED,
        "goal_torque": _COMMANDED,
        "moving_speed": _COMMANDED,
        "profile_velocity": _COMMANDED,
        "current": ("it is measured", "remove it"),
        "torque_limit": (
            "policies reduce it, and a start restores it",
            "declare max_torque, its value after power-on",
        ),
        "bus_watchdog": ("dxlrun arms it", "remove it; write `bus_watchdog` at the bus"),
        "lock": ("it closes the EEPROM until power-off", "remove it"),
        "hybrid_save": ("it stores RAM values in the EEPROM", "remove it"),
        "electronic_gearratio_numerator": _TICK,
        "electronic_gearratio_denominator": _TICK,
    }
)
"""Items that a robot file or client cannot set because dxlrun writes or needs them; reason and fix."""
_RESTORED = ("profile_velocity", "torque_limit")
"""Items that dxlrun restores at start on some models only; on the others they can be declared."""
_ANGLE_LIMITS = ("cw_angle_limit", "ccw_angle_limit")


def compile_registers(
    file: RobotFile, servo: DescribedServo, table: ControlTable
) -> tuple[RegisterValue, ...]:
    """Return the values of a servo's `registers` in the order of writing: EEPROM first, by address.

    Status Return Level comes before all others, so that their writes are acknowledged.
    """
    found: list[RegisterValue] = []
    name = servo.title
    for register, value in servo_key.STAGE.value_of(servo).items():
        mark = servo.mark(file.marks, "registers", register)
        try:
            found.append(register_value(table, register, value))
        except UnfitRegister as error:
            file.error(mark, f"{name}: {error.what}", error.fix)
        except ValueError as error:  # an invalid quantity
            what, fix = what_and_fix(error)
            file.error(mark, f"{register} of {name}: {what}", fix)
    bus = file.robot.buses.get(servo.bus)
    delay = next((one.value for one in found if one.name == "return_delay_time"), None)
    if delay is not None and bus is not None and abs(delay * 2_000 - bus.return_delay_time) >= 2_000:
        file.warning(
            servo.mark(file.marks, "registers", "return_delay_time"),
            f"{name} declares a return delay of {delay * 2} us, but bus {servo.bus} is planned with "
            f"{bus.return_delay_time / 1000:g} us",
            f"write `return_delay_time: {delay * 2} us` at the bus if all its servos have it",
        )
    return tuple(sorted(found, key=lambda one: (one.name != _LEVEL, not one.eeprom, one.address)))


def check_position_limits(file: RobotFile, plan: BusPlan) -> None:
    """Add an error for each servo whose declared position limits are narrower than its joint's limits.

    Multi-turn modes ignore the limits (e-Manual XM430-W350, Min/Max Position Limit (52, 48)).
    """
    for servo in plan.servos:
        if servo.continuous or servo.extended:
            continue
        for register, needed in _narrow(servo):
            file.error(
                _place(file.description, servo, register.name),
                f"{servo.joint} declares {register.name} = {register.value}, but its limits reach to tick "
                f"{needed}",
                f"declare {needed}, or make `limits: {{position: ...}}` narrower",
            )


def _place(description: Description, servo: ServoPlan, register: str) -> Mark:
    """Return line and column where the robot file declares a register of a servo."""
    for described in described_servos(description):
        if described.name == servo.own_name:
            return described.mark(description.marks, "registers", register)
    return description.marks.value("joints", servo.joint, "registers", register)


def _narrow(servo: ServoPlan) -> Iterator[tuple[RegisterValue, int]]:
    for register in servo.settings:
        if register.name in _LOWER and register.value > servo.lower_tick:
            yield register, servo.lower_tick
        if register.name in _UPPER and register.value < servo.upper_tick:
            yield register, servo.upper_tick


def register_value(table: ControlTable, name: str, value: int | str) -> RegisterValue:
    """Check a register value that a robot file declares, and convert it into the integer to write.

    Args:
        table: Control table of the servo.
        name: Name of the item.
        value: Integer on the wire, or a quantity with its unit.

    Raises:
        UnfitRegister: The register or the value cannot be declared.
    """
    item = table.items.get(name)
    if item is None:
        meant = perhaps_meant_item(name, table, declarable(table))
        raise UnfitRegister(f"{table.model} has no register {name}", meant)
    if reason := own_reason(table, item):
        raise UnfitRegister(f"{item.title} cannot be declared: {reason[0]}", reason[1])
    found = any_value(table, name, value)
    _check_meaning(item, found.value)
    return found


def check_change(table: ControlTable, name: str, value: int | str) -> RegisterValue:
    """Check a register value that a client sets during a run, and convert it; raise UnfitRegister.

    Items that dxlrun uses and items in the EEPROM are refused.
    """
    item = table.items.get(name)
    if item is not None and item.access == "R":
        raise UnfitRegister(f"{item.title} can only be read", "write another item")
    if item is not None and (reason := own_reason(table, item)):
        raise UnfitRegister(f"{item.title} cannot be changed: {reason[0]}", "write another item")
    found = register_value(table, name, value)
    item = table.items[name]
    if found.eeprom:
        raise UnfitRegister(
            f"{item.title} is in the EEPROM, not writable while the servo has torque",
            "declare it under `registers` in the robot file; the next start writes it",
        )
    if item.deviation is not None and item.deviation.may_refuse:
        raise UnfitRegister(
            f"{item.title} cannot be changed: another value {item.deviation.effect}", "leave it as it is"
        )
    return found


def declarable(table: ControlTable) -> tuple[str, ...]:
    """Return the names of a model's items that `registers` can set, in the order of their addresses."""
    items = table.items.values()
    return tuple(item.name for item in items if item.access == "RW" and not own_reason(table, item))


def own_reason(table: ControlTable, item: ControlItem) -> tuple[str, str] | None:
    """Return reason and fix if an item cannot be set because dxlrun uses it; else None."""
    if item.name.startswith("indirect_"):
        return "a reboot resets it", "remove it"
    if item.name in _ANGLE_LIMITS and table.protocol == 1.0:
        return (
            "both angle limits choose the mode, which dxlrun sets",
            "write `limits: {position: ...}` instead",
        )
    rule = item.deviation
    if rule is not None and item.name in _RESTORED and rule.judgement == "report":
        return None  # start-up does not write it on this model
    return _OWN.get(item.name)


def _check_meaning(item: ControlItem, raw: int) -> None:
    """Refuse a value that the servo would accept, but with which dxlrun would refuse every start."""
    rule, factory = item.deviation, item.initial
    if rule is None or rule.planned or factory is None or rule.judge_value(raw, factory) != "refuse":
        return
    raise UnfitRegister(
        f"{item.title} cannot be {raw}: this value {rule.effect_of(raw)}", f"write {factory}, or remove it"
    )


STAGE = SettingsStage(compile_registers, check_position_limits, check_change)
