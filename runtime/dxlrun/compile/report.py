"""What `dxlrun check` shows of a compiled robot: rows in plain numbers, ready for a table or for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from dxlrun.compile.graph import ControllerGraph, GraphEdge
from dxlrun.compile.joints.joints import CompiledJoint
from dxlrun.compile.joints.servos import CompiledServo
from dxlrun.plan.bus_plan import BusPlan, DevicePlan, ServoPlan
from dxlrun.plan.loop_plan import ControllerPlan, LoopPlan, SensorPlan
from dxlrun.plan.policy_plan import POLICIES, PolicyPlan
from dxlrun.plan.robot_plan import MotionPart, Plan

Source = Literal["file", "servo", "none"]
"""Where a limit is from."""


@dataclass(frozen=True, slots=True)
class ServoRow:
    """One servo and what moves it; angles in rad from its raw 0."""

    joint: str
    """What it moves: a joint, or its place in a transmission."""
    bus: str
    id: int
    model: str
    reference: float
    direction: int
    ratio: float
    """What the joint, or the transmission's input, moves while it turns by 1 rad: rad or m."""
    linear: bool
    lower_tick: int
    """Of the range that the limits of its joints leave it, ticks."""
    upper_tick: int
    lower: float
    upper: float
    motor: str | None = None
    """Its motor file, as the robot file names it; None: it names none."""


@dataclass(frozen=True, slots=True)
class JointRow:
    """One joint; angles in rad, in the joint's own coordinate but for `reference` (servo's, from raw 0)."""

    name: str
    bus: str
    """Of its first servo, as all up to `direction`, and `motor`."""
    id: int
    model: str
    reference: float
    direction: int
    lower: float
    """The limit that the gate keeps: the file's, cut to the reach."""
    upper: float
    position_source: Source
    """`servo`: the reach of the servo; `none`: a wheel."""
    velocity: float | None
    """rad/s; None: not known."""
    velocity_source: Source
    """`servo`: its top speed, as the control table's data have it."""
    acceleration: float | None
    """rad/s^2; None: no limit in the file."""
    effort: float | None
    """In `effort_unit`; None: the servo follows none."""
    effort_source: Source
    """`servo`: its highest goal."""
    effort_unit: str
    """As the model measures effort: Nm, A, or empty for the fraction of its maximum."""
    reach_lower: float
    reach_upper: float
    bounded: bool
    """False: a wheel, which turns for ever."""
    mode: str
    """In which the run begins; `, limp`: without torque."""
    motor: str | None = None
    """Its motor file, as the robot file names it; None: it names none."""
    linear: bool = False
    """True: its positions are m, its speeds m/s."""
    servos: tuple[ServoRow, ...] = ()
    """Those that move it, alone or with other joints."""


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """One device on a bus."""

    name: str
    bus: str
    id: int
    model: str
    states: tuple[str, ...]
    commands: tuple[str, ...]
    reads: tuple[str, ...]
    """Addresses that are read each cycle: `128..133`."""


@dataclass(frozen=True, slots=True)
class SensorRow:
    """One sensor with a process of its own; `rate` in Hz, `timeout` in s."""

    name: str
    type: str
    distribution: str
    rate: float
    timeout: float
    """Age at which its values are no longer valid."""
    on_lost: str
    """What becomes of the run then."""
    states: tuple[str, ...]
    links: tuple[str, ...]
    """Of the URDF, whose simulated motion it senses."""


@dataclass(frozen=True, slots=True)
class ControllerRow:
    """One controller; `rate` in Hz."""

    name: str
    type: str
    distribution: str
    joints: tuple[str, ...]
    command: tuple[str, ...]
    active: bool
    rate: float
    into: tuple[str, ...] = ()
    """The controllers whose references it commands; empty: it commands the servos."""
    reference: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BusRow:
    """What one cycle costs on one bus; times in s (protocol.md, Time budget)."""

    name: str
    port: str
    baud_rate: int
    servos: int
    devices: int
    read_by: str
    """The e-Manual's names of the instructions: `fast sync read + read`."""
    request_bytes: int
    reply_bytes: int
    wire: float
    return_delay: float
    latency: float
    total: float
    highest_rate: float
    """Hz"""
    share: float
    """Of the loop's period; 1 = all of it."""


@dataclass(frozen=True, slots=True)
class PolicyRow:
    """What happens when something does not go on as planned."""

    name: str
    does: str
    """Its steps and how the robot is left; or which joints are held while the run continues."""
    longest: float
    """s, that the steps take at the most"""
    without_loop: str
    """What of it is left when the loop is gone: what the guardian does."""


@dataclass(frozen=True, slots=True)
class MotionRow:
    """One part of a motion file; times in s since the loop's first deadline."""

    file: str
    controller: str
    start: float
    end: float
    commands: int
    points: int


@dataclass(frozen=True, slots=True)
class GraphNode:
    """A joint, a device, a sensor or a controller; their rows have more of it."""

    name: str
    kind: Literal["joint", "device", "sensor", "controller"]


@dataclass(frozen=True, slots=True)
class GraphRows:
    """The controller graph."""

    order: tuple[str, ...]
    """Controllers in the order of their updates."""
    nodes: tuple[GraphNode, ...]
    edges: tuple[GraphEdge, ...]


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Everything that was decided for a robot before a port opens."""

    robot: str
    rate: float
    """Hz"""
    joints: tuple[JointRow, ...]
    groups: dict[str, tuple[str, ...]]
    """The joints of each."""
    devices: tuple[DeviceRow, ...]
    sensors: tuple[SensorRow, ...]
    controllers: tuple[ControllerRow, ...]
    buses: tuple[BusRow, ...]
    policies: tuple[PolicyRow, ...]
    motions: tuple[MotionRow, ...]
    graph: GraphRows
    duration: float | None
    """s; None: the run continues until it is stopped."""


def check_report(
    plan: Plan, rate: float, joints: Sequence[CompiledJoint], parts: Sequence[MotionPart]
) -> CheckReport:
    """Return what was decided for a robot whose loop has a `rate`, Hz, in rows."""
    loop, buses = plan.loop, plan.buses
    graph = graph_of(loop)
    servos = {servo.own_name: servo for bus in buses for servo in bus.servos}
    return CheckReport(
        robot=plan.robot,
        rate=rate,
        joints=tuple(_joint_row(joint, servos) for joint in joints),
        groups=plan.groups,
        devices=tuple(_device_row(bus, device) for bus in buses for device in bus.devices),
        sensors=tuple(_sensor_row(sensor) for sensor in loop.sensors),
        controllers=tuple(_controller_row(controller, rate) for controller in loop.controllers),
        buses=tuple(_bus_row(bus, rate) for bus in buses),
        policies=_policy_rows(loop.policies, buses),
        motions=tuple(_motion_row(part) for part in parts),
        graph=_graph_rows(graph),
        duration=None if loop.end_ns is None else loop.end_ns * 1e-9,
    )


def graph_of(loop: LoopPlan) -> ControllerGraph:
    """Return the controller graph of a plan, which was found valid when the plan was made."""
    return ControllerGraph([joint.name for joint in loop.joints], loop.controllers, loop.sources)


def _graph_rows(graph: ControllerGraph) -> GraphRows:
    return GraphRows(
        order=graph.order,
        nodes=(
            *(GraphNode(name, "joint") for name in graph.joints),
            *(GraphNode(one.name, one.kind) for one in graph.sources),
            *(GraphNode(plan.name, "controller") for plan in graph.controllers),
        ),
        edges=graph.edges,
    )


def _joint_row(joint: CompiledJoint, servos: Mapping[str, ServoPlan]) -> JointRow:
    described, unit = joint.described, joint.table.effort_unit
    first = joint.servos[0].described
    own = [servos[servo.described.name] for servo in joint.servos]
    return JointRow(
        name=joint.plan.name,
        bus=first.bus,
        id=first.id,
        model=first.model,
        reference=first.reference,
        direction=first.direction,
        lower=joint.plan.lower,
        upper=joint.plan.upper,
        position_source=_source(described.limits.position, joint.plan.bounded),
        velocity=joint.plan.velocity,
        velocity_source=_source(described.limits.velocity, joint.plan.velocity is not None),
        acceleration=joint.plan.acceleration,
        effort=None if math.isinf(joint.plan.highest_effort) else joint.plan.highest_effort,
        effort_source=_source(described.limits.effort, joint.plan.top_effort is not None),
        effort_unit="N" if unit == "Nm" and joint.plan.linear else unit.replace("1", ""),
        reach_lower=joint.reach.lower,
        reach_upper=joint.reach.upper,
        bounded=joint.plan.bounded,
        mode=own[0].start_mode.name.lower().replace("_", " ") + ("" if described.torque else ", limp"),
        motor=first.motor,
        linear=joint.plan.linear,
        servos=tuple(_servo_row(one, plan) for one, plan in zip(joint.servos, own, strict=True)),
    )


def _servo_row(servo: CompiledServo, plan: ServoPlan) -> ServoRow:
    described = servo.described
    ticks = plan.lower_tick, plan.upper_tick
    return ServoRow(
        joint=described.title,
        bus=described.bus,
        id=described.id,
        model=described.model,
        reference=described.reference,
        direction=described.direction,
        ratio=described.ratio,
        linear=described.linear,
        lower_tick=ticks[0],
        upper_tick=ticks[1],
        lower=ticks[0] * plan.rad_per_tick,
        upper=ticks[1] * plan.rad_per_tick,
        motor=described.motor,
    )


def _sensor_row(sensor: SensorPlan) -> SensorRow:
    return SensorRow(
        name=sensor.name,
        type=sensor.type,
        distribution=sensor.distribution,
        rate=1e9 / sensor.period_ns,
        timeout=sensor.timeout_ns * 1e-9,
        on_lost=sensor.on_lost,
        states=sensor.states,
        links=sensor.links,
    )


def _device_row(bus: BusPlan, device: DevicePlan) -> DeviceRow:
    fields = [field for block in device.blocks for field in block.fields]
    return DeviceRow(
        name=device.name,
        bus=bus.name,
        id=device.servo_id,
        model=device.model,
        states=tuple(field.state for field in sorted(fields, key=lambda field: field.column)),
        commands=tuple(command.name for command in device.commands),
        reads=tuple(f"{block.address}..{block.address + block.length - 1}" for block in device.blocks),
    )


def _source(written: object, servo: bool) -> Source:
    return "file" if written is not None else "servo" if servo else "none"


def _controller_row(plan: ControllerPlan, rate: float) -> ControllerRow:
    return ControllerRow(
        name=plan.name,
        type=plan.type,
        distribution=plan.distribution,
        joints=plan.joints,
        command=plan.command,
        active=plan.active,
        rate=rate / plan.every,
        into=plan.into,
        reference=plan.reference,
        reads=plan.reads,
    )


def _bus_row(bus: BusPlan, rate: float) -> BusRow:
    budget = bus.budget
    return BusRow(
        name=bus.name,
        port=bus.port,
        baud_rate=bus.baud_rate,
        servos=len(bus.servos),
        devices=len(bus.devices),
        read_by=bus.read_by,
        request_bytes=budget.request_bytes,
        reply_bytes=budget.reply_bytes,
        wire=budget.wire_ns * 1e-9,
        return_delay=budget.return_delay_ns * 1e-9,
        latency=budget.latency_ns * 1e-9,
        total=budget.total_ns * 1e-9,
        highest_rate=budget.highest_rate_hz,
        share=budget.total_ns * 1e-9 * rate,
    )


_HELD = {
    "on_lost_servo": "hold its controllers until it answers, the others go on",
    "on_stale_command": "hold its joints until the next command",
}


_GROUP_ACTIONS = {
    "hold": "hold their controllers until it answers, the others go on",
    "limp": "no torque for the group any more, the others go on",
    "stop": "end the run by on_fault",
}


def _policy_rows(policies: PolicyPlan, buses: Sequence[BusPlan]) -> tuple[PolicyRow, ...]:
    rows = []
    for name in POLICIES:
        policy = policies.named(name)
        going_on = _HELD.get(name, policy.text) if policy.goes_on else policy.text
        alone = policies.on_fault.last
        rows.append(PolicyRow(name, going_on, policy.longest_ns * 1e-9, alone))
    for group in policies.groups:
        does = _GROUP_ACTIONS[group.on_lost_servo]
        rows.append(PolicyRow(f"on_lost_servo of {group.name}", does, 0.0, policies.on_fault.last))
    rows.append(PolicyRow("on_returned_servo", _on_returned_servo(buses), 0.0, policies.on_fault.last))
    return tuple(rows)


def _on_returned_servo(buses: Sequence[BusPlan]) -> str:
    """Return which servos get torque after a reboot."""
    servos = [servo for bus in buses for servo in bus.servos]
    held = [servo.joint for servo in servos if servo.torque_on_return]
    if len(held) in {0, len(servos)}:
        return "hold where it stands" if held else "limp"
    return f"hold {', '.join(held)} where they stand, the others limp"


def _motion_row(part: MotionPart) -> MotionRow:
    return MotionRow(
        file=part.file,
        controller=part.controller,
        start=part.start_ns * 1e-9,
        end=part.end_ns * 1e-9,
        commands=len(part.commands),
        points=part.points,
    )
