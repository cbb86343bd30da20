"""Process table: state of a Linux process, and the runs on this computer with their processes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc")
# Beginning of a plan as JSON.
_ROBOT = re.compile(rb'\{"robot":"([^"\\]+)"')
UNKNOWN = "?"
"""State of a process whose entry cannot be read; it may be alive."""
_DEAD = "ZXx"
_STOPPED = "Tt"
SUPERVISOR = "supervisor"
_ROLES = {
    b"dxlrun.run.guardian": "guardian",
    b"dxlrun.run.loop_process": "loop",
    b"dxlrun.log.recorder": "recorder",
    b"dxlrun.remote": "gateway",
}
KIND = "--kind"
"""Argument of the processes of features, which is followed by the role."""


class ProcessStat(NamedTuple):
    """An entry of the process table (proc_pid_stat(5))."""

    state: str
    """One letter: R running, S and D waiting, T stopped by a signal, t by a debugger, Z and X dead."""
    parent: int
    start_ticks: int
    """Start time. It distinguishes processes that reuse an ID."""

    @property
    def is_dead(self) -> bool:
        """True when the process has exited, even if its parent has not reaped it."""
        return self.state in _DEAD

    @property
    def is_stopped(self) -> bool:
        """True when a signal or a debugger has stopped the process until it is continued."""
        return self.state in _STOPPED

    def has_ended(self, start_ticks: int) -> bool:
        """Return whether the process with this start time has exited, or its ID belongs to another one."""
        return self.state != UNKNOWN and (self.is_dead or self.start_ticks != start_ticks)


def read_stat(folder: Path) -> ProcessStat | None:
    """Return the entry of a process by its folder in /proc; None when the process does not exist.

    Only ENOENT and ESRCH prove that. After any other error, such as EMFILE, the state is `UNKNOWN`.
    """
    try:
        words = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
        return ProcessStat(words[0], int(words[1]), int(words[19]))
    except (FileNotFoundError, ProcessLookupError):
        return None
    except (OSError, ValueError, IndexError):
        return ProcessStat(UNKNOWN, 0, 0)


class RunProcess(NamedTuple):
    """A process of a run."""

    pid: int
    role: str
    stat: ProcessStat

    def __str__(self) -> str:
        return f"{self.role} (process {self.pid})"


class FoundRun(NamedTuple):
    """A run on this computer with its living processes, which share the memory of its plan."""

    robot: str
    processes: tuple[RunProcess, ...]
    runtime_directory: str
    """XDG_RUNTIME_DIR in the run's environment, where its gateway listens; empty when unset."""

    def process(self, role: str) -> RunProcess | None:
        """Return the run's process of this role; None when it has exited."""
        return next((one for one in self.processes if one.role == role), None)

    def memory(self, name: str) -> Path | None:
        """Return the path of the run's shared memory of this name; None when no process has it open."""
        found = (_memory_path(PROC / str(one.pid), name) for one in self.processes)
        return next((path for path in found if path is not None), None)


def is_alive(process: RunProcess) -> bool:
    """Return whether a process of a run is alive; its ID may belong to another process now."""
    stat, found = read_stat(PROC / str(process.pid)), process.stat
    # Without a start time, only the ID identifies the process.
    if stat is None or found.state == UNKNOWN:
        return stat is not None and not stat.is_dead
    return not stat.has_ended(found.start_ticks)


def robot_of(process: Path) -> str | None:
    """Return the name of the robot that a process runs, by its folder in /proc; None for other processes."""
    found = _plan_memory(process)
    return found[1] if found else None


def describe_run(process: Path) -> str:
    """Return a text about the run of a process and how to stop it, by its folder in /proc; empty: no run."""
    robot = robot_of(process)
    if robot is None:
        return ""
    return f"a run of {robot}; `dxlrun stop --robot {robot}` ends it, or Ctrl-C in its terminal"


def found_runs() -> list[FoundRun]:
    """Return the runs of this user (root: all users) on this computer, in any state."""
    runs: dict[tuple[int, int], tuple[str, list[RunProcess]]] = {}
    for folder in PROC.iterdir():
        if not folder.name.isdigit():
            continue
        memory, stat = _plan_memory(folder), read_stat(folder)
        if memory is not None and stat is not None and not stat.is_dead:
            key, robot = memory
            process = RunProcess(int(folder.name), _role(folder), stat)
            runs.setdefault(key, (robot, []))[1].append(process)
    found = ((robot, tuple(_members(processes))) for robot, processes in runs.values())
    return sorted(FoundRun(robot, members, _directory(members[0].pid)) for robot, members in found if members)


def _members(processes: list[RunProcess]) -> Iterator[RunProcess]:
    """Yield the members of a run. A supervisor is the parent of members, or executes dxlrun."""
    parents = {one.stat.parent for one in processes}
    for one in sorted(processes):
        if one.role:
            yield one
        elif one.pid in parents or _executes_dxlrun(PROC / str(one.pid)):
            yield one._replace(role=SUPERVISOR)


def _plan_memory(process: Path) -> tuple[tuple[int, int], str] | None:
    """Return device and inode of the plan's memory that a process has open, and the robot of the plan."""
    # The process may just have exited, or belong to another user.
    with suppress(OSError, UnicodeDecodeError):
        if descriptor := _memory_path(process, "plan"):
            match = _ROBOT.match(descriptor.read_bytes())
            inode = descriptor.stat()
            return ((inode.st_dev, inode.st_ino), match[1].decode()) if match else None
    return None


def _memory_path(process: Path, name: str) -> Path | None:
    """Return the path of a process' shared memory with this name; None without one."""
    # The process may just have exited, or belong to another user.
    with suppress(OSError):
        for descriptor in (process / "fd").iterdir():
            if os.readlink(descriptor).startswith(f"/memfd:dxlrun-{name} "):
                return descriptor
    return None


def _directory(pid: int) -> str:
    with suppress(OSError):
        for variable in (PROC / str(pid) / "environ").read_bytes().split(b"\0"):
            if variable.startswith(b"XDG_RUNTIME_DIR="):
                return os.fsdecode(variable.partition(b"=")[2])
    return ""


def _words(process: Path) -> list[bytes]:
    with suppress(OSError):
        return (process / "cmdline").read_bytes().split(b"\0")
    return []


def _role(process: Path) -> str:
    words = iter(_words(process))
    for word in words:
        if word == KIND.encode():
            return next(words, b"").decode()
        if word in _ROLES:
            return _ROLES[word]
    return ""


def _executes_dxlrun(process: Path) -> bool:
    return any(os.path.basename(word) == b"dxlrun" for word in _words(process)[:3])
