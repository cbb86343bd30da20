"""`dxlrun check ROBOT.yaml`: check a robot file without touching hardware."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.cli.inputs import (
    Assignment,
    DebugFlag,
    Flag,
    GraphFile,
    JsonFlag,
    Motions,
    RobotPath,
    Seconds,
    Without,
    compiled,
    read_models,
)
from dxlrun.cli.tools.tool_log import BusesLog
from dxlrun.errors import InputError, counted
from dxlrun.output.terminal import print_error, print_warning, show_json, show_parts
from dxlrun.output.text_table import Column, Columns, Kind, Table, Value, numbers
from dxlwire.joint_unit import LINEAR, ROTARY

if TYPE_CHECKING:
    from dxlrun.compile.check_report import PolicyRow, Row
    from dxlrun.compile.robot_compiler import CompiledRobot
    from dxlrun.dynamixel.tools.inspection import DeviationRow, InspectionResult, RegisterRow
    from dxlrun.plan.loop_plan import JointProperty
    from dxlwire.bus_plan import BusPlan


def check_robot(
    robot: RobotPath,
    /,
    *assignments: Assignment,
    play: Motions = (),
    without: Without = (),
    duration: Seconds | None = None,
    online: Flag = False,
    graph: GraphFile = None,
    log: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Check a robot file: joints, reach, controllers, claims and the time budget of each bus.

    Without --online, no port is opened. Exit code: 0, or 2 for an invalid file, with one line per error:
    `file:line:column: problem; fix`. With --online, the exit code is 1 if a register differs from the file,
    or a servo is not ready.

    Parameters
    ----------
    play
        Motion file, or name of a motion as for `dxlrun play`. Can be given several times.
    duration
        Duration of the run, s, or with a unit: 500ms, 2min.
    online
        Also read the servos, and compare their registers with the file. Nothing is written.
    graph
        Draw the graph of the controllers with all that they read and command: in the terminal, or into an
        .svg or .dot file.
    log
        New log file for all packets of --online.
    """
    if log is not None and not online:
        raise InputError("--log records the packets of --online; add --online")
    for file in graph or ():
        _check_picture(file)
    with BusesLog(log, f"dxlrun check {robot} --online") as packets:
        ask = partial(_asked, packets) if online else None
        result = compiled(robot, assignments, play, duration, ask, without=without)
        found = _look(result, packets) if online else None
    for file in graph or ():
        _write(result, file)
    if as_json:
        code = 0 if found is None or found.as_declared else 1
        problems = [] if found is None else found.problems or [_compared(found)] * code
        remarks = () if found is None else found.remarks
        show_json(_as_json(result, found), code=code, errors=problems, warnings=[*result.warnings, *remarks])
        return code
    if graph is None:
        show_parts(_verdict(result, found), *_tables(result))
    else:
        show_parts(_verdict(result, found), *(f"the controller graph is in {file}" for file in graph))
        if not graph:
            show_parts(result.drawing)
    if found is not None:
        show_parts(_registers(found.registers), _deviations(found.deviations), _compared(found))
    for warning in result.warnings:
        print_warning(str(warning))
    if found is None:
        return 0
    for remark in found.remarks:
        print_warning(remark)
    for problem in found.problems:
        print_error(problem)
    return 0 if found.as_declared else 1


def _check_picture(file: Path) -> None:
    # Imported here because most checks draw nothing.
    from dxlrun.output.graph_picture import check_picture

    check_picture(file)


def _write(result: CompiledRobot, file: Path) -> None:
    # Imported here because most checks draw nothing.
    from dxlrun.output.graph_picture import write_picture

    write_picture(result.drawing, file)


def _asked(packets: BusesLog, buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    return read_models(buses, joints, packets.open_sinks(buses))


def _look(result: CompiledRobot, packets: BusesLog) -> InspectionResult:
    """Read the servos on the robot's real ports and compare their registers with the file.

    Raises InputError when all buses are simulated.
    """
    from dxlrun.dynamixel.tools.inspection import inspect_buses
    from dxlwire.bus_plan import SIMULATED

    buses = [bus for bus in result.plan.buses if bus.port != SIMULATED]
    if not buses:
        raise InputError(
            f"all buses of {result.plan.robot} are simulated; give a port, such as port:=/dev/ttyUSB0"
        )
    joints = result.plan.loop.joints
    moved = {servo: joints[joint] for joint, servo in result.plan.mechanics.own_servos(len(joints))}
    return inspect_buses(buses, packets.open_sinks(result.plan.buses), moved)


def _as_json(result: CompiledRobot, found: InspectionResult | None) -> dict[str, object]:
    from msgspec import to_builtins

    report: dict[str, object] = to_builtins(result.report)
    if found is not None:
        report["online"] = {"as_declared": found.as_declared, **to_builtins(found)}
    return report


def _verdict(result: CompiledRobot, found: InspectionResult | None) -> str:
    """Return the line that a valid file gets: numbers of joints, controllers and warnings, and the rate."""
    verdict = "good"
    if found is not None and not found.as_declared:
        verdict = "a run would not start" if found.problems else "the servos differ from the file"
    loop, warnings = result.plan.loop, len(result.warnings)
    active = sum(controller.active for controller in loop.controllers)
    joints = counted(len(loop.joints), "joint", "joints")
    controllers = counted(len(loop.controllers), "controller", "controllers")
    return (
        f"{result.plan.robot}: {verdict}. {joints}, {active} of {controllers} active, {result.rate:g} Hz, "
        f"{warnings or 'no'} warning{'s' * (warnings != 1)}"
    )


def _tables(result: CompiledRobot) -> Iterator[Table]:
    # Imported here because the help of the verb does not need it.
    from dxlrun.compile.check_report import TableStage
    from dxlrun.features import stages

    report = result.report
    joints, rate = report["joints"], result.rate
    yield _joints(joints)
    servos = [servo for joint in joints for servo in joint["servos"]]
    if len(servos) > len(joints) or any(servo["ratio"] != 1.0 for servo in servos):
        yield _servos({(servo["bus"], servo["id"]): servo for servo in servos}.values())
    groups = ((name, ", ".join(joints)) for name, joints in report["groups"].items())
    yield Table.from_rows("Groups", (Column("group", "name"), Column("joints", "text")), groups)
    yield _poses(report["poses"])
    for feature, stage in stages(TableStage, result.plan.features):
        yield stage.table(report[feature.name])
    yield _controllers(report["controllers"], len(joints))
    yield _buses(report["buses"], rate)
    yield Table.listing("Policies", _POLICIES, report["policies"])
    end = report["duration"]
    ending = "" if end is None else f" (the run ends at {end:g} s)"
    yield Table.listing(f"Motions{ending}", _MOTIONS, report["motions"])


def _named(kind: Kind, **keys: str) -> Iterator[tuple[Column, str]]:
    """Yield a column for each heading in `keys`, with the key of its values in the rows."""
    return ((Column(name, kind), key) for name, key in keys.items())


_POLICIES: Columns[PolicyRow] = [
    *_named("name", policy="name"),
    *_named("text", does="does", **{"loop gone": "without_loop"}),
    (Column("at most", form="{:.1f} s"), lambda row: row.longest or None),
]
_MOTIONS: Columns[Row] = [
    *_named("name", file="file", controller="controller"),
    (Column("start", form="{:g} s"), "start"),
    (Column("end", form="{:g} s"), "end"),
    *_named("number", points="points", commands="commands"),
]


def _poses(poses: Sequence[Row]) -> Table:
    def margin(row: Row) -> str:
        unit = LINEAR if row["linear"] else ROTARY
        return f"{unit.text(row['margin'])} of {row['margin_joint']}" if row["margin_joint"] else ""

    def figure(name: str) -> tuple[Column, Callable[[Row], float | None]]:
        return Column(name, form="{:.2f}"), lambda row: row["figures"].get(name)

    figures = dict.fromkeys(name for row in poses for name in row["figures"])
    columns: Columns[Row] = [
        *_named("name", pose="name"),
        *map(figure, figures),
        (Column("left to a limit", "name"), margin),
        *_named("text", **{"not reached": "remark"}),
    ]
    return Table.listing("Poses", columns, poses)


def _joints(joints: Sequence[Row]) -> Table:
    from dxlrun.compile.check_report import shown_properties
    from dxlrun.compile.joints.limits import degrees

    properties = shown_properties()

    def interval(row: Row, lower: str, upper: str) -> str:
        unit = LINEAR if row["linear"] else ROTARY
        first, last = (unit.number(row[end], signed=True) for end in (lower, upper))
        return f"{first}..{last}{unit.suffix}"

    def own(text: str, source: str) -> str:
        return f"{text} (servo)" if source == "servo" and text != "none" else text

    def format_property(row: Row, one: JointProperty) -> str:
        value = row[one.name]
        if value is None:
            return "none"
        if one.text is not None:
            return one.text(value, LINEAR if row["linear"] else ROTARY)
        if not isinstance(value, int | float):
            return str(value)
        text = f"{value * 1e3:.6g} mm" if row["linear"] else degrees(value)
        return own(f"{text}{one.column}", row[f"{one.name}_source"] if one.limit else "none")

    def effort(row: Row) -> str:
        most, unit = row["effort"], row["effort_unit"]
        return "none" if most is None else own(f"{most:g} {unit}".rstrip(), row["effort_source"])

    def limits(row: Row) -> str:
        return own(interval(row, "lower", "upper"), row["position_source"]) if row["bounded"] else "none"

    columns: Columns[Row] = [
        *_named("name", joint="name", bus="bus", model="model", mode="mode"),
        (Column("ID"), lambda row: " + ".join(str(servo["id"]) for servo in row["servos"])),
        (Column("reference"), lambda row: degrees(row["reference"])),
        (Column("direction", form="{:+d}"), "direction"),
        (Column("limits"), limits),
        (
            Column("reach", detail=True),
            lambda row: interval(row, "reach_lower", "reach_upper") if row["bounded"] else "continuous",
        ),
        *[(Column(one.name), partial(format_property, one=one)) for one in properties],
        (Column("effort limit"), effort),
        (Column("motor file", "text", missing="none", detail=True), "motor"),
    ]
    unused = {
        one.name: all(row[one.name] is None for row in joints) for one in properties if not one.limit
    } | {
        "effort limit": all(row["effort_source"] != "file" for row in joints),
        "motor file": all(row["motor"] is None for row in joints),
    }
    shown = [(column, value) for column, value in columns if not unused.get(column.name)]
    return Table.listing("Joints (deg)", shown, joints)


def _servos(servos: Iterable[Row]) -> Table:
    """Return the table of all servos, for robots with gears, linear joints or several servos on a joint."""
    from dxlrun.compile.joints.limits import degrees

    def gear(row: Row) -> str:
        ratio = row["ratio"]
        return f"{ratio * math.tau * 1e3:.6g} mm a turn" if row["linear"] else f"{1 / ratio:.6g} : 1"

    columns: Columns[Row] = [
        *_named("name", **{"servo of": "joint"}, bus="bus", model="model"),
        (Column("ID"), "id"),
        (Column("reference"), lambda row: degrees(row["reference"])),
        (Column("direction", form="{:+d}"), "direction"),
        (Column("gear"), gear),
        (Column("goals, ticks", detail=True), lambda row: f"{row['lower_tick']}..{row['upper_tick']}"),
        (Column("goals, deg"), lambda row: f"{degrees(row['lower'])}..{degrees(row['upper'])}"),
    ]
    return Table.listing("Servos (angles in deg from tick 0, as each servo reports them)", columns, servos)


def _controllers(controllers: Sequence[Row], joints: int) -> Table:
    every = "the joint" if joints == 1 else f"all {joints} joints"

    def claims(row: Row) -> str:
        into = f" into {', '.join(row['into'])}" if row["into"] else ""
        return " + ".join(row["command"]) + into or "nothing"

    def moved(row: Row) -> str:
        named = every if len(row["joints"]) == joints else ", ".join(row["joints"])
        return named if row["command"] else ""

    columns: Columns[Row] = [
        *_named("name", controller="name", type="type", **{"from": "distribution"}),
        (Column("claims", "name"), claims),
        (Column("of", "text"), moved),
        (Column("active", "name"), lambda row: "yes" if row["active"] else "no"),
        (Column("rate", form="{:g} Hz"), "rate"),
    ]
    return Table.listing("Controllers", columns, controllers)


def _buses(buses: Sequence[Row], rate: float) -> Table:
    def time(key: str) -> tuple[Column, Callable[[Row], Value]]:
        return Column(key.replace("_", " "), form="{:.1f} ms"), lambda row: row[key] * 1e3

    columns: Columns[Row] = [
        *_named("name", bus="name", port="port"),
        *_named("number", **{"baud rate": "baud_rate"}, servos="servos"),
        *[(Column("devices"), "devices")] * any(row["devices"] for row in buses),
        *_named("name", **{"read by": "read_by"}),
        (Column("bytes out + in"), lambda row: f"{row['request_bytes']} + {row['reply_bytes']}"),
        *map(time, ("wire", "return_delay", "latency", "total")),
        (Column("highest rate", form="{:.0f} Hz"), "highest_rate"),
        (Column("of the period", form="{:.0%}"), "share"),
    ]
    title = f"Time of one cycle on each bus ({rate:g} Hz leaves {1e3 / rate:.3g} ms)"
    return Table.listing(title, columns, buses)


def _compared(found: InspectionResult) -> str:
    """Return the line after a comparison with the servos: numbers of servos and differences."""
    differing = sum(row.found not in (None, row.declared) for row in found.registers)
    count = differing + len(found.deviations) + len(found.remarks)
    if not found.compared:
        return "no servo compared with the file; a run would not start"
    differences = counted(count, "difference", "differences") if count else "no differences"
    start = "; a run would not start" if found.problems else ""
    return f"{counted(found.compared, 'servo', 'servos')} compared with the file, {differences}{start}"


def _registers(registers: Sequence[RegisterRow]) -> Table:
    """Return a table of the registers that the file declares, with the values found in the servos."""
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
    return Table.from_rows("Registers", columns, rows)


def _deviations(deviations: Sequence[DeviationRow]) -> Table:
    """Return a table of undeclared registers whose value in a servo is not the factory's."""
    columns: Columns[DeviationRow] = [
        *_named("name", joint="joint", servo="servo", item="item", area="area"),
        *_named("number", address="address", found="found", factory="factory"),
        *_named("text", effect="effect"),
    ]
    return Table.listing("Settings that differ from the factory's", columns, deviations)
