"""Measuring: one run of a sweep, on virtual time, without a log; a task holds all that the run needs."""

from __future__ import annotations

import faulthandler
import os
import platform
import time
from collections.abc import Iterator, Set
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import msgspec

from dxlrun.errors import DxlrunError
from dxlrun.plan.robot_plan import Plan, from_json
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.simulation.bus.ledger import Ledger
from dxlrun_lab.desired import DesiredPath
from dxlrun_lab.sweep.scores import CycleMemory, Scores

HUNG = 2.0
"""A run that has not ended after so many times its time limit does no more cycles: its process ends."""
SET_UP_S = 60.0
"""So long it may take to load the controllers and to build the robot, before the run."""

_PYTHON = "Python"

Status = Literal["measured", "refused", "failed", "too long", "crashed"]
"""refused: the robot file does not allow the point; failed: the run did, or the robot in it; crashed: its
process ended."""
AGAIN: tuple[Status, ...] = ("too long", "crashed")
"""May go otherwise with more time or memory: measured again in a continued sweep."""


class Task(msgspec.Struct, frozen=True):
    """One run, as it is sent to a worker."""

    run: str
    """Hash of all that the run depends on."""
    plan: bytes
    """JSON"""
    paths: tuple[DesiredPath, ...]
    time_limit_s: float


class Measured(msgspec.Struct, frozen=True):
    """What became of a run."""

    status: Status
    reason: str = ""
    """One sentence where it was not measured."""
    scores: Scores | None = None


class _TooLongError(Exception):
    """A run is over its time limit."""


def versions_for(plan: Plan) -> dict[str, str]:
    """Return the versions on which scores of a plan depend: dxlrun, its controllers', numpy and Python.

    Behind a `+` is the checksum of the code of dxlrun or of a plug-in: it changes while it is worked on, and
    its version does not.
    """
    controllers = {controller.distribution.split(" ")[0] for controller in plan.loop.controllers}
    names = ("dxlrun", *sorted(controllers - {"dxlrun", ""}), "numpy", _PYTHON)
    return {name: _installed(name) for name in names}


@cache
def _installed(name: str) -> str:
    """Return a version; of a package that offers controllers with the checksum of its code."""
    if name == _PYTHON:
        return ".".join(platform.python_version_tuple()[:2])
    try:
        found = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return "none"
    modules = {point.module.partition(".")[0] for point in found.entry_points if point.group == "dxlrun"}
    if name == "dxlrun":
        modules.add(name)
    return f"{found.version}+{code_checksum(modules)}" if modules else found.version


def code_checksum(modules: Set[str]) -> str:
    """Return a checksum of the files of some modules, but for what is compiled on each machine."""
    whole = sha256()
    for module in sorted(modules):
        spec = find_spec(module)
        if spec is None:
            continue
        places = spec.submodule_search_locations or ([spec.origin] if spec.origin else [])
        for place in map(Path, places):
            files = [place] if place.is_file() else place.rglob("*")
            for path in sorted(path for path in files if path.is_file()):
                if path.suffix not in (".pyc", ".so"):
                    whole.update(path.relative_to(place.parent).as_posix().encode() + b"\0")
                    whole.update(sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:8]


def measure(task: Task) -> Measured:
    """Run a task; whatever goes wrong in it is its result, but for a crash of the process."""
    try:
        return _run(task)
    except _TooLongError:
        return Measured("too long", f"it took longer than {task.time_limit_s:g} s")
    except DxlrunError as error:
        return Measured("failed", " ".join(error.sentences))
    except MemoryError:
        return Measured("failed", "there was not enough memory")
    except Exception as error:  # a plug-in's mistake is its run's result
        return Measured("failed", f"{type(error).__name__}: {error}".splitlines()[0])


def _run(task: Task) -> Measured:
    plan = from_json(task.plan)
    memory = CycleMemory(plan, task.paths)
    with _ended_when_hung(SET_UP_S):
        robot = VirtualRobot(plan, ledger=Ledger(keep=False), watch=memory.watch)
    servos = tuple(servo for bus in robot.buses for servo in bus.servos)

    def ran(cycles: int, skipped: int) -> None:
        memory.take(robot.record, servos)
        if time.monotonic() > until:
            raise _TooLongError

    robot.sinks.progress = ran
    until = time.monotonic() + task.time_limit_s
    with _ended_when_hung(HUNG * task.time_limit_s):
        result = robot.run()
    if result.reason == "fault":
        return Measured("failed", result.detail)
    errors = sum(group.count for group in robot.events.errors)
    return Measured("measured", "", memory.scores(sum(result.invalid), errors))


@contextmanager
def _ended_when_hung(seconds: float) -> Iterator[None]:
    """End this process if the context is not left in time: nothing else ends a thread in foreign code."""
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
