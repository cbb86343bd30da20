"""Unsteered runs: runs that start, end, have no gateway, or have lost processes. They can be ended.

The signals are those that the processes of a run send each other (`watch.py`), so torque goes off by the
run's own policy. This process never writes to a port.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass

from dxlrun.channels.heartbeat import GatewayAvailability, Phase, is_ending, is_starting, read_heartbeat
from dxlrun.errors import DxlrunError
from dxlrun.process_table import SUPERVISOR, FoundRun, RunProcess, found_runs, is_alive
from dxlrun.remote.sockets import listener, sockets, sockets_directory

_END_S = 30.0
"""Timeout for the steps of on_exit and the recorder on a slow disk."""
_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class UnsteeredRun:
    """A run whose gateway does not accept commands now."""

    run: FoundRun
    name: str
    """Name for `--robot`, with a process ID when another run has the robot's name."""
    problem: str
    """Reason why the run cannot be steered, as a clause; empty while it starts or ends."""

    def is_named(self, name: str) -> bool:
        """Return whether a name for `--robot` means this run; a name with a process ID is always accepted."""
        return name in {self.name, *(f"{self.run.robot}-{one.pid}" for one in self.run.processes)}

    @property
    def is_ours(self) -> bool:
        """True when the run uses our directory of sockets."""
        return _is_ours(self.run)


def unsteered_runs() -> list[UnsteeredRun]:
    """Return the runs that cannot be steered, including those of other runtime directories.

    A plain robot name belongs to the run that listens under it, else to the only run of that robot in our
    runtime directory, else to the only one on this computer.
    """
    listeners = {listener(path): name for name, path in sockets().items()}
    found = found_runs()
    unsteered = []
    for run in found:
        problem = _problem(run)
        listens_as = next((listeners[one.pid] for one in run.processes if one.pid in listeners), None)
        if problem or (listens_as is None and not _is_steerable(run)):
            ours = _is_ours(run)
            rivals = [one for one in found if one.robot == run.robot and (_is_ours(one) or not ours)]
            is_only = len(rivals) == 1 and run.robot not in listeners.values()
            name = listens_as or (run.robot if is_only else f"{run.robot}-{run.processes[0].pid}")
            unsteered.append(UnsteeredRun(run, name, problem))
    return unsteered


def describe_run(run: UnsteeredRun) -> str:
    """Return a sentence for a person who tries to steer the run."""
    if run.problem:
        fix = f"end it by `dxlrun stop --robot {run.name}`"
        return f"{run.name} runs but cannot be steered: {run.problem}; {fix}"
    return (
        f"{run.name} is starting; try again when it runs" if is_starting(run.run) else f"{run.name} is ending"
    )


def end_run(unsteered: UnsteeredRun, *, wait: bool) -> str:
    """Ask a run to stop normally, and continue its stopped processes; return a sentence.

    `wait` waits until all processes have exited. Raises DxlrunError when one does not.
    """
    run, name = unsteered.run, unsteered.name
    # A supervisor cuts torque at its second signal, and Ctrl-C may have been the first. The loop accepts any
    # number of signals, unless it has finished and is about to exit.
    asked = run.process("loop") or run.process(SUPERVISOR)
    if asked is not None and not is_ending(run):
        _send(asked, signal.SIGTERM)
    for one in run.processes:
        if one.stat.is_stopped:
            _send(one, signal.SIGCONT)
    why = f"; it could not be steered: {unsteered.problem}" if unsteered.problem else ""
    if not wait:
        return f"{name} is ending{why}"
    give_up = time.monotonic() + _END_S
    while left := [one for one in run.processes if is_alive(one)]:
        if time.monotonic() > give_up:
            raise DxlrunError(_not_ended(name, left))
        time.sleep(_POLL_S)
    return f"{name} has ended{why}"


def _problem(run: FoundRun) -> str:
    """Return the reason why a run cannot be steered and will not become steerable; empty otherwise.

    A supervisor that responds ends a run whose guardian or loop is dead or stopped.
    """
    supervisor, gateway = run.process(SUPERVISOR), run.process("gateway")
    if supervisor is not None and not supervisor.stat.is_stopped:
        if gateway is not None and gateway.stat.is_stopped:
            return f"its {gateway} is stopped"
        heartbeat = read_heartbeat(run)
        if heartbeat is None or is_ending(run):
            return ""
        return "it has no gateway" if heartbeat.steering is GatewayAvailability.IMPOSSIBLE else ""
    steering = (SUPERVISOR, "guardian", "loop", "gateway")
    gone = [role for role in steering if run.process(role) is None]
    stopped = [str(one) for one in run.processes if one.stat.is_stopped and one.role in steering]
    parts = [f"it has no {' and no '.join(gone)}"] if gone else []
    parts += (
        [f"its {' and '.join(stopped)} {'is' if len(stopped) == 1 else 'are'} stopped"] if stopped else []
    )
    return " and ".join(parts)


def _is_steerable(run: FoundRun) -> bool:
    heartbeat = read_heartbeat(run)
    if heartbeat is None or run.process("gateway") is None:
        return False
    return heartbeat.phase is Phase.RUNNING and heartbeat.steering is GatewayAvailability.POSSIBLE


def _is_ours(run: FoundRun) -> bool:
    return sockets_directory(run.runtime_directory) == sockets_directory()


def _not_ended(name: str, left: list[RunProcess]) -> str:
    names = " and ".join(map(str, left))
    pids = " ".join(str(one.pid) for one in left)
    return (
        f"{name}: {names} did not end within {_END_S:g} s and torque may be on; "
        f"switch the servos' power off, then `kill -9 {pids}`"
    )


def _send(process: RunProcess, number: signal.Signals) -> None:
    if is_alive(process):
        # The process may just have exited.
        with suppress(ProcessLookupError):
            os.kill(process.pid, number)
