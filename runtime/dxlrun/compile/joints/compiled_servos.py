"""Servos: compiles each servo of the robot file: its control table, registers and motor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import ClassVar, Protocol

import msgspec

from dxlrun.compile.joints.described_servos import AUTO, DescribedServo, described_servos, used_features
from dxlrun.compile.joints.limits import Interval, degrees
from dxlrun.compile.joints.motors import Motors, compile_motor
from dxlrun.compile.problems import RobotFile
from dxlrun.description.joints.servo_model import ServoModel
from dxlrun.errors import Mark, suggestion
from dxlrun.features import stages
from dxlsim.motor_model import MotorModel
from dxlwire.bus_plan import BusPlan, RegisterValue
from dxlwire.control_table import ControlTable, find_table, perhaps_meant, protocols_of
from dxlwire.plan.mode_plan import can_count_turns, mode_plans
from dxlwire.wire.dialect import ONE_PROTOCOL

_USUAL = {1.0: "AX-12A", 2.0: "XM430-W350"}  # assumed model if none is known, by protocol
MANY_TURNS = {1.0: 7, 2.0: 256}
"""Turns that a goal position can be away from raw 0, by protocol. Multi-turn Mode of MX (e-Manual MX-64,
Goal Position (30): -28,672..28,672), Extended Position Control Mode (e-Manual XM430-W350, Goal Position
(116): -1,048,575..1,048,575)."""
_MOST_TURNS = 2  # of the travel of a joint that is not continuous: each of its positions occurs twice then
_TEMPERATURE_LIMITS = ("motor_temperature_limit", "temperature_limit")
"""Items with the temperature limit of the motor: Y series, and all other models. Y also has a limit for its
inverter."""


class CompiledServo(msgspec.Struct, frozen=True):
    """A servo with its control table, the registers to write at start, and its motor model."""

    described: DescribedServo
    table: ControlTable
    settings: tuple[RegisterValue, ...]  # settings of features, in the order of writing
    motor: MotorModel | None
    known_bus: bool
    certain: bool  # False while its model is not read yet; its mistakes are not errors yet

    @property
    def declared(self) -> dict[str, int]:
        """Integers that the robot file sets in the servo's registers, by item."""
        return {setting.name: setting.value for setting in self.settings}

    @property
    def position_range(self) -> Interval:
        """Range of the servo's goals, rad or m, at its joint or at the input of its transmission."""
        described = self.described
        if described.continuous:
            reach = many_turns(self.table.protocol, described.reference, described.direction)
        else:
            reach = joint_reach(servo_travel(self.table), described.reference, described.direction)
        return reach.scaled(described.ratio, described.unit)

    def counts_turns_for(self, needed: Interval) -> bool:
        """Return True if the servo counts turns to reach these positions of its joint: less than two turns,
        so that the start can find the turn."""
        described = self.described
        turns = (needed.upper - needed.lower) / abs(described.ratio) / math.tau
        return not described.continuous and can_count_turns(self.table) and turns < _MOST_TURNS

    @property
    def top_speed(self) -> float:
        """Highest speed of the servo after its gear, rad/s or m/s; 0: not known."""
        return self.table.top_speed * self.described.ratio

    @property
    def top_effort(self) -> float | None:
        """Highest effort goal of the servo after its gear; None if the servo accepts none."""
        table, continuous = self.table, self.described.continuous
        scales = [plan.effort for plan in mode_plans(table, table.min_tick, table.max_tick, continuous)]
        most = max((scale.per_tick * scale.most for scale in scales if scale is not None), default=None)
        return most if most is None or table.effort_unit != "Nm" else most / self.described.ratio

    @property
    def servo_model(self) -> ServoModel:
        """Figures of the servo's model from its manual, such as stall torque, after its gear."""
        table, ratio = self.table, self.described.ratio
        limit = next((table.items[name] for name in _TEMPERATURE_LIMITS if name in table.items), None)
        raw = None if limit is None else self.declared.get(limit.name, limit.initial)
        return ServoModel(
            model=table.model,
            label=self.described.servo,
            effort_unit=table.effort_unit,
            stall_torque=table.stall_torque / ratio or None,
            stall_current=table.stall_current or None,
            voltage=table.nominal_voltage or None,
            no_load_speed=table.max_speed * ratio or None,
            temperature_limit=None if limit is None or raw is None else raw * limit.scale,
        )


class SettingsStage(msgspec.Struct, frozen=True):
    """Hook `STAGE` in a feature's `settings.py`: registers to write before a servo gets torque.

    They are part of the servo's plan. Start-up writes those that differ, and so does the recovery of the
    servo.
    """

    FILE: ClassVar[str] = "settings"

    compile: Callable[[RobotFile, DescribedServo, ControlTable], Iterable[RegisterValue]]
    """Returns the values to write into one servo, EEPROM first. If two features set an item, the later one
    wins."""
    check: Callable[[RobotFile, BusPlan], None] = lambda file, plan: None
    """Adds a problem to the file if the values do not fit the compiled bus."""
    change: Callable[[ControlTable, str, int | str], RegisterValue] | None = None
    """Converts the integer or quantity that a client writes into an item during a run; raises UnfitRegister.
    Only the first feature with this function is used."""


def compile_servos(file: RobotFile, models: Mapping[str, str], motors: Motors) -> dict[str, CompiledServo]:
    """Compile all servos whose control table is known, by name; `model: auto` gets an assumed model.

    Args:
        file: Robot file; collects the problems.
        models: Models that were read from the servos of joints with `model: auto`, by joint.
        motors: Motor files.
    """
    described, features = described_servos(file.description), used_features(file.description)
    _unique_ids(file, described)
    compiled: dict[str, CompiledServo] = {}
    for servo in described:
        known_bus = check_bus(file, servo, servo.title, partial(servo.mark, file.marks), "servo ID")
        model = servo.model if servo.model != AUTO else models.get(servo.name)
        if model is None:
            model = _assumed_model(file, servo, described)
        table = _table(file, servo, model, described)
        if table is None:
            continue
        if not servo.continuous:
            _check_reference(file, servo, table)
        # The registers of a servo whose model is not read yet are unknown. Those that fit the assumed model
        # are kept, because a simulated servo has exactly these; mistakes are not errors yet.
        of_one_protocol = len(protocols_of(model)) == 1  # an MX name stands for two firmwares
        certain = (servo.model != AUTO or servo.name in models) and (known_bus or of_one_protocol)
        found = file if certain else RobotFile(file.description)
        settings = {
            setting.name: setting
            for _, stage in stages(SettingsStage, features)
            for setting in stage.compile(found, servo, table)
        }
        declared = {name: setting.value for name, setting in settings.items()}
        motor = compile_motor(found, servo, table, declared, motors.servos.get(servo.name))
        made = CompiledServo(servo, table, tuple(settings.values()), motor, known_bus, certain)
        compiled[servo.name] = made
    return compiled


def _unique_ids(file: RobotFile, servos: list[DescribedServo]) -> None:
    owners: dict[tuple[str, int], str] = {}
    for servo in servos:
        owner = owners.setdefault((servo.bus, servo.id), servo.name)
        if owner != servo.name:
            other = next(one.title for one in servos if one.name == owner)
            if other == servo.title:  # two servos of one joint, which share its name
                other = f"servo {owner.rpartition('/')[2]} of the same joint"
            file.error(
                servo.mark(file.marks, "id"),
                f"servo ID {servo.id} of {servo.title} is taken by {other} on bus {servo.bus}",
                "give every servo of a bus its own ID",
            )


class BusEntry(Protocol):
    """An entry of the robot file with a bus and an ID: a servo or a device."""

    @property
    def bus(self) -> str:
        """Name of the bus in the file."""

    @property
    def id(self) -> int:
        """ID of the servo or device on its bus."""


def check_bus(file: RobotFile, one: BusEntry, name: str, at: Callable[[str], Mark], called: str) -> bool:
    """Check an entry's bus and ID, add errors; return True if the bus exists. `at` returns places of keys."""
    bus = file.robot.buses.get(one.bus)
    if bus is None:
        what = f"bus {one.bus} of {name} is not defined"
        file.error(at("bus"), what, suggestion(one.bus, tuple(file.robot.buses)))
    elif one.id > bus.highest_id:
        what = f"{called} {one.id} of {name} is not valid in Protocol 2.0"
        file.error(at("id"), what, f"write an ID from 0 to {bus.highest_id}")
    return bus is not None


def _assumed_model(file: RobotFile, servo: DescribedServo, others: list[DescribedServo]) -> str:
    """Return the model to assume for `model: auto` until the servo reports it: that of another on the bus.

    `auto` is an error for a servo that moves its joint or joints together with others.
    """
    neighbours = [each.model for each in others if each.bus == servo.bus]
    known = [model for model in neighbours if model != AUTO]
    bus = file.robot.buses.get(servo.bus)
    model = known[0] if known else _USUAL[1.0 if bus is None else bus.protocol]
    mark = servo.mark(file.marks, "model")
    if servo.name != servo.title or servo.name not in file.robot.joints:
        file.error(
            mark,
            f"{servo.title} ({servo.servo}) shares its joint with other servos, so its model cannot be auto",
            f"write the model, such as {model}",
        )
        return model
    file.warning(
        mark,
        f"the model of {servo.title} is unknown until the start, and checked as {model}",
        "write the model for reliable checks of range and time",
    )
    return model


def _table(
    file: RobotFile, servo: DescribedServo, model: str, others: Iterable[DescribedServo]
) -> ControlTable | None:
    mark, name = servo.mark(file.marks, "model"), servo.title
    bus = file.robot.buses.get(servo.bus)
    protocol = None if bus is None else bus.protocol
    try:
        return find_table(model, protocol)
    except LookupError:
        protocols = protocols_of(model)
    if not protocols:
        file.error(mark, f"model {model} of {name} is unknown", perhaps_meant(model, protocol))
        return None
    if bus is not None:
        fix = f"put {name} on a bus with Protocol {protocols[0]}"
        if any(bus.protocol in protocols_of(other.model) for other in others if other.bus == servo.bus):
            fix = f"{fix} and an adapter of its own: {ONE_PROTOCOL}"
        file.error(
            mark,
            f"{model} of {name} has Protocol {protocols[0]}, but bus {servo.bus} has Protocol {bus.protocol}",
            fix,
        )
    return find_table(model, protocols[0])


def _check_reference(file: RobotFile, servo: DescribedServo, table: ControlTable) -> None:
    moved = [file.robot.joints[name] for name in servo.joints if name in file.robot.joints]
    if can_count_turns(table) and all(joint.limits.position is not None for joint in moved):
        return  # the limits are compared with the reach of the servo
    travel = servo_travel(table)
    if not travel.lower <= servo.reference <= travel.upper:
        file.warning(
            servo.mark(file.marks, "reference"),
            f"reference {degrees(servo.reference)} deg of {servo.title} is outside the travel of an "
            f"{table.model} ({degrees(travel.lower)}..{degrees(travel.upper)} deg), so the joint cannot "
            "reach 0",
            "check the reference, the servo's angle at 0 of the joint",
        )


def many_turns(protocol: float, reference: float, direction: int) -> Interval:
    """Return the joint angles, rad, that a multi-turn servo can reach, centred on its raw 0."""
    turns = 2 * math.pi * MANY_TURNS[protocol]
    middle = -direction * reference
    return Interval(middle - turns, middle + turns)


def servo_travel(table: ControlTable) -> Interval:
    """Return the angles that a servo's goal positions reach within a turn, rad from its raw 0.

    From 0 upwards in Protocol 1.0 and on X and MX, to both sides of 0 on P, PRO and Y (e-Manual, Goal
    Position).
    """
    return Interval(table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick)


def joint_reach(travel: Interval, reference: float, direction: int) -> Interval:
    """Convert a servo's range, rad from raw 0, into joint angles with its reference and direction.

    s = direction * (theta - reference), theta in `travel` (thesis of M. Amarante Araujo, 2017, JointID).
    """
    ends = (direction * (travel.lower - reference), direction * (travel.upper - reference))
    return Interval(min(ends), max(ends))
