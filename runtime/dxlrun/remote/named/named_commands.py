"""Commands by name: values for some joints or for a source, converted into a controller's own command.

A command of a standard controller has one number for each joint and interface (`positions`, `velocities`,
`efforts`, `pwm`), or is a trajectory. A trajectory that accepts `joints` names only the given joints. In all
other commands, the joints that are not named keep the newest goals that the gateway has when the request
arrives. A command that another client sends within the same few milliseconds may be overwritten. Values for a
source go to the controller that commands the source now.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import msgspec

from dxlrun.channels.answers import Code, Field
from dxlrun.channels.cycle import CycleRecord
from dxlrun.compile.motions import TRAJECTORY
from dxlrun.description.joints.groups import NO_GROUPS, Groups
from dxlrun.description.source_names import SOURCE_COMMANDS
from dxlrun.errors import suggestion
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, SourcePlan
from dxlrun.remote.preparation import (
    GROUP_FIELDS,
    ResolvedController,
    invalid,
    joint_quantities,
    plain_quantities,
    refused,
    travel_s,
)

POINT_SPEED = 0.5
"""Speed of a move of named joints without a duration, rad/s or m/s; slower joints use their highest speed."""
DURATION = "seconds"
"""Field of a command of any controller that has the duration of its motion, s."""
_SHORTEST_S = 0.1
INTERFACES = {**{name: name for name in GROUP_FIELDS}, **{each: name for name, each in GROUP_FIELDS.items()}}
"""Interface as a client writes it, singular or plural -> interface: `positions` -> `position`."""


@dataclass(frozen=True, slots=True)
class JointCommand:
    """A complete command of a controller, made from a client's values for some of its joints."""

    kind: str
    content: bytes
    """The command as JSON, in SI units."""


def joint_command(
    known: ResolvedController,
    kind: str,
    body: bytes,
    record: CycleRecord,
    *,
    units: bool,
    seconds: float | None,
    groups: Groups = NO_GROUPS,
) -> JointCommand | None:
    """Return a controller's command from values by joint name; None when the body does not name joints.

    Args:
        known: The controller.
        kind: Interface: `position` or `positions`.
        body: JSON with a value for each joint or group. A value for a joint takes precedence over one for a
            group that contains the joint.
        record: The newest cycle.
        units: The values are texts with units.
        seconds: Duration of a trajectory, s; None uses POINT_SPEED.
        groups: Names of groups of joints.

    Raises:
        RefusedRequest: The body names unknown joints, or its values are invalid.
    """
    plan, commands = known.plan, known.controller.Commands
    interface = INTERFACES.get(kind)
    if interface is None:
        return None
    try:
        given = msgspec.json.decode(body)
    except (msgspec.MsgspecError, RecursionError):
        # Refused later, as any other malformed command.
        return None
    named = given if isinstance(given, dict) and given else {}
    of_groups = {joint: named[name] for name in named if name in groups for joint in groups[name]}
    named = of_groups | {name: value for name, value in named.items() if name not in groups}
    strangers = [name for name in named if name not in plan.joints]
    if kind in commands and (strangers or not named):
        return None
    # Fields of a command: refused later, with the command's name.
    if strangers and set(named) <= set(GROUP_FIELDS.values()):
        return None
    if not named:
        raise invalid(f"{kind} of {plan.name} names no joint; write for example {plan.joints[0]}=20deg")
    if strangers:
        if strangers[0] in record.layout.joints:
            raise invalid(f"{plan.name} does not move {strangers[0]}; it moves {', '.join(plan.joints)}")
        fields: dict[str, Field] = {"joint": strangers[0][:80], "controller": plan.name}
        raise refused(Code.UNKNOWN_JOINT, fields | {"hint": suggestion(strangers[0][:80], plan.joints)})
    field = GROUP_FIELDS[interface]
    values = _numbers(known, kind, field, named, units)
    chosen, fields_of = _command_for(known, interface)
    if fields_of is None:
        partial = "joints" in commands[chosen].model_fields
        joints = [joint for joint in known.joints if joint.name in values or not partial]
        positions = _filled(joints, field, values, record)
        point = {"time": seconds or _duration(joints, positions, record), "positions": positions}
        named_too = {"joints": [joint.name for joint in joints]} if partial else {}
        return JointCommand(chosen, msgspec.json.encode({"points": [point], "start_in": 0.0} | named_too))
    if seconds is not None:
        raise invalid(f"{plan.name} moves its joints immediately; omit the time")
    # With a position, a velocity or an effort is an upper limit.
    still = "positions" not in fields_of
    content = {
        each: _filled(known.joints, each, values if each == field else {}, record, still=still)
        for each in fields_of
    }
    return JointCommand(chosen, msgspec.json.encode(content))


def timed_command(known: ResolvedController, kind: str, body: bytes, seconds: float) -> bytes:
    """Return a command as JSON with a duration, s, for the field `seconds` of the command.

    Raises RefusedRequest when the command has no such field, or has a value for it already.
    """
    model = known.controller.Commands.get(kind)
    if model is not None and DURATION in model.model_fields:
        try:
            given = msgspec.json.decode(body, type=dict[str, msgspec.Raw])
        except (msgspec.MsgspecError, RecursionError):
            # Refused later, as any other malformed command.
            return body
        if DURATION not in given:
            return msgspec.json.encode({**given, DURATION: seconds})
    raise invalid(f"{kind} of {known.plan.name} contains its own times; omit the duration")


def _numbers(
    known: ResolvedController, kind: str, field: str, named: Mapping[str, object], units: bool
) -> dict[str, float]:
    """Return the values by joint in SI units; raises RefusedRequest for one that is not a finite number."""
    si = plain_quantities(named, field, known.joints) if units else named
    for joint, value in si.items():
        # An integer of JSON may exceed the range of float.
        if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
            raise invalid(
                f"{kind} of {known.plan.name}: {joint} is {str(value)[:40]!r}, but must be a finite number; "
                "give it in SI units, or `units=True` for texts with units"
            )
    return {joint: float(value) for joint, value in si.items() if isinstance(value, int | float)}


def _command_for(known: ResolvedController, interface: str) -> tuple[str, tuple[str, ...] | None]:
    """Return a controller's command for an interface, and the command's fields; None as fields for a
    trajectory.

    Raises RefusedRequest when the controller has no such command.
    """
    field, commands = GROUP_FIELDS[interface], known.controller.Commands
    found: dict[str, tuple[str, ...]] = {}
    for kind, model in commands.items():
        fields = tuple(model.model_fields)
        if field in fields and set(fields) <= set(GROUP_FIELDS.values()):
            found[kind] = fields
    # Choose the command with the fewest fields, because the other fields need default values.
    if found:
        kind = min(found, key=lambda one: len(found[one]))
        return kind, found[kind]
    if interface == "position" and TRAJECTORY in commands:
        return TRAJECTORY, None
    offered = joint_quantities(commands)
    name = known.plan.name
    hint = (
        f"{name} accepts {', '.join(offered)} for each joint" if offered else suggestion(interface, commands)
    )
    fields_of: dict[str, Field] = {"controller": known.plan.name, "kind": interface, "known": tuple(commands)}
    raise refused(Code.UNKNOWN_COMMAND, fields_of | {"hint": hint})


def _filled(
    joints: Sequence[JointPlan],
    field: str,
    values: Mapping[str, float],
    record: CycleRecord,
    *,
    still: bool = True,
) -> list[float]:
    """Return one value for each joint: the value of the request, or else the joint's newest goal."""
    return [
        values[joint.name] if joint.name in values else _present(joint, field, record, still=still)
        for joint in joints
    ]


def _present(joint: JointPlan, field: str, record: CycleRecord, *, still: bool = True) -> float:
    """Return a joint's newest goal of a field, or a default when it has none.

    The default holds the joint: the present position, zero velocity, zero effort. With `still` False,
    velocity and effort are upper limits, so their defaults allow motion.
    """
    row = record.layout.joints.index(joint.name)
    goals, states = record.goals, record.states
    now, otherwise = {
        "positions": (goals.position, float(states.position[row])),
        "velocities": (goals.velocity, 0.0 if still else min(joint.highest_speed, POINT_SPEED)),
        "efforts": (goals.effort, 0.0 if still else joint.highest_effort),
        "pwm": (goals.pwm, 0.0),
    }[field]
    value = float(now[row])
    if not math.isfinite(value):
        value = otherwise
    if not math.isfinite(value):
        raise invalid(f"the {field} of {joint.name} are not known yet; add {joint.name} to the command")
    return value


def _duration(joints: Sequence[JointPlan], positions: Sequence[float], record: CycleRecord) -> float:
    """Return the time that the slowest joint needs to reach these positions, s; at least 0.1 s."""
    ways = (
        travel_s(
            joint,
            abs(position - _present(joint, "positions", record)),
            min(joint.highest_speed, POINT_SPEED),
        )
        for joint, position in zip(joints, positions, strict=True)
    )
    return max(_SHORTEST_S, *ways)


# Sources


def source_command(
    source: SourcePlan,
    body: bytes,
    controllers: Sequence[ControllerPlan],
    active: Callable[[ControllerPlan], bool],
    takes: Callable[[ControllerPlan], Mapping[str, object]],
) -> tuple[str, bytes]:
    """Return the controller that receives values for a source, and its command as JSON.

    `body` is JSON with a value for each command, `{"led": 1}`, SI units. Raises RefusedRequest.
    """
    try:
        given = msgspec.json.decode(body, type=dict[str, object])
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(f"{error}; write for example led=1") from error
    ranges = dict(zip(source.commands, source.ranges, strict=True))
    if not ranges:
        raise invalid(f"{source.label} has no commands; name items under its `commands` in the robot file")
    if not given:
        raise invalid(f"the request names no command of {source.label}; name one of {', '.join(ranges)}")
    for name, value in given.items():
        if name not in ranges:
            fields: dict[str, Field] = {
                "controller": source.name,
                "kind": name[:80],
                "known": source.commands,
            }
            raise refused(Code.UNKNOWN_COMMAND, fields | {"hint": suggestion(name[:80], source.commands)})
        lowest, highest = ranges[name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise invalid(f"{source.name}/{name} = {str(value)[:40]} is not a number")
        if not lowest <= value <= highest:
            problem = f"{value:g} is outside {lowest:g} to {highest:g}"
            raise refused(Code.BEYOND_LIMITS, {"controller": source.name, "kind": name, "problem": problem})
    values = {f"{source.name}/{name}": value for name, value in given.items()}
    chosen = {_commander(name, controllers, active, takes) for name in values}
    if len(chosen) > 1:
        by = ", ".join(sorted(chosen))
        raise invalid(f"{', '.join(values)} are commanded by {by}; send one command at a time")
    return chosen.pop(), msgspec.json.encode({"values": values})


def _commander(
    name: str,
    controllers: Sequence[ControllerPlan],
    active: Callable[[ControllerPlan], bool],
    takes: Callable[[ControllerPlan], Mapping[str, object]],
) -> str:
    """Return the active controller that commands this item of a source and accepts values from clients for
    it.

    Raises RefusedRequest when there is none.
    """
    claiming = [plan for plan in controllers if name in plan.source_commands]
    now = [plan for plan in claiming if active(plan)]
    if now and SOURCE_COMMANDS in takes(now[0]):
        return now[0].name
    able = [plan.name for plan in claiming if SOURCE_COMMANDS in takes(plan)]
    by = f"{now[0].name}, and clients cannot send values for it" if now else "no controller"
    fix = (
        f"`dxlrun switch --activate {able[0]}{f' --deactivate {now[0].name}' if now else ''}`"
        if able
        else "add to `controllers` in the robot file: "
        f"NAME: {{type: device_command_controller, commands: [{name}]}}"
    )
    raise invalid(f"{name} is commanded by {by}; {fix}")
