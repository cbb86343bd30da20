"""`dxlrun check ROBOT.yaml`: look at a robot file without touching hardware."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.flags import Flag, JsonFlag, Motions
from dxlrun.cli.inputs import compiled
from dxlrun.cli.terminal import out, say_warning
from dxlrun.errors import InputError, Problem

if TYPE_CHECKING:
    from dxlrun.compile import Compiled


def check(
    robot: Path,
    /,
    *assignments: Annotated[str, Parameter(name="arg:=value")],
    play: Motions = (),
    duration: float | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Check a robot file: joints, reach, controllers, claims, the time budget of each bus.

    No port is opened. Exit code 0, or 2 with every error as `file:line:column: what; how to mend it`.

    Parameters
    ----------
    robot
        The robot file.
    assignments
        Arguments of the robot file, for example port:=/dev/ttyUSB0.
    play
        Check this motion file too; may be given several times.
    duration
        As for a run: stop after this many seconds.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    try:
        result = compiled(robot, assignments, play, duration)
    except InputError as error:
        if as_json:
            problems = error.problems
            errors = [p for p in problems if p.severity == "error"]
            unplaced = [] if errors else [{"what": str(error)}]
            _print_json(
                {"ok": False, "errors": [*map(_problem, errors), *unplaced], "warnings": _warnings(problems)}
            )
            return error.exit_code
        raise
    if as_json:
        _print_json(
            {"ok": True, "errors": [], "warnings": _warnings(result.warnings), **asdict(result.report)}
        )
        return 0
    _print_tables(result)
    for warning in result.warnings:
        say_warning(str(warning))
    return 0


def _print_json(value: dict[str, object]) -> None:
    out().file.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def _warnings(problems: tuple[Problem, ...]) -> list[dict[str, object]]:
    return [_problem(p) for p in problems if p.severity == "warning"]


def _problem(problem: Problem) -> dict[str, object]:
    mark = problem.mark
    return {
        "file": mark.file,
        "line": mark.line,
        "column": mark.column,
        "what": problem.what,
        "mend": problem.mend,
    }


def _print_tables(result: Compiled) -> None:
    from dxlrun.cli.check_tables import tables, verdict

    console = out()
    console.print(verdict(result), soft_wrap=True)
    for table in tables(result.report, console.width):
        console.print(table)
