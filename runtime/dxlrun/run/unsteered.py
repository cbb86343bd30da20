"""Runs that cannot be steered: no gateway, or one of their processes is dead or stopped. They can be ended.

The signals are those that the processes heed among themselves (`watch.py`), so torque goes off by the run's
own policy: this process never writes to a port.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress

from dxlrun.errors import DxlrunError
from dxlrun.process_table import SUPERVISOR, FoundRun, RunProcess, found_runs, is_alive

_END_S = 30.0
"""For the steps of on_exit, and for the recorder on a slow disk."""
_POLL_S = 0.05


def unsteered_runs() -> list[FoundRun]:
    """Return the runs that share our runtime directory and cannot be steered."""
    ours = os.environ.get("XDG_RUNTIME_DIR", "")
    return [run for run in found_runs() if run.problem and run.runtime_directory == ours]


def unsteered_run(robot: str) -> FoundRun | None:
    """Return the run of a robot that cannot be steered, whatever its runtime directory."""
    return next((run for run in found_runs() if run.robot == robot and run.problem), None)


def describe(run: FoundRun) -> str:
    """Return a sentence for a person who wants to steer it."""
    return f"{run.robot} runs but cannot be steered: {run.problem}; `dxlrun stop --robot {run.robot}` ends it"


def end_run(run: FoundRun, *, wait: bool) -> str:
    """Ask a run to end in order, and continue its stopped processes; return a sentence.

    `wait`: until all its processes have ended. Raises DxlrunError where one does not.
    """
    # a supervisor that is stopped would act when it is continued, but the loop is nearer to the torque
    supervisor, loop = run.process(SUPERVISOR), run.process("loop")
    asked = supervisor if loop is None or (supervisor and not supervisor.stat.is_stopped) else loop
    if asked is not None:
        _send(asked, signal.SIGTERM)
    for one in run.processes:
        if one.stat.is_stopped:
            _send(one, signal.SIGCONT)
    why = f"it could not be steered: {run.problem}"
    if not wait:
        return f"{run.robot} is ending; {why}"
    give_up = time.monotonic() + _END_S
    while left := [one for one in run.processes if is_alive(one)]:
        if time.monotonic() > give_up:
            raise DxlrunError(_not_ended(run.robot, left))
        time.sleep(_POLL_S)
    return f"{run.robot} has ended; {why}"


def _not_ended(robot: str, left: list[RunProcess]) -> str:
    names = " and ".join(map(str, left))
    pids = " ".join(str(one.pid) for one in left)
    return (
        f"{robot}: {names} did not end within {_END_S:g} s, so torque may be on; "
        f"switch the servos' power off, then `kill -9 {pids}`"
    )


def _send(process: RunProcess, number: signal.Signals) -> None:
    if is_alive(process):
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(process.pid, number)
