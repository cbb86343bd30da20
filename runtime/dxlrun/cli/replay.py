"""`dxlrun replay LOG`: run the controllers of a log again, and say whether they want the same."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import parse_assignments
from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out, say_warning
from dxlrun.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from dxlrun.log.replay import Difference, ReplayReport

Settings = Annotated[
    tuple[str, ...], Parameter(name="--set", negative=(), show_default=False, allow_leading_hyphen=False)
]


def replay(
    log: Path,
    /,
    *assignments: Annotated[str, Parameter(name="arg:=value")],
    settings: Settings = (),
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Run the controllers of a log again on its inputs, and compare their commands and the goals bit for bit.

    Parameters
    ----------
    log
        The log of a run, an .mcap file.
    assignments
        Other arguments for the robot file that is in the log.
    settings
        Another value of a controller's parameter: CONTROLLER.PARAMETER=VALUE; may be given several times.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    if not log.is_file():
        raise InputError(f"there is no log {log}; a run says at its end where its log is")
    arguments = parse_assignments(assignments)
    from dxlrun.log.replay import replay_log, to_json
    from dxlrun.log.replay.changes import Setting

    report = replay_log(log, [Setting.parse(text) for text in settings], arguments)
    for remark in report.remarks:
        say_warning(f"{report.robot}: {remark}")
    if report.stopped:
        say_warning(f"{report.robot}: {report.stopped}")
    console = out()
    if as_json:
        console.file.write(to_json(report).decode() + "\n")
    else:
        _show(report, console)
    return 0 if report.same else 1


def _show(report: ReplayReport, console: Console) -> None:
    console.print(report.sentence, markup=False, soft_wrap=True)
    if report.first is None:
        return
    console.print(_first(report.first), markup=False, soft_wrap=True)
    if report.joints:
        from rich.table import Table

        table = Table("cycles that differ", box=None)
        table.add_column("commands", justify="right")
        table.add_column("goals", justify="right")
        for joint in report.joints:
            table.add_row(joint.joint, str(joint.commands), str(joint.goals))
        console.print(table)


def _first(first: Difference) -> str:
    place = f"first: cycle {first.cycle}, {first.time_s:.3f} s, "
    values = f"recorded {first.recorded}, replayed {first.replayed}"
    if first.joint is None:
        return f"{place}controller {first.controller}: {values}"
    owner = f"controller {first.controller}" if first.controller else "no controller"
    return f"{place}{first.joint}, {owner}: {first.what}: {values}"
