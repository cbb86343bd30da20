"""`dxlrun check ROBOT.yaml`: check a robot file without touching hardware."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import Assignment, Flag, JsonFlag, Motions, Seconds, compiled, read_models
from dxlrun.cli.tool_log import BusesLog
from dxlrun.errors import InputError, counted
from dxlrun.output.json import problems_json
from dxlrun.output.table import Column, Table, Value, numbers
from dxlrun.output.terminal import print_error, print_warning, show, show_json

if TYPE_CHECKING:
    from dxlrun.compile import Compiled
    from dxlrun.compile.report import (
        BusRow,
        CheckReport,
        ControllerRow,
        DeviceRow,
        JointRow,
        MotionRow,
        PolicyRow,
        SensorRow,
        ServoRow,
    )
    from dxlrun.dynamixel.tools.inspection import Found, RegisterRow
    from dxlrun.plan.bus_plan import BusPlan

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
        show(_verdict(result), *_tables(result.report))
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
    from dxlrun.compile.buses import SIMULATED
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
    report = result.report
    active = sum(controller.active for controller in report.controllers)
    joints = counted(len(report.joints), "joint", "joints")
    controllers = counted(len(report.controllers), "controller", "controllers")
    warnings = len(result.warnings)
    return (
        f"{report.robot}: good. {joints}, {active} of {controllers} active, {report.rate:g} Hz, "
        f"{warnings or 'no'} warning{'s' * (warnings != 1)}"
    )


def _tables(report: CheckReport) -> Iterator[Table]:
    yield _joints(report.joints)
    if any(len(joint.servos) > 1 or joint.servos[0].ratio != 1.0 for joint in report.joints):
        yield _servos(report.joints)
    if report.groups:
        rows = tuple((name, ", ".join(joints)) for name, joints in report.groups.items())
        yield Table.of("Groups", (Column("group", "name"), Column("joints", "text")), rows)
    if report.devices:
        yield _devices(report.devices)
    if report.sensors:
        yield _sensors(report.sensors)
    yield _controllers(report.controllers, len(report.joints))
    yield _buses(report.buses, report.rate)
    yield _policies(report.policies)
    yield _motions(report.motions, report.duration)


def _joints(joints: Sequence[JointRow]) -> Table:
    from dxlrun.compile.joints.limits import degrees, number

    def interval(lower: float, upper: float, linear: bool) -> str:
        return f"{number(lower, linear)}..{number(upper, linear)}" + " mm" * linear

    def rate(value: float, linear: bool) -> str:
        return f"{value * 1e3:.6g} mm" if linear else degrees(value)

    def own(text: str, source: str) -> str:
        return f"{text} (servo)" if source == "servo" else text

    def effort(row: JointRow) -> str:
        if row.effort is None:
            return "none"
        return own(f"{row.effort:g} {row.effort_unit}".rstrip(), row.effort_source)

    accelerations = any(row.acceleration is not None for row in joints)
    efforts = any(row.effort_source == "file" for row in joints)
    motors = any(row.motor is not None for row in joints)
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
    rows: list[tuple[Value, ...]] = [
        (
            row.name,
            row.bus,
            row.model,
            row.mode,
            " + ".join(str(servo.id) for servo in row.servos) if len(row.servos) > 1 else row.id,
            degrees(row.reference),
            row.direction,
            own(interval(row.lower, row.upper, row.linear), row.position_source) if row.bounded else "none",
            interval(row.reach_lower, row.reach_upper, row.linear) if row.bounded else "continuous",
            "none"
            if row.velocity is None
            else own(f"{rate(row.velocity, row.linear)}/s", row.velocity_source),
            *["none" if row.acceleration is None else f"{rate(row.acceleration, row.linear)}/s^2"]
            * accelerations,
            *[effort(row)] * efforts,
            *[row.motor] * motors,
        )
        for row in joints
    ]
    return Table.of("Joints (deg)", columns, rows)


def _servos(joints: Sequence[JointRow]) -> Table:
    """Return the servos' side of joints with gears, linear joints and joints of several servos."""
    from dxlrun.compile.joints.limits import degrees

    def ratio(row: ServoRow) -> str:
        return f"{row.ratio * math.tau * 1e3:.6g} mm a turn" if row.linear else f"{1 / row.ratio:.6g} : 1"

    columns = [
        *(Column(name, "name") for name in ("servo of", "bus", "model")),
        Column("ID"),
        Column("reference"),
        Column("direction", form="{:+d}"),
        *numbers("gear"),
        Column("goals, ticks", detail=True),
        *numbers("goals, deg"),
    ]
    servos = dict.fromkeys(servo for joint in joints for servo in joint.servos)
    rows: list[tuple[Value, ...]] = [
        (
            row.joint,
            row.bus,
            row.model,
            row.id,
            degrees(row.reference),
            row.direction,
            ratio(row),
            f"{row.lower_tick}..{row.upper_tick}",
            f"{degrees(row.lower)}..{degrees(row.upper)}",
        )
        for row in servos
    ]
    return Table.of("Servos (deg from raw 0)", columns, rows)


def _sensors(sensors: Sequence[SensorRow]) -> Table:
    columns = [
        *(Column(name, "name") for name in ("sensor", "type", "from")),
        *numbers("rate", "timeout"),
        Column("when lost", "text"),
        Column("states", "text"),
        *[Column("senses link", "text")] * any(row.links for row in sensors),
    ]
    rows: list[tuple[Value, ...]] = [
        (
            row.name,
            row.type,
            row.distribution,
            f"{row.rate:g} Hz",
            f"{row.timeout * 1e3:g} ms",
            "the run ends" if row.on_lost == "stop" else "the run goes on",
            ", ".join(row.states),
            *[", ".join(row.links)] * any(each.links for each in sensors),
        )
        for row in sensors
    ]
    return Table.of("Sensors", columns, rows)


def _devices(devices: Sequence[DeviceRow]) -> Table:
    columns = [
        *(Column(name, "name") for name in ("device", "bus", "model")),
        Column("ID"),
        *(Column(name, "text") for name in ("states", "commands", "addresses read")),
    ]
    rows = [
        (
            row.name,
            row.bus,
            row.model,
            row.id,
            ", ".join(row.states),
            ", ".join(row.commands),
            ", ".join(row.reads),
        )
        for row in devices
    ]
    return Table.of("Devices", columns, rows)


def _controllers(controllers: Sequence[ControllerRow], joints: int) -> Table:
    columns = [
        *(Column(name, "name") for name in ("controller", "type", "from", "claims")),
        Column("of", "text"),
        Column("active", "name"),
        Column("rate", form="{:g} Hz"),
    ]
    every = "the joint" if joints == 1 else f"all {joints} joints"
    rows = [
        (
            row.name,
            row.type,
            row.distribution,
            " + ".join(row.command) + (f" into {', '.join(row.into)}" if row.into else "") or "nothing",
            (every if len(row.joints) == joints else ", ".join(row.joints)) if row.command else "",
            "yes" if row.active else "no",
            row.rate,
        )
        for row in controllers
    ]
    return Table.of("Controllers", columns, rows)


def _buses(buses: Sequence[BusRow], rate: float) -> Table:
    devices = any(row.devices for row in buses)
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
    rows: list[tuple[Value, ...]] = [
        (
            row.name,
            row.port,
            row.baud_rate,
            row.servos,
            *[row.devices] * devices,
            row.read_by,
            f"{row.request_bytes} + {row.reply_bytes}",
            *(value * 1e3 for value in (row.wire, row.return_delay, row.latency, row.total)),
            row.highest_rate,
            row.share,
        )
        for row in buses
    ]
    return Table.of(f"Time of one cycle on each bus ({rate:g} Hz leaves {1e3 / rate:.3g} ms)", columns, rows)


def _policies(policies: Sequence[PolicyRow]) -> Table:
    columns = [
        Column("policy", "name"),
        Column("does", "text"),
        Column("when the loop is gone", "text"),
        Column("at most", form="{:.1f} s"),
    ]
    rows = [(row.name, row.does, row.without_loop, row.longest or None) for row in policies]
    return Table.of("Policies", columns, rows)


def _motions(motions: Sequence[MotionRow], duration: float | None) -> Table:
    ending = "" if duration is None else f" (the run ends at {duration:g} s)"
    columns = [
        Column("file", "name"),
        Column("controller", "name"),
        Column("start", form="{:g} s"),
        Column("end", form="{:g} s"),
        *numbers("points", "commands"),
    ]
    rows = [(row.file, row.controller, row.start, row.end, row.points, row.commands) for row in motions]
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
