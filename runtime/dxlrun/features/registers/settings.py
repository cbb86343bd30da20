"""Declared registers, checked against the servos' control tables, the bus, and the limits of joints."""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.compile.joints.described_servos import DescribedServo, described_servos
from dxlrun.compile.joints.register_values import UnfitRegister, register_value
from dxlrun.compile.joints.servos import SettingsStage
from dxlrun.compile.problems import RobotFile
from dxlrun.description.reading import Description
from dxlrun.errors import Mark
from dxlrun.features.registers import servo_key
from dxlwire.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlwire.control_table import ControlTable

_LEVEL = "status_return_level"
_LOWER = ("min_position_limit", "cw_angle_limit")
_UPPER = ("max_position_limit", "ccw_angle_limit")


def compile_registers(
    file: RobotFile, servo: DescribedServo, table: ControlTable
) -> tuple[RegisterValue, ...]:
    """Return the declared registers of a servo in the order of writing: EEPROM first, by address.

    Status Return Level comes before all others, so that their writes are acknowledged.
    """
    found: list[RegisterValue] = []
    name = servo.title
    for register, value in servo_key.STAGE.of(servo).items():
        mark = servo.mark(file.marks, "registers", register)
        try:
            found.append(register_value(table, register, value))
        except UnfitRegister as error:
            file.error(mark, f"{name}: {error.what}", error.fix)
        except ValueError as error:  # an invalid quantity
            what, _, fix = str(error).partition("; ")
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
    """Refuse declared position limits narrower than those of the joint: the servo would refuse goals.

    Multi-turn modes ignore the limits (e-Manual XM430-W350, Min/Max Position Limit (52, 48)).
    """
    for servo in plan.servos:
        if servo.continuous:
            continue
        for register, needed in _narrow(servo):
            file.error(
                _place(file.description, servo, register.name),
                f"{servo.joint} declares {register.name} = {register.value}, but its limits reach to tick "
                f"{needed}, and the servo would refuse goals there",
                f"declare {needed}, or make `limits: {{position: ...}}` narrower",
            )


def _place(description: Description, servo: ServoPlan, register: str) -> Mark:
    """Return the place where a servo of the plan declares a register."""
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


STAGE = SettingsStage(compile_registers, check_position_limits)
