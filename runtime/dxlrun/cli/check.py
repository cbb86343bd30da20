"""`dxlrun check ROBOT.yaml`: look at a robot file without touching hardware."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import compiled
from dxlrun.cli.output.flags import Flag, JsonFlag, Motions
from dxlrun.cli.output.terminal import out, problems_json, say_error, say_warning
from dxlrun.errors import InputError

if TYPE_CHECKING:
    from dxlrun.compile import Compiled
    from dxlrun.dynamixel.plan.bus_plan import BusPlan
    from dxlrun.run.identification import Found


def check(
    robot: Path,
    /,
    *assignments: Annotated[str, Parameter(name="arg:=value")],
    play: Motions = (),
    duration: float | None = None,
    online: Flag = False,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Check a robot file: joints, reach, controllers, claims, the time budget of each bus.

    Without --online no port is opened. Exit code 0, or 2 with every error as `file:line:column: what; how
    to mend it`; with --online 1 where a servo holds another register than the file declares, or is not ready.

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
    online
        Look at the servos too, and compare their registers with those of the file; nothing is written.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    result = compiled(robot, assignments, play, duration, _asked if online else None)
    found = _look(result) if online else None
    if as_json:
        report: dict[str, object] = {"ok": True, "errors": [], "warnings": problems_json(result.warnings)}
        report |= asdict(result.report)
        if found is not None:
            report["online"] = {"as_declared": found.as_declared, **asdict(found)}
        _print_json(report)
        return 0 if found is None or found.as_declared else 1
    _print_tables(result, found)
    for warning in result.warnings:
        say_warning(str(warning))
    if found is None:
        return 0
    for remark in found.remarks:
        say_warning(remark)
    for problem in found.problems:
        say_error(problem)
    return 0 if found.as_declared else 1


def _asked(buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    from dxlrun.run.identification import ask_servos  # not above: most checks open no port

    return ask_servos(buses, joints)


def _look(result: Compiled) -> Found:
    """Look at the servos on real ports; raises InputError where there are none."""
    from dxlrun.compile.buses import SIMULATED
    from dxlrun.run.identification import look

    buses = [bus for bus in result.plan.buses if bus.port != SIMULATED]
    if not buses:
        raise InputError(
            f"every bus of {result.plan.robot} is simulated, so there is nobody to look at; "
            "give it a port, such as port:=/dev/ttyUSB0"
        )
    return look(buses)


def _print_json(value: dict[str, object]) -> None:
    out().file.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def _print_tables(result: Compiled, found: Found | None) -> None:
    from dxlrun.cli.output.check_tables import registers, tables, verdict

    console = out()
    console.print(verdict(result), soft_wrap=True)
    for table in tables(result.report, console.width):
        console.print(table)
    if found is not None and found.registers:
        console.print(registers(found.registers, console.width))
