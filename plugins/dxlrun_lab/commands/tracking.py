"""`dxlrun experiment tracking`: measures how well a joint follows a motion that is sent in four set-ups."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from dxlrun import InputError
from dxlrun.tooling.output import err, out, print_error, print_warning, show_json, show_parts, unblocked
from dxlrun.tooling.verbs import (
    Assignment,
    DebugFlag,
    JsonFlag,
    StressFlag,
    check_report,
    compiled,
    examples_directory,
    read_models,
    terminated_as_interrupted,
    write_report,
)

if TYPE_CHECKING:
    from dxlrun_lab.tracking.tracking_experiment import TrackingExperiment

experiment = App(name="experiment", help="Repeat a published experiment on this machine.")

_ACTIVE = ("position_trajectory:=false", "posvel_trajectory:=true")
"""Arguments of single_joint.yaml for the thesis' motion as positions and velocities"""
_NAMES = "sequential-normal,loop-normal,loop-realtime,sequential-realtime"


@experiment.command
@unblocked()
def tracking(
    robot: str | None = None,
    /,
    *assignments: Assignment,
    play: str | None = None,
    setups: str = _NAMES,
    stress: StressFlag = True,
    report: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Measure how well a motion is followed: by the loop, and by a sender that counts poses instead of time.

    The motion is sent once in each set-up, while other processes load cores, memory and disk. Each run leaves
    a log. Ctrl-C ends the run, and the results so far are kept.

    Parameters
    ----------
    robot
        Robot file. Default: single_joint.yaml of `dxlrun examples`.
    play
        Motion file, of one joint. Default: the tracking motion of single_joint.yaml, 30 s.
    setups
        Set-ups to measure, separated by commas.
    stress
        Load all cores, memory and disk, as other programs would.
    report
        HTML file for a report with all numbers and plots. Needs matplotlib: `pip install 'dxlrun[report]'`.
    """
    words = list(assignments)
    if robot is not None and ":=" in robot:
        words, robot = [robot, *words], None
    if report is not None:
        check_report(report)
    file = examples_directory() / "single_joint.yaml" if robot is None else Path(robot)
    motion = Path(play) if play else examples_directory() / "motions" / "single_joint_tracking.yaml"
    if robot is None or play is None:
        given = {word.partition(":=")[0] for word in words}
        words += [word for word in _ACTIVE if word.partition(":=")[0] not in given]
    from dxlrun_lab.tracking.setups import chosen, require_right

    found = chosen([name.strip() for name in setups.split(",") if name.strip()])
    if not found:
        raise InputError(f"--setups is empty; choose from {_NAMES}")
    prepared = compiled(file, words, [motion], None, read_models)
    require_right(found, prepared.plan)
    for warning in prepared.warnings:
        print_warning(str(warning))
    from dxlrun_lab.stress import Stress
    from dxlrun_lab.tracking.desired_motion import desired_motion
    from dxlrun_lab.tracking.tracking_experiment import run_experiment

    desired = desired_motion(motion, prepared.plan)
    console = err() if as_json else out()
    with terminated_as_interrupted():
        result = run_experiment(prepared.plan, desired, found, Stress(wanted=stress), console)
    _show(result, report, as_json=as_json)
    return result.exit_code


def _show(result: TrackingExperiment, report: Path | None, *, as_json: bool) -> None:
    from dxlrun_lab.tracking import tracking_report as results

    if report is not None and result.measured:
        write_report(report, results.page(result))
    if as_json:
        interrupted = ["interrupted"] * result.interrupted
        show_json(results.result(result), code=result.exit_code, errors=[*result.failures, *interrupted])
        return
    show_parts(*results.parts(result))
    if report is not None and result.measured:
        show_parts(f"report: {report}")
    for sentence in result.failures:
        print_error(f"dxlrun: {sentence}")
    if result.interrupted:
        print_error("interrupted")
