"""`dxlrun ROBOT.yaml`: run a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.flags import Flag, Motions
from dxlrun.cli.inputs import compiled
from dxlrun.cli.terminal import out, say_error, say_warning
from dxlrun.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from dxlrun.dynamixel.bus_plan import BusPlan
    from dxlrun.run_summary import RunSummary

_MOST_MESSAGES = 100_000
"""A log of so many messages is analyzed in about two seconds; nobody wants to wait longer for the prompt."""


def run(
    robot: Path,
    /,
    *assignments: Annotated[str, Parameter(name="arg:=value")],
    duration: float | None = None,
    play: Motions = (),
    no_record: Flag = False,
    take_over: Flag = False,
    virtual: Flag = False,
    no_gateway: Flag = False,
    debug: Flag = False,
) -> int:
    """Run a robot until its motions have ended, or until Ctrl-C.

    Parameters
    ----------
    robot
        The robot file, for example robots/bioloid_torso.yaml.
    assignments
        Arguments of the robot file, for example port:=/dev/ttyUSB0.
    duration
        Stop after this many seconds.
    play
        Play this motion file; may be given several times.
    no_record
        Write no log.
    take_over
        Start although a servo has its torque on already.
    virtual
        Run on virtual time, as fast as the processor can; only with simulated buses.
    no_gateway
        Let nobody steer the run.
    debug
        Print the traceback of an error, and what the processes said.
    """
    result = compiled(robot, assignments, play, duration, None if virtual else _ask_servos)
    for warning in result.warnings:
        say_warning(str(warning))
    from dxlrun.run_summary import RunOptions

    options = RunOptions(record=not no_record, take_over=take_over, debug=debug, gateway=not no_gateway)
    console = out()
    if virtual:
        from dxlrun.virtual_run import run_virtual

        summary = run_virtual(result.plan, options)
    else:
        from dxlrun.supervisor import run_robot

        summary = run_robot(result.plan, options, console)
    show(summary, result.plan.robot, console)
    return summary.exit_code


def _ask_servos(buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    """Ask for the models of joints that say `model: auto`; most robots have none, so it is imported late."""
    from dxlrun.identification import ask_servos

    return ask_servos(buses, joints)


def _verdict(log: str, summary: RunSummary) -> tuple[str, ...]:
    """Return what the log says of the run, where reading it takes a moment only; else nothing."""
    if not summary.cycles or summary.messages > _MOST_MESSAGES:
        return ()
    from dxlrun.analysis.report import analyze_log

    try:
        return analyze_log(log).verdict.sentences
    except LogError as error:
        say_warning(str(error))
        return ()


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def show(summary: RunSummary, robot: str, console: Console) -> None:
    """Print how the run went: what failed and what was not granted to stderr, the rest to stdout."""
    for remark in summary.remarks:
        say_warning(f"{robot}: {remark}")
    for sentence in summary.sentences:
        say_error(f"{robot}: {sentence}")
    verdict = {0: "good", 130: "interrupted"}.get(summary.exit_code, "failed")
    console.print(
        f"{robot}: {verdict}. {summary.elapsed_s:.1f} s, {_counted(summary.cycles, 'cycle')}, "
        f"{_counted(summary.skipped, 'period')} skipped",
        soft_wrap=True,
    )
    if summary.log is not None:
        for sentence in _verdict(summary.log, summary):
            console.print(f"  {sentence}", markup=False, soft_wrap=True)
        messages = _counted(summary.messages, "message")
        console.print(f"log: {summary.log} ({messages})", markup=False, soft_wrap=True)
        console.print(f"next: dxlrun analyze {summary.log}", markup=False, soft_wrap=True)
