"""`dxlrun check ROBOT.yaml`: check a robot file without touching hardware."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import Assignment, Flag, JsonFlag, Motions, Seconds, compiled, read_models
from dxlrun.cli.tools.tool_log import BusesLog
from dxlrun.errors import InputError, counted
from dxlrun.output.json import problems_json
from dxlrun.output.table import Column, Table, Value, numbers
from dxlrun.output.terminal import print_error, print_warning, show, show_json

if TYPE_CHECKING:
    from dxlrun.compile import Compiled
    from dxlrun.compile.joints.joints import CompiledJoint
    from dxlrun.dynamixel.tools.inspection import Found, RegisterRow
    from dxlrun.plan.bus_plan import BusPlan
    from dxlrun.plan.loop_plan import LoopPlan, SensorPlan
    from dxlrun.plan.robot_plan import MotionPart, Plan

_OPTIONAL = Parameter(negative=(), show_default=False, consume_multiple=(0, 1))
"""An option with a value or without one."""


def check(
    robot: Path,
    /,
    *assignments: Assignment,
    play: Motions = (),
    duration: Seconds | None = None,
    online: Flag = False,
    graph: Annotated[tuple[Path, ...] | None, _OPTIONAL] = None,
    log: Path | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Check a robot file: joints, reach, controllers, claims, the time budget of each bus.

    Without --online no port is opened. Exit code 0, or 2 with every error as `file:line:column: what; how
    to fix it`; with --online 1 where a servo holds another register than the file declares, or is not ready.

    Parameters
    ----------
    robot
        The robot file.
    assignments
        Arguments of the robot file, for example port:=/dev/ttyUSB0.
    play
        Check this motion file too; may be given several times.
    duration
        As for a run: stop after this time, s.
    online
        Read the servos too, and compare their registers with those of the file; nothing is written.
    graph
        Draw the controllers, what they read and what they command: here, or into a file, .svg or .dot.
    log
        Write every packet of --online into this new file, a log.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    if log is not None and not online:
        raise InputError("--log keeps what --online sends and receives; give --online too")
    for file in graph or ():
        _require_picture(file)
    with BusesLog(log, f"dxlrun check {robot} --online") as packets:
        ask = partial(_asked, packets) if online else None
        result = compiled(robot, assignments, play, duration, ask)
        found = _look(result, packets) if online else None
    for file in graph or ():
        _write(result, file)
    if as_json:
        show_json(_as_json(result, found))
        return 0 if found is None or found.as_declared else 1
    if graph is None:
        show(_verdict(result), *_tables(result))
    else:
        show(_verdict(result), *(f"the controller graph is in {file}" for file in graph))
        if not graph:
            show(result.drawing)
    if found is not None:
        show(_registers(found.registers), _compared(found))
    for warning in result.warnings:
        print_warning(str(warning))
    if found is None:
        return 0
    for remark in found.remarks:
        print_warning(remark)
    for problem in found.problems:
        print_error(problem)
    return 0 if found.as_declared else 1


def _require_picture(file: Path) -> None:
    from dxlrun.output.graph_picture import kind_of  # not above: most checks draw nothing

    kind_of(file)


def _write(result: Compiled, file: Path) -> None:
    from dxlrun.output.graph_picture import write_picture  # as above

    write_picture(result.drawing, file)


def _asked(packets: BusesLog, buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    return read_models(buses, joints, packets.of(buses))


def _look(result: Compiled, packets: BusesLog) -> Found:
    """Read the servos on real ports; raises InputError where there are none."""
    from dxlrun.description.bus import SIMULATED
    from dxlrun.dynamixel.tools.inspection import look

    buses = [bus for bus in result.plan.buses if bus.port != SIMULATED]
    if not buses:
        raise InputError(
            f"every bus of {result.plan.robot} is simulated, so there are no servos to read; "
            "give it a port, such as port:=/dev/ttyUSB0"
        )
    return look(buses, packets.of(result.plan.buses))


def _as_json(result: Compiled, found: Found | None) -> dict[str, object]:
    from msgspec import to_builtins

    report = {"ok": True, "errors": [], "warnings": problems_json(result.warnings)}
    report |= to_builtins(result.report)
    if found is not None:
        report["online"] = {"as_declared": found.as_declared, **to_builtins(found)}
    return report


def _verdict(result: Compiled) -> str:
    """Return the result in one line."""
    loop, warnings = result.plan.loop, len(result.warnings)
    active = sum(controller.active for controller in loop.controllers)
    joints = counted(len(loop.joints), "joint", "joints")
    controllers = counted(len(loop.controllers), "controller", "controllers")
    return (
        f"{result.plan.robot}: good. {joints}, {active} of {controllers} active, {result.rate:g} Hz, "
        f"{warnings or 'no'} warning{'s' * (warnings != 1)}"
    )


def _tables(result: Compiled) -> Iterator[Table]:
    plan, joints = result.plan, result.joints
    yield _joints(result)
    if any(len(joint.servos) > 1 or joint.servos[0].described.ratio != 1.0 for joint in joints):
        yield _servos(result)
    if plan.groups:
        rows = tuple((name, ", ".join(joints)) for name, joints in plan.groups.items())
        yield Table.of("Groups", (Column("group", "name"), Column("joints", "text")), rows)
    if any(bus.devices for bus in plan.buses):
        yield _devices(plan.buses)
    if plan.loop.sensors:
        yield _sensors(plan.loop.sensors)
    yield _controllers(plan.loop, result.rate)
    yield _buses(plan.buses, result.rate)
    yield _policies(plan)
    yield _motions(result.parts, plan.loop.end_ns)


def _joints(result: Compiled) -> Table:
    from dxlrun.compile.joints.limits import degrees, number
    from dxlrun.compile.report import highest_effort, limit_sources, servo_plans, start_mode

    def interval(lower: float, upper: float, linear: bool) -> str:
        return f"{number(lower, linear)}..{number(upper, linear)}" + " mm" * linear

    def rate(value: float | None, linear: bool, unit: str) -> str:
        if value is None:
            return "none"
        return f"{value * 1e3:.6g} mm{unit}" if linear else degrees(value) + unit

    def own(text: str, source: str) -> str:
        return f"{text} (servo)" if source == "servo" and text != "none" else text

    def effort(joint: CompiledJoint) -> str:
        most, unit = highest_effort(joint)
        return "none" if most is None else own(f"{most:g} {unit}".rstrip(), limit_sources(joint)[2])

    joints, servos = result.joints, servo_plans(result.plan)
    accelerations = any(joint.plan.acceleration is not None for joint in joints)
    efforts = any(limit_sources(joint)[2] == "file" for joint in joints)
    motors = any(joint.servos[0].described.motor is not None for joint in joints)
    columns = [
        *(Column(name, "name") for name in ("joint", "bus", "model", "mode")),
        Column("ID"),
        Column("reference"),
        Column("direction", form="{:+d}"),
        *numbers("limits"),
        Column("reach", detail=True),
        *numbers("velocity"),
        *numbers(*["acceleration"] * accelerations),
        *numbers(*["effort limit"] * efforts),
        *[Column("motor file", "text", missing="none", detail=True)] * motors,
    ]
    rows: list[tuple[Value, ...]] = []
    for joint in joints:
        plan, first, linear = joint.plan, joint.servos[0].described, joint.plan.linear
        of_position, of_velocity, _ = limit_sources(joint)
        limits = own(interval(plan.lower, plan.upper, linear), of_position)
        reach = interval(joint.reach.lower, joint.reach.upper, linear)
        rows.append(
            (
                plan.name,
                first.bus,
                first.model,
                start_mode(joint, servos),
                " + ".join(str(servo.described.id) for servo in joint.servos)
                if len(joint.servos) > 1
                else first.id,
                degrees(first.reference),
                first.direction,
                *((limits, reach) if plan.bounded else ("none", "continuous")),
                own(rate(plan.velocity, linear, "/s"), of_velocity),
                *[rate(plan.acceleration, linear, "/s^2")] * accelerations,
                *[effort(joint)] * efforts,
                *[first.motor] * motors,
            )
        )
    return Table.of("Joints (deg)", columns, rows)


def _servos(result: Compiled) -> Table:
    """Return the servos' side of joints with gears, linear joints and joints of several servos."""
    from dxlrun.compile.joints.joints import moving_servos
    from dxlrun.compile.joints.limits import degrees
    from dxlrun.compile.report import servo_plans

    plans = servo_plans(result.plan)
    columns = [
        *(Column(name, "name") for name in ("servo of", "bus", "model")),
        Column("ID"),
        Column("reference"),
        Column("direction", form="{:+d}"),
        *numbers("gear"),
        Column("goals, ticks", detail=True),
        *numbers("goals, deg"),
    ]
    rows: list[tuple[Value, ...]] = []
    for one in (servo.described for servo in moving_servos(result.joints)):
        plan = plans[one.name]
        lower, upper = (degrees(tick * plan.rad_per_tick) for tick in (plan.lower_tick, plan.upper_tick))
        gear = f"{one.ratio * math.tau * 1e3:.6g} mm a turn" if one.linear else f"{1 / one.ratio:.6g} : 1"
        ticks = f"{plan.lower_tick}..{plan.upper_tick}"
        rows.append(
            (
                one.title,
                one.bus,
                one.model,
                one.id,
                degrees(one.reference),
                one.direction,
                gear,
                ticks,
                f"{lower}..{upper}",
            )
        )
    return Table.of("Servos (deg from raw 0)", columns, rows)


def _sensors(sensors: Sequence[SensorPlan]) -> Table:
    linked = any(one.links for one in sensors)
    columns = [
        *(Column(name, "name") for name in ("sensor", "type", "from")),
        *numbers("rate", "timeout"),
        Column("when lost", "text"),
        Column("states", "text"),
        *[Column("senses link", "text")] * linked,
    ]
    rows: list[tuple[Value, ...]] = [
        (
            one.name,
            one.type,
            one.distribution,
            f"{1e9 / one.period_ns:g} Hz",
            f"{one.timeout_ns * 1e-6:g} ms",
            "the run ends" if one.on_lost == "stop" else "the run goes on",
            ", ".join(one.states),
            *[", ".join(one.links)] * linked,
        )
        for one in sensors
    ]
    return Table.of("Sensors", columns, rows)


def _devices(buses: Sequence[BusPlan]) -> Table:
    from dxlrun.compile.report import reads_of, states_of

    columns = [
        *(Column(name, "name") for name in ("device", "bus", "model")),
        Column("ID"),
        *(Column(name, "text") for name in ("states", "commands", "addresses read")),
    ]
    rows = [
        (
            one.name,
            bus.name,
            one.model,
            one.servo_id,
            ", ".join(states_of(one)),
            ", ".join(command.name for command in one.commands),
            ", ".join(reads_of(one)),
        )
        for bus in buses
        for one in bus.devices
    ]
    return Table.of("Devices", columns, rows)


def _controllers(loop: LoopPlan, rate: float) -> Table:
    columns = [
        *(Column(name, "name") for name in ("controller", "type", "from", "claims")),
        Column("of", "text"),
        Column("active", "name"),
        Column("rate", form="{:g} Hz"),
    ]
    joints = len(loop.joints)
    every = "the joint" if joints == 1 else f"all {joints} joints"
    rows = [
        (
            one.name,
            one.type,
            one.distribution,
            " + ".join(one.command) + (f" into {', '.join(one.into)}" if one.into else "") or "nothing",
            (every if len(one.joints) == joints else ", ".join(one.joints)) if one.command else "",
            "yes" if one.active else "no",
            rate / one.every,
        )
        for one in loop.controllers
    ]
    return Table.of("Controllers", columns, rows)


def _buses(buses: Sequence[BusPlan], rate: float) -> Table:
    devices = any(bus.devices for bus in buses)
    columns = [
        Column("bus", "name"),
        Column("port", "name"),
        *numbers("baud rate", "servos", *["devices"] * devices),
        Column("read by", "name"),
        Column("bytes out + in"),
        *(Column(name, form="{:.1f} ms") for name in ("wire", "return delay", "latency", "total")),
        Column("highest rate", form="{:.0f} Hz"),
        Column("of the period", form="{:.0%}"),
    ]
    rows: list[tuple[Value, ...]] = []
    for bus in buses:
        budget = bus.budget
        times = (budget.wire_ns, budget.return_delay_ns, budget.latency_ns, budget.total_ns)
        rows.append(
            (
                bus.name,
                bus.port,
                bus.baud_rate,
                len(bus.servos),
                *[len(bus.devices)] * devices,
                bus.read_by,
                f"{budget.request_bytes} + {budget.reply_bytes}",
                *(each * 1e-6 for each in times),
                budget.highest_rate_hz,
                budget.total_ns * 1e-9 * rate,
            )
        )
    return Table.of(f"Time of one cycle on each bus ({rate:g} Hz leaves {1e3 / rate:.3g} ms)", columns, rows)


def _policies(plan: Plan) -> Table:
    from dxlrun.compile.report import policy_rows

    columns = [
        Column("policy", "name"),
        Column("does", "text"),
        Column("when the loop is gone", "text"),
        Column("at most", form="{:.1f} s"),
    ]
    rows = [
        (row.name, row.does, row.without_loop, row.longest or None)
        for row in policy_rows(plan.loop.policies, plan.buses)
    ]
    return Table.of("Policies", columns, rows)


def _motions(parts: Sequence[MotionPart], end_ns: int | None) -> Table:
    ending = "" if end_ns is None else f" (the run ends at {end_ns * 1e-9:g} s)"
    columns = [
        Column("file", "name"),
        Column("controller", "name"),
        Column("start", form="{:g} s"),
        Column("end", form="{:g} s"),
        *numbers("points", "commands"),
    ]
    rows = [
        (one.file, one.controller, one.start_ns * 1e-9, one.end_ns * 1e-9, one.points, len(one.commands))
        for one in parts
    ]
    return Table.of(f"Motions{ending}", columns, rows)


def _compared(found: Found) -> str:
    """Return in one line that servos were read, and how many differences there are."""
    differing = sum(row.found not in (None, row.declared) for row in found.registers)
    count = differing + len(found.remarks)
    differences = counted(count, "difference", "differences") if count else "no differences"
    start = "; a run would not start" if found.problems else ""
    return f"{counted(found.compared, 'servo', 'servos')} compared with the file, {differences}{start}"


def _registers(registers: Sequence[RegisterRow]) -> Table:
    """Return the declared registers beside those of the servos."""
    columns = [
        *(Column(name, "name") for name in ("joint", "item", "area")),
        *numbers("address", "declared"),
        Column("found", missing="no answer"),
        Column("a run would"),
    ]
    action = {"nothing": "leave it", "write": "write it", "": "not start"}
    rows = [
        (row.joint, row.item, row.area, row.address, row.declared, row.found, action[row.action])
        for row in registers
    ]
    return Table.of("Registers", columns, rows)
