"""`dxlrun ROBOT.yaml` and `dxlrun demo`: run a robot, and print the result."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.cli.inputs import (
    Assignment,
    DebugFlag,
    Flag,
    GatewayFlag,
    Motions,
    PageFlag,
    RecordFlag,
    Seconds,
    Without,
    compiled,
    examples_directory,
    read_models,
)
from dxlrun.errors import InputError, counted
from dxlrun.output.target import check_target
from dxlrun.output.terminal import out, print_error, print_warning, show_parts
from dxlrun.output.unblocked import leave_real_time, unblocked

if TYPE_CHECKING:
    from rich.console import Console

    from dxlrun.compile.robot_compiler import CompiledRobot
    from dxlrun.plan.recording_plan import RecordingPlan
    from dxlrun.plan.robot_plan import Plan
    from dxlrun.run.run_summary import RunOptions, RunSummary


DEMO = ("bioloid_torso.yaml", "motions/three_parts.yaml")
"""Robot file and motion file of `dxlrun demo`, in the directory of the examples."""
# On a busy machine, a run takes some seconds until it can be steered.
_START_S = 60.0
_POLL_S = 0.1
_SHOW_PAGE = (
    "import sys; from dxlrun.cli import main, run; sys.exit(main(['view', run.await_robot(sys.argv[1:])]))"
)
_WORDS = {0: "done", 130: "interrupted"}
_MOST_DELETED = 5
"""Upper limit of the deleted logs that are listed one by one; above it, one line has their number."""


@unblocked()
def run(
    robot: Path,
    /,
    *assignments: Assignment,
    duration: Seconds | None = None,
    play: Motions = (),
    without: Without = (),
    record: RecordFlag = True,
    take_over: Flag = False,
    virtual: Flag = False,
    ledger: Path | None = None,
    gateway: GatewayFlag = True,
    listen: str | None = None,
    verbose: Flag = False,
    debug: Flag = False,
) -> int:
    """Run a robot until its motions or its --duration have ended, or until Ctrl-C.

    Parameters
    ----------
    robot
        Robot file, for example robots/bioloid_torso.yaml.
    duration
        Duration of the run, s, or with a unit: 500ms, 2min.
    play
        Motion file, or name of a motion as for `dxlrun play`. Can be given several times.
    record
        Write a log.
    take_over
        Start even if the torque of a servo is enabled already.
    virtual
        Run on virtual time, as fast as the processor allows. Requires simulated buses, and --duration or
        --play.
    ledger
        Output file for the ledger of the simulated buses: every byte with its time, and every fault.
    gateway
        Accept commands during the run. With --no-gateway, the run cannot be steered.
    listen
        Address to listen at for clients on other computers: [NAME@]HOST:PORT. They connect by mutual TLS with
        certificates of `dxlrun keys`. NAME is the name in the robot's certificate, by default the name of the
        robot.
    verbose
        Print all real-time settings that the operating system granted, in addition to those that it refused.
    debug
        Print the traceback of an error, and the output of the processes.
    """
    leave_real_time()
    if virtual and duration is None and not play:
        raise InputError(
            "a run on virtual time needs an end, or its log fills the disk; give --duration SECONDS, or "
            "--play MOTION.yaml"
        )
    result = compiled(robot, assignments, play, duration, None if virtual else read_models, without=without)
    for warning in result.warnings:
        print_warning(str(warning))
    endless = next((part for part in result.parts if part.end_ns is None), None)
    if virtual and duration is None and endless is not None:
        raise InputError(
            f"{endless.file} loops until a cancel, and a run on virtual time cannot be cancelled; give "
            "--duration SECONDS"
        )
    if ledger is not None:
        if not result.plan.simulated:
            raise InputError(
                f"--ledger needs simulated buses, and {result.plan.robot} has none; give the argument "
                "port:=sim, or omit --ledger"
            )
        check_target(ledger)
    if listen is not None:
        _check_listen(listen, result.plan, served=gateway and not virtual)
    from dxlrun.run.run_summary import RunOptions

    options = RunOptions(
        record=record,
        take_over=take_over,
        debug=debug,
        verbose=verbose,
        ledger=ledger,
        gateway=gateway,
        listen=listen or "",
    )
    return _run_compiled(result, options, virtual=virtual)


def _run_compiled(robot: CompiledRobot, options: RunOptions, *, virtual: bool) -> int:
    """Run a compiled robot and print the result; return the exit code. Raises InputError without Linux."""
    console = out()
    if not virtual and sys.platform != "linux":
        raise InputError(
            f"a run in real time needs Linux, and this is {sys.platform}; give --virtual, and --duration or "
            "--play"
        )
    if virtual:
        from dxlrun.run.virtual_run import run_virtual

        summary = run_virtual(robot.plan, robot.plugins, options, console)
    else:
        from dxlrun.run.supervisor import run_robot

        summary = run_robot(robot.plan, options, console)
    return show_summary(summary, robot.plan, console)


@unblocked()
def demo(*, page: PageFlag = True, virtual: Flag = False, debug: DebugFlag = False) -> int:
    """Run a simulated torso that plays a motion of 35 s.

    The demo needs no hardware and no files.

    Parameters
    ----------
    page
        Show the robot on the page of `dxlrun view`, if that is installed.
    virtual
        Run on virtual time, as fast as the processor allows. The page is not shown then.
    """
    robot, motion = (examples_directory() / name for name in DEMO)
    from dxlrun.run.run_summary import RunOptions

    leave_real_time()
    # Warnings about the robot file are for its author, not for the user of the demo.
    result = compiled(robot, (), (motion,), None)
    with _page_beside(shown=page and not virtual):
        return _run_compiled(result, RunOptions(debug=debug), virtual=virtual)


@contextmanager
def _page_beside(*, shown: bool) -> Iterator[None]:
    """Start `dxlrun view` in another process for the next robot that starts; end it with the block."""
    from dxlrun.cli.verb_registry import packaged

    if not shown:
        yield
        return
    if "view" not in packaged():
        show_parts("to see the robot in 3-D on the page of `dxlrun view`: pip install dxlrun-view")
        yield
        return
    # Imported here because the import takes 5 ms.
    import subprocess

    from dxlrun.remote.sockets import running

    served = subprocess.Popen([sys.executable, "-P", "-c", _SHOW_PAGE, *running()])
    try:
        yield
    finally:
        served.terminate()
        served.wait()


def await_robot(others: Collection[str]) -> str:
    """Return the name of the first robot that starts and is not in `others`; exit with 1 when none does in 60
    s.
    """
    from dxlrun.remote.sockets import running

    for _ in range(round(_START_S / _POLL_S)):
        if started := set(running()) - set(others):
            return min(started)
        time.sleep(_POLL_S)
    sys.exit(1)


def _check_listen(text: str, plan: Plan, *, served: bool) -> None:
    """Raise InputError when `--listen` cannot work: no gateway, no valid certificate, or a port in use."""
    from dxlrun.remote.network.listener import Listener
    from dxlrun.remote.sockets import Address

    address = Address.parse(text, plan.robot)
    if not (served and plan.gateway):
        raise InputError("--listen needs the gateway of a run in real time; omit --no-gateway and --virtual")
    try:
        Listener.secured(address).close()
    except OSError as error:
        raise InputError(f"nothing can listen at {address.host}:{address.port}: {error}") from error


def show_summary(summary: RunSummary, plan: Plan, console: Console) -> int:
    """Print the result of a run: failures to stderr, verdict, log and hints to stdout.

    Return the exit code; it is 1 also when the verdict is bad.
    """
    robot = plan.robot
    for remark in summary.remarks:
        print_warning(f"{robot}: {remark}")
    from dxlrun.run.run_summary import run_verdict

    machine = summary.describe_machine(plan) if summary.refused_for_replies else ""
    for sentence in filter(None, (machine, *summary.sentences)):
        print_error(f"{robot}: {sentence}")
    verdict = run_verdict(summary, plan)
    lines = [f"{robot}: {_WORDS.get(verdict.exit_code, 'failed')}: {verdict.line}"]
    lines += [f"  {sentence}" for sentence in verdict.sentences if sentence != machine]
    if summary.log is not None:
        lines.append(_log_line(Path(summary.log), summary.messages))
        lines += [f"next: dxlrun analyze {summary.log}"] * bool(summary.cycles)
        lines += _disk_lines(Path(summary.log), plan.recording)
    show_parts(*lines, console=console)
    return verdict.exit_code


def _log_line(log: Path, messages: int) -> str:
    from rich.filesize import decimal

    from dxlrun.log.stored import bytes_of

    size = bytes_of(log)
    return f"log: {log} ({counted(messages, 'message', 'messages')}{f', {decimal(size)}' if size else ''})"


def _disk_lines(log: Path, recording: RecordingPlan) -> list[str]:
    """Delete the oldest logs beyond `recording.keep`, and return lines about them.

    Without that entry nothing is deleted; a line reports the total size when it is large.
    """
    from rich.filesize import decimal

    from dxlrun.log.stored import MUCH_BYTES, oldest_beyond, stored_logs

    folder = log.parent
    if recording.keep_bytes is None:
        size = sum(one.bytes for one in stored_logs(folder))
        if size <= MUCH_BYTES:
            return []
        command = (
            f"dxlrun logs {folder} --prune --keep {decimal(MUCH_BYTES).replace(' ', '').replace('.0', '')}"
        )
        return [
            f"the logs in {folder} have {decimal(size)}; delete the oldest by `{command}` (it asks first)"
        ]
    lines, deleted = [], 0
    for one in oldest_beyond(folder, recording.keep_bytes, [log]):
        try:
            one.delete()
        except OSError as error:
            lines.append(f"{one.path} is kept: {error.strerror or error}")
        else:
            deleted += 1
            lines.append(f"deleted {one.path} ({decimal(one.bytes)}) because of `recording: {{keep: ...}}`")
    if len(lines) > _MOST_DELETED:
        logs = counted(deleted, "oldest log", "oldest logs")
        lines = [f"deleted the {logs} in {folder} because of `recording: {{keep: ...}}`"]
    return lines
