"""Process table: reads from /proc the state of processes, and finds running runs of dxlrun."""

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
"""State letter for a process whose entry in /proc cannot be read; it may be alive."""
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
"""Command-line argument of a feature's process; the next argument is its role."""


class ProcessStat(NamedTuple):
    """State, parent and start time of a process, from /proc/PID/stat (proc_pid_stat(5))."""

    state: str
    """One letter: R running, S and D waiting, T stopped by a signal, t by a debugger, Z and X dead."""
    parent: int
    start_ticks: int
    """Start time in clock ticks after boot, which distinguishes processes that reuse a PID."""

    @property
    def is_dead(self) -> bool:
        """True if the process has exited, even if its parent has not reaped it."""
        return self.state in _DEAD

    @property
    def is_stopped(self) -> bool:
        """True if a signal or a debugger has paused the process."""
        return self.state in _STOPPED

    def has_ended(self, start_ticks: int) -> bool:
        """Return True if the process that started at this time has exited; its PID may be in use again."""
        return self.state != UNKNOWN and (self.is_dead or self.start_ticks != start_ticks)


def read_stat(folder: Path) -> ProcessStat | None:
    """Read a process's entry, by its folder /proc/PID; None if the process does not exist.

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
    """A living process of a run: PID, role (such as `loop` or `guardian`), and state."""

    pid: int
    role: str
    stat: ProcessStat

    def __str__(self) -> str:
        return f"{self.role} (process {self.pid})"


class FoundRun(NamedTuple):
    """A run on this computer: its robot, and its processes, which all have the memory of its plan open."""

    robot: str
    processes: tuple[RunProcess, ...]
    runtime_directory: str
    """XDG_RUNTIME_DIR of the run, the directory of its gateway's socket; empty if unset."""

    def process(self, role: str) -> RunProcess | None:
        """Return the run's process with a role such as `loop`; None if there is none (any more)."""
        return next((one for one in self.processes if one.role == role), None)

    def memory(self, name: str) -> Path | None:
        """Return the path in /proc of the run's shared memory `name`; None if no process has it open."""
        found = (_memory_path(PROC / str(one.pid), name) for one in self.processes)
        return next((path for path in found if path is not None), None)


def is_alive(process: RunProcess) -> bool:
    """Return True if this process of a run is still alive, and not another one with the same PID."""
    stat, found = read_stat(PROC / str(process.pid)), process.stat
    # Without a start time, only the ID identifies the process.
    if stat is None or found.state == UNKNOWN:
        return stat is not None and not stat.is_dead
    return not stat.has_ended(found.start_ticks)


def robot_of(process: Path) -> str | None:
    """Return the robot of the run to which a process belongs, by its folder in /proc; None if to none."""
    found = _plan_memory(process)
    return found[1] if found else None


def describe_run(process: Path) -> str:
    """Return a sentence on the run to which a process belongs and how to stop it; empty if to none."""
    robot = robot_of(process)
    if robot is None:
        return ""
    return f"a run of {robot}; stop it by `dxlrun stop --robot {robot}`, or Ctrl-C in its terminal"


def found_runs() -> list[FoundRun]:
    """Return all runs on this computer that this user can see (root: of all users)."""
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


def start_directories() -> set[str]:
    """Return XDG_RUNTIME_DIR of each process that reads a robot file for a run, and so has no plan yet.

    Processes of other users are not among them.
    """
    found = set()
    for folder in PROC.iterdir():
        # The command lines of other users can be read, but not whether their runs have a plan.
        if not folder.name.isdigit() or not os.access(folder / "fd", os.R_OK):
            continue
        if not _reads_robot_file(folder):
            continue
        stat = read_stat(folder)
        if stat is not None and not stat.is_dead and not stat.is_stopped and robot_of(folder) is None:
            found.add(_directory(int(folder.name)))
    return found


def _members(processes: list[RunProcess]) -> Iterator[RunProcess]:
    """Yield the processes that belong to a run, with their roles; others only share its memory."""
    parents = {one.stat.parent for one in processes}
    for one in sorted(processes):
        if one.role:
            yield one
        elif one.pid in parents or _executes_dxlrun(PROC / str(one.pid)):
            yield one._replace(role=SUPERVISOR)


def _plan_memory(process: Path) -> tuple[tuple[int, int], str] | None:
    """Return (device, inode) of the plan's shared memory that a process has open, and the robot's name."""
    # The process may just have exited, or belong to another user.
    with suppress(OSError, UnicodeDecodeError):
        if descriptor := _memory_path(process, "plan"):
            match = _ROBOT.match(descriptor.read_bytes())
            inode = descriptor.stat()
            return ((inode.st_dev, inode.st_ino), match[1].decode()) if match else None
    return None


def _memory_path(process: Path, name: str) -> Path | None:
    """Return the path in /proc of a process's shared memory `name`; None if it has none."""
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


def _reads_robot_file(process: Path) -> bool:
    """Return whether a command line is `dxlrun ROBOT.yaml`, of a run in real time.

    It begins with Python, unlike that of a parent such as `uv run` or `timeout`, which never has a plan.
    """
    words = _words(process)
    names = [os.path.basename(word) for word in words[:3]]
    if not names or not names[0].startswith(b"python") or b"dxlrun" not in names:
        return False
    file = words[names.index(b"dxlrun") + 1 :][:1]
    return any(one.endswith((b".yaml", b".yml")) for one in file) and b"--virtual" not in words
