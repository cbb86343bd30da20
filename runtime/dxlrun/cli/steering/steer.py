"""`dxlrun list`, `switch`, `rate`, `halt`, `pause`, `load`, `stop` and others, and parts shared with them.

Each command is one request to the gateway of the run: executed after the read phase of a cycle, or refused
with the reason.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dxlrun.cli.inputs import DebugFlag, GraphFile, Hertz, JsonFlag, WaitFlag
from dxlrun.errors import DxlrunError, InputError, suggestion
from dxlrun.output.quantity import names_with_units, quantity_text
from dxlrun.output.terminal import print_error, show_json, show_parts
from dxlrun.output.text_table import Column, Columns, Table

if TYPE_CHECKING:
    from dxlrun.output.graph import Graph
    from dxlrun.remote.client import Executed, RemoteRobot
    from dxlrun.run.unsteered import UnsteeredRun

Names = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)]
"""Option that takes the names of one or several controllers."""
Words = Annotated[str, Parameter(name="key=value")]
Row = Mapping[str, Any]
"""Object of a JSON reply of the gateway."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class RobotChoice:
    """Choice of the robot, and form of the output.

    Parameters
    ----------
    robot
        Name of the robot, if several run. NAME@HOST:PORT addresses a robot on another computer.
    """

    robot: str | None = None
    as_json: JsonFlag = False
    debug: DebugFlag = False


ONLY_ONE = RobotChoice()
"""Default of `RobotChoice`: the only robot that runs."""


def list_robots(
    *, robot: str | None = None, graph: GraphFile = None, as_json: JsonFlag = False, debug: DebugFlag = False
) -> int:
    """List the running robots: controllers, devices and sensors, and the commands that these take.

    Parameters
    ----------
    robot
        Name of the robot to list. Default: all running robots.
    graph
        Draw the graph of the controllers with all that they read and command, and with their states: in the
        terminal, or into an .svg or .dot file. A file shows one robot.
    """
    from dxlrun.remote.client import connect
    from dxlrun.remote.network.network_link import known_robots
    from dxlrun.remote.sockets import is_awaited, running
    from dxlrun.run.unsteered import describe_run, unsteered_runs

    here = running()
    unsteered = {run.name: run for run in unsteered_runs() if run.is_ours}
    names = dict.fromkeys((*here, *known_robots(), *unsteered))
    _require_known(robot, names)
    if graph:
        _check_graph(graph, [*here] if robot is None else [robot])
    found, code = [], 0
    failures: list[str] = []
    for name in names if robot is None else (robot,):
        if name in unsteered:
            failures.append(describe_run(unsteered[name]))
            code |= robot is not None
            continue
        try:
            with connect(name, "dxlrun list") as one:
                found.append({**one.info(), "name": name})
        # The robot may have ended in the meantime; the others are still listed.
        except DxlrunError as error:
            failures.append(str(error))
            code |= robot is not None or name in here
    for info in found:
        _write_graphs(info, graph or ())
    if as_json:
        show_json(found, code=code, errors=failures if code else (), warnings=() if code else failures)
        return code
    for failure in failures:
        print_error(f"dxlrun: {failure}")
    for info in found:
        _show_robot(info, graph)
    if not found and not code and not unsteered:
        starts = "a robot is starting; try again when it runs"
        show_parts(starts if is_awaited(None) else "no running robot found; start one by `dxlrun ROBOT.yaml`")
    return code


def _check_graph(files: Sequence[Path], names: Sequence[str]) -> None:
    """Raise InputError when `list --graph` cannot draw into the files, or more than one robot would be
    drawn.
    """
    # Imported here because most lists draw nothing.
    from dxlrun.output.graph_picture import check_picture

    for file in files:
        check_picture(file)
    _require_one(names)


def _write_graphs(info: Row, files: Sequence[Path]) -> None:
    # Imported here because most lists draw nothing.
    from dxlrun.output.graph_picture import write_picture

    for file in files:
        write_picture(drawing(info), file)


def _show_robot(info: Row, graph: Sequence[Path] | None) -> None:
    if graph is None:
        show_parts(headline(info), controllers(info), sources(info), groups(info))
    elif graph:
        show_parts(headline(info), *(f"the controller graph is in {file}" for file in graph))
    else:
        show_parts(headline(info), drawing(info))


def switch(*, activate: Names = (), deactivate: Names = (), chosen: RobotChoice = ONLY_ONE) -> int:
    """Activate and deactivate controllers of a running robot.

    All of them change in the same cycle, or none does.

    Parameters
    ----------
    activate
        Controllers to activate.
    deactivate
        Controllers to deactivate.
    """
    if not activate and not deactivate:
        raise InputError("nothing to switch; write --activate NAME, --deactivate NAME, or both")
    with connect_robot(chosen.robot, "switch") as robot:
        done = robot.switch(activate, deactivate)
        groups = {
            "activated": [*(name for name in activate if name not in deactivate), *done.below],
            "deactivated": [name for name in deactivate if name not in activate],
            "restarted": [name for name in activate if name in deactivate],
        }
        parts = [f"{', '.join(names)} {state}" for state, names in groups.items() if names]
        return report_done(robot, chosen, done, f"{robot.name}: {'; '.join(parts)}")


def rate(hz: Hertz, /, *, chosen: RobotChoice = ONLY_ONE) -> int:
    """Change the loop rate of a running robot.

    Parameters
    ----------
    hz
        New loop rate, Hz.
    """
    # Also refuses NaN.
    if not 0 < hz < float("inf"):
        raise InputError(f"{hz:g} is not a rate; give a number of Hz above 0")
    with connect_robot(chosen.robot, "rate") as robot:
        done = robot.rate(hz)
        return report_done(robot, chosen, done, f"{robot.name} runs at {hz:g} Hz")


def halt(*, chosen: RobotChoice = ONLY_ONE) -> int:
    """Stop all joints within their limits, and hold them.

    The run continues. All controllers that command joints are deactivated.
    """
    with connect_robot(chosen.robot, "halt") as robot:
        done = robot.halt()
        text = f"{robot.name} stands still"
        if (found := done.halted) is not None:
            text += f" after {found.seconds:.2f} s ({found.joint}: {found.velocity:.2g} rad/s)"
        return report_done(
            robot,
            chosen,
            done,
            f"{text}; to continue, activate a controller: `dxlrun switch --activate NAME`",
        )


def take_over(*, chosen: RobotChoice = ONLY_ONE) -> int:
    """Take over a robot that a client on another computer commands.

    Commands of that client are refused from then on.
    """
    with connect_robot(chosen.robot, "take-over") as robot:
        done = robot.take_over()
        return report_done(robot, chosen, done, f"{robot.name} now takes commands from this computer only")


def pause(*, chosen: RobotChoice = ONLY_ONE) -> int:
    """Pause a running robot.

    Its joints hold their positions, and the time of its controllers stops.
    """
    with connect_robot(chosen.robot, "pause") as robot:
        done = robot.pause()
        text = "is paused, its joints are held; continue by `dxlrun resume`"
        return report_done(robot, chosen, done, f"{robot.name} {text}")


def resume_robot(*, chosen: RobotChoice = ONLY_ONE) -> int:
    """Resume a paused robot: its controllers continue where they stopped."""
    with connect_robot(chosen.robot, "resume") as robot:
        done = robot.resume()
        return report_done(robot, chosen, done, f"{robot.name} runs again")


def load_controller(
    name: str, /, *words: Words, file: Path | None = None, chosen: RobotChoice = ONLY_ONE
) -> int:
    """Load another controller into a paused robot.

    `dxlrun switch --activate NAME` starts the controller.

    Parameters
    ----------
    name
        Name of the new controller.
    words
        Keys of the controller as in the robot file, such as type=joint_group_position_controller
        'joints=[head_yaw_joint]'.
    file
        YAML file with the keys, in place of words on the command line.
    """
    from dxlrun.cli.steering.written import WrittenEntry

    entry = WrittenEntry.from_words(words, file, example="type=joint_group_position_controller").data
    if "type" not in entry:
        if name.endswith((".yaml", ".yml")):
            fix = f"write `dxlrun play {name}` for a motion, or `NAME --file {name}` for a controller"
            raise InputError(f"{name} is a file, not the name of a controller; {fix}")
        raise InputError(f"{name} has no type; give one, such as type=joint_group_position_controller")
    with connect_robot(chosen.robot, "load") as robot:
        done = robot.load(name, entry)
        text = f"{name} is loaded; start it by `dxlrun switch --activate {name}`"
        return report_done(robot, chosen, done, f"{robot.name}: {text}")


def unload_controller(name: str, /, *, chosen: RobotChoice = ONLY_ONE) -> int:
    """Remove an inactive controller from a paused robot.

    Parameters
    ----------
    name
        Name of the controller.
    """
    with connect_robot(chosen.robot, "unload") as robot:
        done = robot.unload(name)
        return report_done(robot, chosen, done, f"{robot.name}: {name} is unloaded")


def stop(*, wait: WaitFlag = True, chosen: RobotChoice = ONLY_ONE) -> int:
    """Stop a running robot by its policy on_exit.

    Parameters
    ----------
    wait
        Wait until the run has ended. With --no-wait, return as soon as the loop has accepted the request.
    """
    from dxlrun.run.unsteered import end_run

    if (run := unsteered_of(chosen.robot)) is not None:
        sentence = end_run(run, wait=wait)
        if chosen.as_json:
            show_json({"robot": run.name, "ended": sentence})
        else:
            show_parts(sentence)
        return 0
    with connect_robot(chosen.robot, "stop") as robot:
        robot.stop(wait=wait)
        return report_done(robot, chosen, None, f"{robot.name} {'has ended' if wait else 'is ending'}")


def unsteered_of(name: str | None) -> UnsteeredRun | None:
    """Return the run that `--robot` names, or the only one, if it has no gateway; None when it has.

    Raises InputError when several runs are possible.
    """
    from dxlrun.remote.sockets import running
    from dxlrun.run.unsteered import unsteered_runs

    unsteered, steered = unsteered_runs(), running()
    if name is None:
        unsteered = [run for run in unsteered if run.is_ours]
        _require_one(sorted({*steered, *(run.name for run in unsteered)}))
        return unsteered[0] if unsteered else None
    found = next((run for run in unsteered if run.is_named(name)), None)
    if found is None and name not in steered:
        _require_one([run.name for run in unsteered if run.run.robot == name])
    return found


def connect_robot(name: str | None, verb: str) -> RemoteRobot:
    """Connect to the robot that `--robot` names, or to the only one that runs; wait while it starts.

    Args:
        name: None when the option was not given.
        verb: The command, for the log of the robot.

    Raises:
        InputError: Several robots run and none was named, or none has this name.
        DxlrunError: No robot runs, or it cannot be steered.
    """
    from dxlrun.remote.client import connect
    from dxlrun.remote.network.network_link import known_robots
    from dxlrun.remote.sockets import await_sockets, running
    from dxlrun.run.unsteered import describe_run

    names, remote = running(), () if name is None else known_robots()
    if not (names if name is None else name in (*names, *remote) or "@" in name):
        names = tuple(sorted(await_sockets(name)))
    known = (*names, *remote)
    missing = name not in known if name else not names
    if missing and (run := unsteered_of(name)) is not None:
        raise DxlrunError(describe_run(run))
    if name is not None:
        _require_known(name, known)
    elif not names:
        raise DxlrunError("no running robot found; start one by `dxlrun ROBOT.yaml`")
    else:
        _require_one(names)
    return connect(name or names[0], f"dxlrun {verb}")


def _require_one(names: Sequence[str]) -> None:
    if len(names) > 1:
        raise InputError(f"several robots run; choose one: --robot {', --robot '.join(names)}")


def _require_known(robot: str | None, names: Collection[str]) -> None:
    """Raise InputError for a robot that does not run here and is not listed; an address (with @) is not
    checked.
    """
    if robot is not None and robot not in names and "@" not in robot:
        raise InputError(f"robot {robot} is not running; {suggestion(robot, names)}")


def report_done(robot: RemoteRobot, chosen: RobotChoice, done: Executed | None, sentence: str) -> int:
    """Print `sentence`, or with --json the robot's reply, for an executed request; return exit code 0."""
    if chosen.as_json:
        cycle: dict[str, object] = {} if done is None else {"cycle": done.cycle}
        if done is not None and done.value is not None:
            cycle |= {"value": done.value} if done.old is None else {"old": done.old, "value": done.value}
        if done is not None and done.halted is not None:
            cycle |= {name: getattr(done.halted, name) for name in ("seconds", "joint", "velocity")}
        for name in ("below", "deactivated", "offered"):
            if done is not None and (names := getattr(done, name)):
                cycle |= {name: list(names)}
        numbers = [] if done is None else [goal.number for goal in done.goals]
        goals = {"goals": numbers} if len(numbers) > 1 else dict(zip(("goal",), numbers, strict=False))
        show_json({"robot": robot.name} | cycle | goals)
    else:
        show_parts(sentence)
    return 0


def headline(info: Row) -> str:
    """Return a line about a robot: rate, cycles, skipped periods and log."""
    paused = ", paused" if info["paused"] else ""
    periods = f"{info['skipped']} {'period' if info['skipped'] == 1 else 'periods'} skipped"
    log = f"log {info['log']}" if info["log"] else "no log"
    return f"{info['name']}: {info['rate']:g} Hz{paused}, {info['cycles']} cycles, {periods}, {log}"


def controllers(info: Row) -> Table:
    """Return a table of a robot's controllers: state, rate, commands that they accept, and joints."""
    columns: Columns[Row] = [
        (Column("controller", "name"), "name"),
        (Column("state", "name"), state),
        (Column("rate", form="{:g} Hz"), "rate"),
        (Column("takes", "text"), lambda one: "; ".join(starmap(command, one["takes"].items()))),
        # A broadcaster moves no joints.
        (Column("moves", "text"), lambda one: ", ".join(one["joints"]) if one["command"] else ""),
    ]
    return Table.listing("", columns, info["controllers"])


def sources(info: Row) -> Table:
    """Return a table of a robot's devices and sensors, with states and commands."""
    columns: Columns[Row] = [
        (Column("source", "name"), "name"),
        (Column("kind", "name"), "kind"),
        (Column("takes", "text"), _source_commands),
        (Column("states", "text"), lambda one: names_with_units(one["states"], one.get("units", {}))),
    ]
    return Table.listing("", columns, info.get("sources", ()))


def groups(info: Row) -> Table:
    """Return a table of a robot's groups with their joints."""
    rows = [(name, ", ".join(joints)) for name, joints in info.get("groups", {}).items()]
    return Table.from_rows("", [Column("group", "name"), Column("joints", "text")], rows)


def _source_commands(source: Row) -> str:
    units = source.get("command_units", {})
    ranges = zip(source["commands"], source["ranges"], strict=True)
    return ", ".join(
        f"{name}={lowest:g}..{quantity_text(highest, units.get(name, ''))}"
        for name, (lowest, highest) in ranges
    )


def drawing(info: Row) -> Graph:
    """Return the drawing of a running robot's controllers, with the data that they exchange."""
    from msgspec import convert

    # Imported here because most commands draw nothing.
    from dxlrun.compile.controller_graph import ControllerGraph
    from dxlrun.plan.loop_plan import ControllerPlan

    unknown = {"distribution": "", "parameters": "{}", "publishes": (), "rate": None}
    plans = (
        convert({**one, **unknown, "every": max(1, round(info["rate"] / one["rate"]))}, ControllerPlan)
        for one in info["controllers"]
    )
    return ControllerGraph(info["joints"], tuple(plans)).drawing("controllers", info["rate"])


def state(controller: Row) -> str:
    """Return a controller's state for a table: `active`, `inactive`, or `held` after its stream ended."""
    if not controller["active"]:
        return "inactive"
    return "held" if controller["held"] else "active"


def command(kind: str, schema: Row) -> str:
    """Return a command as `kind: key, [optional key]`, from its JSON Schema."""
    names, needed = schema.get("properties", {}), schema.get("required", ())
    keys = (name if name in needed else f"[{name}]" for name in names)
    return f"{kind}: {', '.join(keys)}" if names else kind
