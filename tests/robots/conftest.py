"""The commands that stand in the motion files, and their runs on virtual time."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from dxlrun.log.reader import Log, read_log
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import simulated_robot

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Command:
    """`dxlrun ROBOT name:=value ... --play MOTION`, as a person would type it in the clone."""

    robot: Path
    arguments: dict[str, str]
    motion: Path


@dataclass(frozen=True)
class Run:
    """A run that is over."""

    robot: VirtualRobot
    log: Log


@pytest.fixture(scope="session")
def command_of() -> Callable[[Path], Command]:
    """Return the command that a motion file tells its reader to type; there is exactly one."""

    def command_of(motion: Path) -> Command:
        (line,) = [line for line in motion.read_text().splitlines() if line.startswith("#   dxlrun ")]
        _, _, robot, *words = shlex.split(line)
        *assignments, option, played = words
        assert option == "--play"
        return Command(ROOT / robot, dict(word.split(":=") for word in assignments), ROOT / played)

    return command_of


@pytest.fixture
def played(tmp_path: Path) -> Callable[..., Run]:
    """Run a command on virtual time, not longer than `duration_s`."""

    def played(command: Command, duration_s: float | None = None) -> Run:
        log = tmp_path / "run.mcap"
        robot = simulated_robot(
            command.robot,
            arguments=command.arguments,
            play=[command.motion],
            duration_s=duration_s,
            log=log,
        )
        robot.run()
        return Run(robot, read_log(log))

    return played
