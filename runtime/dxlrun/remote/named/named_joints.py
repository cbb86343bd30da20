"""Joints: lookup of joints, groups and registers named in requests, and the states of joints in replies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from dxlrun.channels.answers import Code, Field
from dxlrun.channels.cycle import CycleRecord, Torque
from dxlrun.channels.loop_requests import Register, RegisterReading
from dxlrun.compile.joints.compiled_servos import SettingsStage
from dxlrun.compile.joints.register_values import UnfitRegister
from dxlrun.description.joints.groups import ALL
from dxlrun.dynamixel.servo.registers import meaning
from dxlrun.errors import suggestion
from dxlrun.features import stages
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.live.states import RobotStates
from dxlrun.remote.preparation import refused
from dxlrun.remote.requests.replies import JointServo
from dxlwire.bus_plan import ServoPlan
from dxlwire.control_table import ControlTable, find_table
from dxlwire.modes import Mode

_LONGEST = 80
"""Upper limit of a client's name quoted in a refusal, characters; longer names are cut."""
_MOST_NAMES = 5
"""Upper limit of the unknown names that a refusal lists."""


def states_of(plan: Plan, record: CycleRecord, controllers: Mapping[str, int]) -> RobotStates:
    """Return the states in a cycle's record; `controllers` maps each name to its index in the record's
    arrays.
    """
    layout, states = record.layout, record.states
    row = np.frombuffer(record.raw, layout.dtype)[0]
    known = row.dtype.names or ()
    fields = zip(RobotStates.__struct_fields__, RobotStates.__struct_encode_fields__, strict=True)
    arrays = {field: row[name] for field, name in fields if name in known}
    efforts = effort_units(plan)
    timed = {name: place for name, place in controllers.items() if place < len(record.controller_ns)}
    special: dict[str, Any] = {
        "cycle": record.cycle,
        "mode": tuple(Mode(mode).name.lower() for mode in states.mode.tolist()),
        "torque": tuple(Torque(torque).word for torque in states.torque.tolist()),
        "controller_ns": record.controller_ns[[*timed.values()]],
    }
    return RobotStates(
        **arrays | special,
        time_ns=record.woken_ns,
        late_ns=record.woken_ns - record.scheduled_ns,
        joints=layout.joints,
        units=tuple(joint.unit.si for joint in plan.loop.joints),
        effort_units=tuple(efforts.get(name, "") for name in layout.joints),
        references=layout.references,
        source_states=layout.source_states,
        source_commands=layout.source_commands,
        sources=layout.sources,
        controllers=tuple(timed),
        source_units=plan.loop.source_units,
        command_units=plan.loop.command_units,
    )


def joint_row(plan: Plan, joint: str, others: Sequence[str] = ()) -> int:
    """Return a joint's index in the loop's arrays.

    Raises RefusedRequest, hinting at similar joints or `others`.
    """
    require_installed(plan, [joint])
    names = [one.name for one in plan.loop.joints]
    if joint not in names:
        hint = suggestion(joint[:_LONGEST], (*names, *others))
        raise refused(Code.UNKNOWN_JOINT, {"joint": joint[:_LONGEST], "hint": hint})
    return names.index(joint)


def require_installed(plan: Plan, names: Iterable[str]) -> None:
    """Raise RefusedRequest when one of the names is that of a joint or group that the run omits."""
    if plan.omitted and (gone := {*names}.intersection(plan.omitted)):
        raise refused(Code.OMITTED, {"joint": tuple(sorted(gone))})


def names_in(body: bytes) -> Iterator[str]:
    """Yield the keys of a JSON body, and the names in its lists `joints`; nothing if it is malformed."""
    try:
        left = [msgspec.json.decode(body)]
    except (msgspec.MsgspecError, RecursionError):
        # Refused later, as any other malformed command.
        return
    while left:
        value = left.pop()
        if isinstance(value, dict):
            yield from value
            joints = value.get("joints")
            yield from (name for name in joints if isinstance(name, str)) if isinstance(joints, list) else ()
            left += value.values()


def effort_units(plan: Plan) -> dict[str, str]:
    """Return the effort unit of each joint (`Nm`, `N`, `A`); empty for a fraction of the servo's maximum."""
    return {
        joint: servo.unit.effort_unit(find_table(servo.model, bus.protocol).effort_unit).replace("1", "")
        for joint, servos in plan.servos_by_joint.items()
        for bus, servo in servos[:1]
    }


def joint_servos(plan: Plan) -> dict[str, JointServo]:
    """Return the first servo of each joint; its temperature limit is unknown if other servos help it."""
    models = {joint.name: joint.servo_model for joint in plan.loop.joints}
    return {
        joint: JointServo(servo.model, bus.protocol, model.temperature_limit if model else None)
        for joint, servos in plan.servos_by_joint.items()
        for bus, servo in servos[:1]
        for model in (models.get(joint),)
    }


def position_unit(plan: Plan, joint: str) -> str:
    """Return the unit of a joint's positions, `rad` or `m`; raises RefusedRequest for an unknown joint."""
    return plan.loop.joints[joint_row(plan, joint)].unit.si


def named_joints(plan: Plan, controllers: Iterable[ControllerPlan], names: Sequence[str]) -> tuple[str, ...]:
    """Return the joints that are meant by names of joints, groups, controllers (their joints) or `all`, each
    once.

    Raises RefusedRequest for an unknown name, or no name.
    """
    require_installed(plan, names)
    joints = tuple(one.name for one in plan.loop.joints)
    groups = {one.name: one.joints for one in controllers if one.command} | plan.groups | {ALL: joints}
    unknown = tuple(name[:_LONGEST] for name in names if name not in joints and name not in groups)
    unknown = unknown[:_MOST_NAMES]
    if unknown or not names:
        hint = (
            suggestion(unknown[0], (*joints, *groups))
            if unknown
            else "name joints, groups, controllers, or all"
        )
        raise refused(Code.UNKNOWN_JOINT, {"joint": unknown or "without a name", "hint": hint})
    return tuple(
        dict.fromkeys(joint for name in names for joint in ((name,) if name in joints else groups[name]))
    )


def require_reboots(plan: Plan, joints: tuple[str, ...]) -> None:
    """Raise RefusedRequest when a servo of these joints does not support the reboot instruction."""
    servos = plan.servos_by_joint
    cannot = [
        label
        for label, bus, servo in {
            servo.row: (bus.label(servo), bus, servo) for joint in joints for bus, servo in servos[joint]
        }.values()
        if "reboot" not in find_table(servo.model, bus.protocol).capabilities
    ]
    if cannot:
        names, verb = ", ".join(cannot), "has" if len(cannot) == 1 else "have"
        problem = f"{names} {verb} no reboot instruction; switch the torque or the power off and on"
        raise refused(Code.NOT_REBOOTED, {"joint": joints, "problem": problem})


# Registers


def prepared_register(plan: Plan, name: str, item: str, value: int | str) -> Register:
    """Return the loop's request to write a RAM item; raises RefusedRequest when it cannot be written.

    Args:
        plan: Plan of the run.
        name: Name of a joint (all its servos), or of one servo.
        item: Control table item.
        value: Integer on the wire, or a quantity with its unit.
    """
    servo, table, fields = _servo(plan, name, item)
    change = next(stage.change for _, stage in stages(SettingsStage, plan.features) if stage.change)
    try:
        register = change(table, item[:_LONGEST], value)
    except UnfitRegister as error:
        code = Code.INVALID_REGISTER if item in table.items else Code.UNKNOWN_REGISTER
        raise refused(code, fields | {"problem": str(error)}) from error
    # The value is not a quantity.
    except ValueError as error:
        problem = f"{item} of {name}: {error}"
        raise refused(Code.WRONG_QUANTITY, fields | {"problem": problem}) from error
    return Register(name, item, register.value, _row(plan, name, servo))


def prepared_reading(plan: Plan, name: str, item: str) -> RegisterReading:
    """Return the loop's request to read an item of a joint's servo; raises RefusedRequest for an unknown
    name.
    """
    servo, table, fields = _servo(plan, name, item)
    if item not in table.items:
        hint = suggestion(
            item[:_LONGEST], table.items, f"list the registers by `dxlrun models {table.model}`"
        )
        problem = f"an {table.model} has no register {item[:_LONGEST]}"
        raise refused(Code.UNKNOWN_REGISTER, fields | {"problem": problem, "hint": hint})
    return RegisterReading(name, item, _row(plan, name, servo))


def read_register(plan: Plan, name: str, item: str, value: int | None) -> Mapping[str, object]:
    """Return the reply for an item that was read: title, area, integer on the wire, and the same with its
    unit.
    """
    _, table, _ = _servo(plan, name, item)
    entry = table.items[item]
    shown = "" if value is None else meaning(entry, value, table.errors)
    return {"joint": name, "item": item, "title": entry.title, "area": entry.area} | {
        "value": value,
        "is": shown,
    }


def _row(plan: Plan, name: str, servo: ServoPlan) -> int | None:
    """Return the index by which the loop addresses one servo of a joint with several; None addresses all of
    them.
    """
    own = plan.mechanics.coupled and name == servo.own_name
    return len(plan.loop.joints) + servo.row if own else None


def _servo(plan: Plan, name: str, item: str) -> tuple[ServoPlan, ControlTable, dict[str, Field]]:
    """Return the named servo or the first servo of a joint, its control table, and fields for a refusal.

    Raises RefusedRequest, also for a joint whose servos have different models: their control tables differ.
    """
    require_installed(plan, [name.partition("/")[0]])
    fields: dict[str, Field] = {"joint": name[:_LONGEST], "item": item[:_LONGEST]}
    joints = plan.servos_by_joint
    known = {servo.own_name: (bus, servo) for servos in joints.values() for bus, servo in servos}
    mine = [known[name]] if name in known else [*joints.get(name, ())]
    if not mine:
        hint = (
            f"{name} is not a servo; print its states by `dxlrun get {name}`"
            if name in plan.loop.source_states
            else suggestion(name[:_LONGEST], tuple(known))
        )
        raise refused(Code.UNKNOWN_JOINT, fields | {"hint": hint})
    bus, servo = mine[0]
    models = dict.fromkeys(each.model for _, each in mine)
    if len(models) > 1:
        names = ", ".join(each.own_name for _, each in mine)
        problem = f"{name} has servos of several models ({', '.join(models)}); name one of them: {names}"
        raise refused(Code.INVALID, {"problem": problem})
    return servo, find_table(servo.model, bus.protocol), fields
