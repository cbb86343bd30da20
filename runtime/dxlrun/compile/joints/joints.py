"""Joints of the robot file against buses, models, limits and reach."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dxlrun.compile.joints.limits import Interval, degrees
from dxlrun.compile.joints.motors import Motors, compile_motor
from dxlrun.compile.joints.registers import compile_registers
from dxlrun.compile.problems import Problems
from dxlrun.control.loop_plan import ControllerPlan, JointPlan
from dxlrun.description import Description
from dxlrun.description.motors.servo import ServoModel
from dxlrun.description.robot import Joint
from dxlrun.description.units import EffortUnit
from dxlrun.dynamixel.control_table import ControlTable, control_table, perhaps_meant, protocols_of
from dxlrun.dynamixel.plan.bus_plan import RegisterValue
from dxlrun.dynamixel.plan.mode_plan import mode_plans
from dxlrun.errors import suggestion

_UNITS: Mapping[EffortUnit, str] = {"Nm": "Nm", "A": "A", "1": "% of its highest load"}
_EXAMPLES: Mapping[EffortUnit, str] = {"Nm": "0.3 Nm", "A": "800 mA", "1": "40 %"}
AUTO = "auto"
"""In place of a model: it is read from the servo."""
_HIGHEST_ID_OF_PROTOCOL_2 = 252
"""0xFD is in the header of each packet (e-Manual, Protocol 2.0, Packet ID)."""
_USUAL = {1.0: "AX-12A", 2.0: "XM430-W350"}
"""The model that is assumed where none is known, by protocol."""
MANY_TURNS = {1.0: 7, 2.0: 256}
"""Turns that a goal position can be away from raw 0, by protocol: Multi-turn Mode of MX (e-Manual MX-64, Goal
Position (30): -28,672..28,672), Extended Position Control Mode (e-Manual XM430-W350, Goal Position (116):
-1,048,575..1,048,575)."""
MOST_STARTING_S = 10.0
"""A joint that needs longer to its highest speed, and to stop from it, is one with a mistaken unit. [i]"""
_TEMPERATURE_LIMITS = ("motor_temperature_limit", "temperature_limit")
"""The item of the Y series whose motor and inverter have one each, and that of all others."""
_SAME = math.radians(1.0)
"""References nearer than this are taken as equal: a horn has teeth, a trim has not."""


@dataclass(frozen=True, slots=True)
class CompiledJoint:
    """A joint whose bus and model are known."""

    plan: JointPlan
    described: Joint
    table: ControlTable
    reach: Interval
    """rad, in the joint's coordinate"""
    registers: tuple[RegisterValue, ...] = ()
    """Its declared registers, in the order in which they are written."""


def compile_joints(
    description: Description, problems: Problems, models: Mapping[str, str], motors: Motors
) -> dict[str, CompiledJoint]:
    """Return the joints that could be compiled, by name, in the order of the file.

    `models`: those that were read from the servos of joints with `model: auto`, by joint.
    """
    _unique_ids(description, problems)
    compiled: dict[str, CompiledJoint] = {}
    for name, joint in description.robot.joints.items():
        known_bus = _known_bus(description, name, joint, problems)
        model = joint.model if joint.model != AUTO else models.get(name)
        if model is None:
            model = _assumed_model(description, name, joint, problems)
        table = _table(description, name, joint, model, problems)
        if table is None:
            continue
        reach = _reach(joint, table)
        if not joint.continuous:
            _check_reference(description, name, joint, table, problems)
        allowed = _allowed(description, name, reach, table.model, problems)
        # the registers of a servo whose model is still to be read are unknown: those that fit the assumed
        # model are kept, as a simulated servo has exactly these; what does not fit is no error yet
        certain = (joint.model != AUTO or name in models) and (known_bus or _one_table(model))
        found = problems if certain else Problems()
        effort = _effort(description, name, joint, table, found)
        registers = compile_registers(description, name, joint, table, found)
        motor = compile_motor(description, name, table, registers, motors.of_joint(name), found)
        if known_bus and allowed is not None:
            plan = JointPlan(
                name,
                allowed.lower,
                allowed.upper,
                # the servo cannot go faster: a goal that does not run ahead of it is one that can be stopped
                joint.limits.velocity or table.top_speed or None,
                effort,
                joint.continuous,
                bounded=not joint.continuous or joint.limits.position is not None,
                top_speed=table.top_speed or None,
                top_effort=_top_effort(table, continuous=joint.continuous),
                acceleration=joint.limits.acceleration,
                servo=f"ID {joint.id} on bus {joint.bus}",
                motor=motor,
                servo_model=_servo_model(joint, table, registers),
            )
            _check_acceleration(description, plan, problems)
            compiled[name] = CompiledJoint(plan, joint, table, reach, registers)
    return compiled


def _servo_model(joint: Joint, table: ControlTable, registers: Iterable[RegisterValue]) -> ServoModel:
    """Return what the manual says of a joint's servo."""
    limit = next((table.items[name] for name in _TEMPERATURE_LIMITS if name in table.items), None)
    declared = {each.name: each.value for each in registers}
    raw = None if limit is None else declared.get(limit.name, limit.initial)
    return ServoModel(
        model=table.model,
        label=f"ID {joint.id} on bus {joint.bus}",
        effort_unit=table.effort_unit,
        stall_torque=table.stall_torque or None,
        stall_current=table.stall_current or None,
        voltage=table.nominal_voltage or None,
        no_load_speed=table.max_speed or None,
        temperature_limit=None if limit is None or raw is None else raw * limit.scale,
    )


def check_limp_joints(
    description: Description, controllers: Iterable[ControllerPlan], problems: Problems
) -> None:
    """Refuse controllers that are active from the start and command joints without torque."""
    joints = description.robot.joints
    for plan in controllers:
        limp = [name for name in plan.joints if name in joints and not joints[name].torque]
        if limp and plan.active and plan.command and not plan.into:
            problems.error(
                description.marks.key("controllers", plan.name),
                f"controller {plan.name} is active from the start and commands {', '.join(limp)}, which has "
                "torque: off",
                f"write active: false, and `dxlrun torque on {' '.join(limp)}` before it is activated, or "
                "take torque: off out",
            )


def _unique_ids(description: Description, problems: Problems) -> None:
    owners: dict[tuple[str, int], str] = {}
    for name, joint in description.robot.joints.items():
        owner = owners.setdefault((joint.bus, joint.id), name)
        if owner != name:
            problems.error(
                description.marks.value("joints", name, "id"),
                f"servo ID {joint.id} of {name} is taken by {owner} on bus {joint.bus}",
                "give every servo of a bus its own ID",
            )


def _known_bus(description: Description, name: str, joint: Joint, problems: Problems) -> bool:
    buses = description.robot.buses
    if joint.bus in buses:
        if buses[joint.bus].protocol == 2.0 and joint.id > _HIGHEST_ID_OF_PROTOCOL_2:
            problems.error(
                description.marks.value("joints", name, "id"),
                f"servo ID {joint.id} of {name} is not valid in Protocol 2.0",
                f"give it one from 0 to {_HIGHEST_ID_OF_PROTOCOL_2}",
            )
        return True
    problems.error(
        description.marks.value("joints", name, "bus"),
        f"{name} is on bus {joint.bus}, which is not defined",
        suggestion(joint.bus, tuple(buses)),
    )
    return False


def _assumed_model(description: Description, name: str, joint: Joint, problems: Problems) -> str:
    """Return the model to assume until it is read: that of the neighbours, else the usual one."""
    robot = description.robot
    neighbours = [each.model for each in robot.joints.values() if each.bus == joint.bus]
    known = [model for model in neighbours if model != AUTO]
    bus = robot.buses.get(joint.bus)
    model = known[0] if known else _USUAL[1.0 if bus is None else bus.protocol]
    problems.warning(
        description.marks.value("joints", name, "model"),
        f"the servo of {name} reports its model at the start; until then it is taken for an {model}",
        "write its model to have reach and time checked for certain",
    )
    return model


def _table(
    description: Description, name: str, joint: Joint, model: str, problems: Problems
) -> ControlTable | None:
    mark = description.marks.value("joints", name, "model")
    bus = description.robot.buses.get(joint.bus)
    protocol = None if bus is None else bus.protocol
    try:
        return control_table(model, protocol)
    except LookupError:
        protocols = protocols_of(model)
    if not protocols:
        problems.error(mark, f"no control table for model {model} of {name}", perhaps_meant(model, protocol))
        return None
    if bus is not None:
        problems.error(
            mark,
            f"{model} of {name} speaks Protocol {protocols[0]}, bus {joint.bus} Protocol {bus.protocol}",
            "put it on a bus of its own protocol; a bus cannot be mixed",
        )
    return control_table(model, protocols[0])


def _one_table(model: str) -> bool:
    """Return whether a model has one protocol alone; MX servos have one name for two firmwares."""
    return len(protocols_of(model)) == 1


def _reach(joint: Joint, table: ControlTable) -> Interval:
    if joint.continuous:
        return many_turns(table.protocol, joint.reference, joint.direction)
    return joint_reach(servo_travel(table), joint.reference, joint.direction)


def _effort(
    description: Description, name: str, joint: Joint, table: ControlTable, problems: Problems
) -> float | None:
    """Return the limit of the effort in the unit in which the model measures it."""
    if joint.limits.effort is None:
        return None
    value, unit = joint.limits.effort
    if unit != table.effort_unit:
        problems.error(
            description.marks.value("joints", name, "limits", "effort"),
            f"the effort limit of {name} is in {_UNITS[unit]}, but an {table.model} measures "
            f"{_UNITS[table.effort_unit]} ({table.effort_item.replace('_', ' ')})",
            f"write it in {_UNITS[table.effort_unit]}, such as {_EXAMPLES[table.effort_unit]}",
        )
    return value


def _check_acceleration(description: Description, plan: JointPlan, problems: Problems) -> None:
    """Compare an acceleration limit with the highest speed of its joint, and with the cycle."""
    speed, acceleration, rate = plan.highest_speed, plan.acceleration, description.robot.loop.rate
    if acceleration is None or not math.isfinite(speed):
        return
    mark = description.marks.value("joints", plan.name, "limits", "acceleration")
    seconds = speed / acceleration
    if seconds > MOST_STARTING_S:
        problems.error(
            mark,
            f"{plan.name} would need {seconds:.3g} s to reach {speed:.3g} rad/s, and as long to stop",
            f"allow at least {speed / MOST_STARTING_S:.2g} rad/s^2",
        )
    elif seconds * rate <= 1:
        problems.warning(
            mark,
            f"{acceleration:.4g} rad/s^2 limits nothing: {plan.name} may reach its highest speed, "
            f"{speed:.3g} rad/s, within one cycle of {1e3 / rate:.3g} ms",
            f"write less than {speed * rate:.3g} rad/s^2, or take it out",
        )


def _top_effort(table: ControlTable, *, continuous: bool) -> float | None:
    """Return the highest effort that a servo can be sent, as it measures it; None where it follows none."""
    scales = [plan.effort for plan in mode_plans(table, table.min_tick, table.max_tick, continuous)]
    return max((scale.per_tick * scale.most for scale in scales if scale is not None), default=None)


def _check_reference(
    description: Description, name: str, joint: Joint, table: ControlTable, problems: Problems
) -> None:
    travel = servo_travel(table)
    if not travel.lower <= joint.reference <= travel.upper:
        problems.warning(
            description.marks.value("joints", name, "reference"),
            f"reference {degrees(joint.reference)} deg of {name} lies outside the travel of an {table.model} "
            f"({degrees(travel.lower)}..{degrees(travel.upper)} deg), so the joint can never be at 0",
            "check the reference: it is the servo's angle where the joint's is 0",
        )


def _allowed(
    description: Description, name: str, reach: Interval, model: str, problems: Problems
) -> Interval | None:
    """Return the limits that the gate keeps: the file's, cut to the reach."""
    limits = description.robot.joints[name].limits.position
    if limits is None:
        return reach
    mark = description.marks.value("joints", name, "limits", "position")
    written = Interval(*limits)
    allowed = written.meet(reach)
    if allowed is None:
        problems.error(
            mark,
            f"limits {written} of {name} have nothing in common with the reach of its {model}, {reach}",
            "check limits, reference and direction",
        )
    elif not reach.contains(written):
        problems.warning(
            mark,
            f"limits {written} of {name} go beyond the reach of its {model}, {reach}",
            f"the joint will keep {allowed}; write that, or check reference and direction",
        )
    return allowed


def many_turns(protocol: float, reference: float, direction: int) -> Interval:
    """Return the reach of a continuous joint, rad: how far its goal positions go."""
    turns = 2 * math.pi * MANY_TURNS[protocol]
    middle = -direction * reference
    return Interval(middle - turns, middle + turns)


def servo_travel(table: ControlTable) -> Interval:
    """Return the angles that a servo's goal positions reach, rad from raw 0.

    From 0 on in Protocol 1.0 and on X and MX, to both sides of 0 on P, PRO and Y (e-Manual, Goal Position).
    """
    return Interval(table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick)


def joint_reach(travel: Interval, reference: float, direction: int) -> Interval:
    """Return the reach of a joint, rad, of a servo that turns within `travel`, rad from raw 0.

    q = direction * (theta - reference), theta in `travel` (thesis of M. Amarante Araujo, 2017, JointID).
    """
    ends = (direction * (travel.lower - reference), direction * (travel.upper - reference))
    return Interval(min(ends), max(ends))


def check_twins(description: Description, tables: dict[str, ControlTable], problems: Problems) -> None:
    """Warn of each pair of joints that are not mirror images of each other.

    Mirrored, the right servo counts from the other end and turns the other way:
    reference_right = lowest + highest angle of the servo - reference_left, direction_right = -direction_left.
    """
    joints = description.robot.joints
    for name, left in joints.items():
        twin = name.replace("left", "right", 1)
        right = joints.get(twin)
        if twin == name or right is None or left.model != right.model or name not in tables:
            continue
        travel = servo_travel(tables[name])
        expected = travel.lower + travel.upper - left.reference
        if abs(expected - right.reference) > _SAME:
            problems.warning(
                description.marks.value("joints", twin, "reference"),
                f"{twin} is not a mirror image of {name}: its reference is {degrees(right.reference)} deg, "
                f"mirrored it would be {degrees(expected)} deg",
                "correct one of the two references, or ignore this if the body is not symmetric there",
            )
        if right.direction == left.direction:
            problems.warning(
                description.marks.value("joints", twin, "direction"),
                f"{twin} is not a mirror image of {name}: both have direction {left.direction:+d}",
                f"write direction: {-left.direction:+d}, or ignore this if the body is not symmetric there",
            )
