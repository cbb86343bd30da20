"""Joints of the robot file against buses, models and reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dxlrun.compile.checks.problems import Problems, suggestion
from dxlrun.compile.joint.reach import Interval, degrees, joint_reach, many_turns, servo_travel
from dxlrun.compile.joint.registers import compile_registers
from dxlrun.control.loop_plan import JointPlan
from dxlrun.description import Description
from dxlrun.description.robot import Joint
from dxlrun.description.units import EffortUnit
from dxlrun.dynamixel.control_table import ControlTable, control_table, perhaps_meant, protocols_of
from dxlrun.dynamixel.plan.bus_plan import RegisterValue
from dxlrun.dynamixel.plan.mode_plan import mode_plans

_UNITS: Mapping[EffortUnit, str] = {"Nm": "Nm", "A": "A", "1": "% of its highest load"}
_EXAMPLES: Mapping[EffortUnit, str] = {"Nm": "0.3 Nm", "A": "800 mA", "1": "40 %"}
AUTO = "auto"
"""Instead of a model: the servo is asked."""
_HIGHEST_ID_OF_PROTOCOL_2 = 252
"""0xFD stands in the header of each packet (e-Manual, Protocol 2.0, Packet ID)."""
_USUAL = {1.0: "AX-12A", 2.0: "XM430-W350"}
"""What stands in for a model that is not known, by protocol."""


@dataclass(frozen=True, slots=True)
class CompiledJoint:
    """A joint that stands on a known bus and a known model."""

    plan: JointPlan
    described: Joint
    table: ControlTable
    reach: Interval
    """rad, in the joint's coordinate"""
    registers: tuple[RegisterValue, ...] = ()
    """What is declared of its servo's memory, in the order in which it is written."""


def compile_joints(
    description: Description, problems: Problems, models: Mapping[str, str]
) -> dict[str, CompiledJoint]:
    """Return the joints that could be compiled, by name, in the order of the file.

    `models`: what the servos of joints with `model: auto` said that they are.
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
        # of a servo that is still to be asked for its model nobody knows which registers it has: what fits
        # the assumed one is taken, for a simulated servo is that one; without its bus' protocol neither
        certain = (joint.model != AUTO or name in models) and (known_bus or _one_table(model))
        told = problems if certain else Problems()
        effort = _effort(description, name, joint, table, told)
        registers = compile_registers(description, name, joint, table, told)
        if known_bus and allowed is not None:
            plan = JointPlan(
                name,
                allowed.lower,
                allowed.upper,
                joint.limits.velocity,
                effort,
                joint.continuous,
                bounded=not joint.continuous or joint.limits.position is not None,
                top_speed=table.top_speed or None,
                top_effort=_top_effort(table, continuous=joint.continuous),
            )
            compiled[name] = CompiledJoint(plan, joint, table, reach, registers)
    return compiled


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
                f"servo ID {joint.id} of {name} is none of Protocol 2.0",
                f"give it one from 0 to {_HIGHEST_ID_OF_PROTOCOL_2}",
            )
        return True
    problems.error(
        description.marks.value("joints", name, "bus"),
        f"{name} stands on bus {joint.bus}, which the file does not have",
        suggestion(joint.bus, tuple(buses)),
    )
    return False


def _assumed_model(description: Description, name: str, joint: Joint, problems: Problems) -> str:
    """Return what a servo that cannot be asked now may be: like its neighbours, else the usual one."""
    robot = description.robot
    neighbours = [each.model for each in robot.joints.values() if each.bus == joint.bus]
    known = [model for model in neighbours if model != AUTO]
    bus = robot.buses.get(joint.bus)
    model = known[0] if known else _USUAL[1.0 if bus is None else bus.protocol]
    problems.warning(
        description.marks.value("joints", name, "model"),
        f"the servo of {name} is asked for its model at the start; until then it is taken for an {model}",
        "write its model to have reach and time checked for certain",
    )
    return model


def _table(
    description: Description, name: str, joint: Joint, model: str, problems: Problems
) -> ControlTable | None:
    mark = description.marks.value("joints", name, "model")
    bus = description.robot.buses.get(joint.bus)
    wanted = None if bus is None else bus.protocol
    try:
        return control_table(model, wanted)
    except LookupError:
        spoken = protocols_of(model)
    if not spoken:
        problems.error(mark, f"no control table for model {model} of {name}", perhaps_meant(model, wanted))
        return None
    if bus is not None:
        problems.error(
            mark,
            f"{model} of {name} speaks Protocol {spoken[0]}, bus {joint.bus} Protocol {bus.protocol}",
            "put it on a bus of its own protocol; a bus cannot be mixed",
        )
    return control_table(model, spoken[0])


def _one_table(model: str) -> bool:
    """Say whether a model speaks one protocol alone; MX servos carry one name with two firmwares."""
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
    wanted = Interval(*limits)
    allowed = wanted.meet(reach)
    if allowed is None:
        problems.error(
            mark,
            f"limits {wanted} of {name} have nothing in common with the reach of its {model}, {reach}",
            "check limits, reference and direction",
        )
    elif not reach.contains(wanted):
        problems.warning(
            mark,
            f"limits {wanted} of {name} go beyond the reach of its {model}, {reach}",
            f"the joint will keep {allowed}; write that, or check reference and direction",
        )
    return allowed
