"""`dxlrun replay`: run the controllers of a log again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import Assignment, Flag, JsonFlag, parse_assignments
from dxlrun.errors import InputError
from dxlrun.output.terminal import print_warning, show, show_json

if TYPE_CHECKING:
    from dxlrun.log.replay import ReplayDifference, ReplayReport
    from dxlrun.output.table import Part

Settings = Annotated[
    tuple[str, ...], Parameter(name="--set", negative=(), show_default=False, allow_leading_hyphen=False)
]


def replay(
    log: Path,
    /,
    *assignments: Assignment,
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
        raise InputError(f"there is no log {log}; a run prints at its end where its log is")
    arguments = parse_assignments(assignments)
    import msgspec

    from dxlrun.log.replay import Setting, replay_log

    report = replay_log(log, [Setting.parse(text) for text in settings], arguments)
    for remark in report.remarks:
        print_warning(f"{report.robot}: {remark}")
    if report.stopped:
        print_warning(f"{report.robot}: {report.stopped}")
    if as_json:
        content = msgspec.to_builtins(report)
        show_json(content | {"same": report.same, "sentence": report.sentence})
    else:
        show(*_replayed(report))
    return 0 if report.same else 1


def _replayed(report: ReplayReport) -> tuple[Part, ...]:
    from dxlrun.output.table import Column, Table, numbers

    if report.first is None:
        return (report.sentence,)
    counts = ["commands", "goals"]
    if any(joint.references for joint in report.joints):
        counts.insert(0, "references")
    columns = [Column("cycles that differ", "name"), *numbers(*counts)]
    rows = [(joint.joint, *(getattr(joint, count) for count in counts)) for joint in report.joints]
    return report.sentence, _first(report.first), Table.of("", columns, rows)


def _first(first: ReplayDifference) -> str:
    place = f"first: cycle {first.cycle}, {first.time_s:.3f} s, "
    values = f"recorded {first.recorded}, replayed {first.replayed}"
    if first.joint is None and first.controller is None:
        return f"{place}{first.what}: {values}"
    if first.joint is None:
        return f"{place}controller {first.controller}: {values}"
    owner = f"controller {first.controller}" if first.controller else "no controller"
    return f"{place}{first.joint}, {owner}: {first.what}: {values}"
