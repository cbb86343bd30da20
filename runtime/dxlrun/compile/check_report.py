"""Report: the results of a compilation as rows, for `dxlrun check` as JSON and as tables.

Angles in rad, those of servos from their raw 0; lengths in m, times in s, rates in Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import msgspec

from dxlrun.compile.controller_graph import ControllerGraph
from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.compiled_servos import CompiledServo
from dxlrun.compile.joints.described_servos import DescribedServo
from dxlrun.description.joints.joint_forms import joint_keys, units_of_key
from dxlrun.description.joints.joint_mechanics import Limits
from dxlrun.features import stages
from dxlrun.features.feature import JointKey, SolvedPose
from dxlrun.output.text_table import Table
from dxlrun.plan.loop_plan import JOINT_PROPERTIES, ControllerPlan, JointPlan, JointProperty, LoopPlan
from dxlrun.plan.robot_plan import MotionPart, Plan
from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.joint_unit import LINEAR, ROTARY

Source = Literal["file", "servo", "none"]
"""Origin of a limit: the file, the servo's own range or speed, or none."""
Row = dict[str, Any]  # JSON object of one row


class TableStage(msgspec.Struct, frozen=True):
    """Hook `STAGE` in a feature's `table.py`: the feature's rows and table in `dxlrun check`."""

    FILE: ClassVar[str] = "table"

    rows: Callable[[Plan], Iterable[Row]]
    """Returns the feature's rows for a plan; in JSON they are under the feature's name."""
    table: Callable[[Sequence[Row]], Table]
    """Returns a printable table of these rows."""


def check_report(
    plan: Plan,
    rate: float,
    joints: Sequence[CompiledJoint],
    parts: Sequence[MotionPart],
    policies: Mapping[str, str],
) -> Row:
    """Return everything that `dxlrun check --json` prints about a compiled robot."""
    loop, buses = plan.loop, plan.buses
    servos = {servo.own_name: servo for bus in buses for servo in bus.servos}
    return {
        "robot": plan.robot,
        "rate": rate,
        "joints": [_joint(joint, servos) for joint in joints],
        "groups": plan.groups,
        "omitted": plan.omitted,
        "poses": [_pose(name, pose, loop) for name, pose in plan.poses.items() if pose.positions],
        **{feature.name: [*stage.rows(plan)] for feature, stage in stages(TableStage, plan.features)},
        "controllers": [_controller(controller, rate) for controller in loop.controllers],
        "buses": [_bus(bus, rate) for bus in buses],
        "policies": policy_rows(plan, policies),
        "motions": [_motion(part) for part in parts],
        "graph": _graph(graph_of(loop)),
        "duration": None if loop.end_ns is None else loop.end_ns * 1e-9,
    }


def graph_of(loop: LoopPlan) -> ControllerGraph:
    """Return the controller graph of a plan without checking it again."""
    return ControllerGraph([joint.name for joint in loop.joints], loop.controllers, loop.sources)


def _graph(graph: ControllerGraph) -> Row:
    nodes = [(name, "joint") for name in graph.joints]
    nodes += [(one.name, one.kind) for one in graph.sources]
    nodes += [(one.name, "controller") for one in graph.controllers]
    named = [{"name": name, "kind": kind} for name, kind in nodes]
    return {"order": graph.order, "nodes": named, "edges": graph.edges}


def _source(written: object, servo: bool) -> Source:
    return "file" if written is not None else "servo" if servo else "none"


def _joint(joint: CompiledJoint, servos: Mapping[str, ServoPlan]) -> Row:
    plan, first, limits = joint.plan, joint.servos[0].described, joint.described.limits
    servo, unit = servos[first.name], joint.table.effort_unit
    mode = ("extended " if servo.extended else "") + servo.start_mode.name
    return {
        "name": plan.name,
        **_described(first),
        "lower": plan.lower,
        "upper": plan.upper,
        "position_source": _source(limits.position, plan.bounded),
        **_properties(plan, limits),
        "effort": None if math.isinf(plan.highest_effort) else plan.highest_effort,
        "effort_source": _source(limits.effort, plan.top_effort is not None),
        "effort_unit": plan.unit.effort_unit(unit).replace("1", ""),
        "reach_lower": joint.position_range.lower,
        "reach_upper": joint.position_range.upper,
        "bounded": plan.bounded,
        "mode": mode.lower().replace("_", " ") + ("" if joint.described.torque else ", limp"),
        "linear": plan.unit is LINEAR,
        "servos": [_servo(servo, servos[servo.described.name]) for servo in joint.servos],
    }


def _properties(plan: JointPlan, limits: Limits) -> Row:
    """Return a joint's numeric properties (such as speed limits) and, for limits, where they come from."""
    row: Row = {}
    for one in shown_properties():
        row[one.name] = value = one.value(plan)
        if one.limit:
            row[f"{one.name}_source"] = _source(getattr(limits, one.name), value is not None)
    return row


def shown_properties() -> list[JointProperty]:
    """Return the joint properties that have a column in the table; those of features come last."""
    own = [one for one in JOINT_PROPERTIES if one.column is not None]
    return own + [_property_of(key) for key in joint_keys()]


def _property_of(key: JointKey[object]) -> JointProperty:
    units = units_of_key(key)
    _, of_positions, suffix = units.get(ROTARY, "").partition(ROTARY.si)
    return JointProperty(
        key.name,
        lambda joint: joint.keys.get(key.name),
        column=suffix,
        text=None if of_positions else lambda value, unit: f"{value} {units.get(unit, '')}".rstrip(),
    )


def _servo(servo: CompiledServo, plan: ServoPlan) -> Row:
    described = servo.described
    return {
        "joint": described.title,
        **_described(described),
        "reference": plan.reference,
        "ratio": described.ratio,
        "linear": described.unit is LINEAR,
        "lower_tick": plan.lower_tick,
        "upper_tick": plan.upper_tick,
        "lower": plan.lower_tick * plan.rad_per_tick,
        "upper": plan.upper_tick * plan.rad_per_tick,
    }


def _described(servo: DescribedServo) -> Row:
    return {name: getattr(servo, name) for name in ("bus", "id", "model", "reference", "direction", "motor")}


def _pose(name: str, pose: SolvedPose, loop: LoopPlan) -> Row:
    margins = [
        (min(at - joint.lower, joint.upper - at), joint.name, joint.unit is LINEAR)
        for joint in loop.joints
        if joint.bounded and (at := pose.positions.get(joint.name)) is not None
    ]
    margin, nearest, linear = min(margins, default=(None, "", False))
    return {
        "name": name,
        **msgspec.structs.asdict(pose),
        "margin": margin,
        "margin_joint": nearest,
        "linear": linear,
    }


def _controller(plan: ControllerPlan, rate: float) -> Row:
    return {
        "name": plan.name,
        "type": plan.type,
        "distribution": plan.distribution,
        "joints": plan.joints,
        "command": plan.command,
        "active": plan.active,
        "rate": rate / plan.every,
        "into": plan.into,
        "reference": plan.reference,
        "reads": plan.reads,
    }


def _bus(bus: BusPlan, rate: float) -> Row:
    budget = bus.budget
    return {
        "name": bus.name,
        "port": bus.port,
        "baud_rate": bus.baud_rate,
        "servos": len(bus.servos),
        "devices": len(bus.devices),
        "read_by": bus.read_by,
        "request_bytes": budget.request_bytes,
        "reply_bytes": budget.reply_bytes,
        "wire": budget.wire_ns * 1e-9,
        "return_delay": budget.return_delay_ns * 1e-9,
        "latency": budget.latency_ns * 1e-9,
        "total": budget.total_ns * 1e-9,
        "highest_rate": budget.highest_rate_hz,
        "share": budget.total_ns * 1e-9 * rate,
    }


def _motion(part: MotionPart) -> Row:
    return {
        "file": part.file,
        "controller": part.controller,
        "start": part.start_ns * 1e-9,
        "end": None if part.end_ns is None else part.end_ns * 1e-9,
        "commands": len(part.commands),
        "points": part.points,
    }


class PolicyRow(msgspec.Struct, frozen=True):
    """One row of the table of policies: what a policy does with the robot."""

    name: str
    does: str
    """The policy's steps and final state as text; or the joints that it holds while the run continues."""
    longest: float  # longest duration of the steps, s
    without_loop: str  # action taken by the guardian when the loop process has exited


def policy_rows(plan: Plan, shown: Mapping[str, str]) -> list[PolicyRow]:
    """Return one row per policy of a plan; `shown` are texts of policies that features carry out."""
    policies = plan.loop.policies.by_name
    found = {name: (policy.text, policy.longest_ns * 1e-9) for name, policy in policies.items()}
    found |= {
        name: (does, 0.0) for name, does in shown.items() if name not in policies or policies[name].goes_on
    }
    found["on_returned_servo"] = _on_returned_servo(plan.buses), 0.0
    alone = policies["on_fault"].last
    return [PolicyRow(name, does, longest, alone) for name, (does, longest) in found.items()]


def _on_returned_servo(buses: Sequence[BusPlan]) -> str:
    """Return as text which servos hold and which stay limp after they rebooted and returned."""
    servos = [servo for bus in buses for servo in bus.servos]
    held = [servo.joint for servo in servos if servo.torque_on_return]
    if len(held) in {0, len(servos)}:
        return "hold its position" if held else "limp"
    return f"hold {', '.join(held)}, other servos limp"
