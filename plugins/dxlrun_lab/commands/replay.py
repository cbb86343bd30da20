"""`dxlrun replay`: runs the controllers of a log again with its inputs, or plays its motion on a robot."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import counted, print_warning, show_json, show_parts
from dxlrun.tooling.verbs import AssignmentOfItsOwn, DebugFlag, JsonFlag, parse_assignments
from dxlrun_lab.commands.on_robot import RobotFileArguments
from dxlrun_lab.commands.recorded_motions import (
    ALL_OF_IT,
    NOWHERE,
    PlaybackOptions,
    RecordedPart,
    play_recorded,
)

if TYPE_CHECKING:
    from dxlrun.tooling.output import Part
    from dxlrun_analysis.replay import ReplayDifference, ReplayReport

Settings = Annotated[
    tuple[str, ...], Parameter(name="--set", negative=(), show_default=False, allow_leading_hyphen=False)
]


def replay(
    log: Path,
    /,
    *assignments: AssignmentOfItsOwn,
    settings: Settings = (),
    code: Literal["current", "log"] | None = None,
    played_on: PlaybackOptions = NOWHERE,
    part: RecordedPart = ALL_OF_IT,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Run the controllers of a log again.

    They get the recorded inputs, and their commands and goals are compared with the log bit for bit. With
    --on, a robot plays the motion of a log, a foreign MCAP file or a ROS 2 bag. Ctrl-C brings the joints to
    rest and ends the motion.

    Parameters
    ----------
    log
        Log of a run, an .mcap file. With --on, also a foreign .mcap file, or the directory of a ROS 2 bag.
    assignments
        Other arguments for the robot file in the log, or for the robot file of --on.
    settings
        Other value for a parameter of a controller: CONTROLLER.PARAMETER=VALUE. Can be given several times.
    code
        Version of controller files (`./wave.py:Wave`) that differ between disk and log: current runs the
        files on the disk, log runs those in the log. Choose log only if you trust its source.
    """
    if played_on.on is not None:
        if settings:
            raise InputError(
                "--set and --on exclude each other: --on does not run the controllers of the log; omit one"
            )
        if code:
            raise InputError("--code and --on exclude each other; omit one")
        chosen = RobotFileArguments(played_on.on, assignments, ())
        return play_recorded(log, chosen, played_on, part, as_json=as_json)
    _refuse_playing(played_on, part)
    if not log.exists():
        raise InputError(f"log {log} not found; a run prints the path of its log when it ends")
    arguments = parse_assignments(assignments)
    import msgspec

    from dxlrun_analysis.replay import Setting, replay_log

    report = replay_log(log, [Setting.parse(text) for text in settings], arguments, code)
    warnings = [f"{report.robot}: {remark}" for remark in (*report.remarks, report.stopped) if remark]
    if report.unprepared:
        them = counted(report.unprepared, "command", "commands")
        warnings.append(f"{report.robot}: {them} replayed as recorded: the log lacks the original requests")
    exit_code = 0 if report.same else 1
    if as_json:
        content = msgspec.to_builtins(report) | {"same": report.same, "sentence": report.sentence}
        show_json(content, code=exit_code, errors=[report.sentence] * exit_code, warnings=warnings)
        return exit_code
    for warning in warnings:
        print_warning(warning)
    show_parts(*_replayed(report))
    return exit_code


def _refuse_playing(played_on: PlaybackOptions, part: RecordedPart) -> None:
    given = [
        f"--{option.name.rstrip('_')}"
        for values, usual in ((played_on, NOWHERE), (part, ALL_OF_IT))
        for option in fields(values)
        if getattr(values, option.name) != getattr(usual, option.name)
    ]
    if given:
        raise InputError(f"{', '.join(given)} can only be used with --on; add --on ROBOT.yaml")


def _replayed(report: ReplayReport) -> tuple[Part, ...]:
    from dxlrun.tooling.output import Column, Table, numbers

    if report.first is None:
        return (report.sentence,)
    counts = ["commands", "goals"]
    if any(joint.references for joint in report.joints):
        counts.insert(0, "references")
    columns = [Column("differing cycles", "name"), *numbers(*counts)]
    rows = [(joint.joint, *(getattr(joint, count) for count in counts)) for joint in report.joints]
    return report.sentence, _first(report.first), Table.from_rows("", columns, rows)


def _first(first: ReplayDifference) -> str:
    place = f"first: cycle {first.cycle}, {first.time_s:.3f} s, "
    values = f"recorded {first.recorded}, replayed {first.replayed}"
    if first.joint is None and first.controller is None:
        return f"{place}{first.what}: {values}"
    if first.joint is None:
        what = "" if first.what == "active" else f"{first.what}: "
        return f"{place}controller {first.controller}: {what}{values}"
    owner = f"controller {first.controller}" if first.controller else "no controller"
    return f"{place}{first.joint}, {owner}: {first.what}: {values}"
