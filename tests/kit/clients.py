"""Runs of robot files on virtual time: by the commands in the motion files, or steered by a client."""

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace
from tests.kit.stories import Clients, ask, prepared

from dxlrun.channels.answers import Completion
from dxlrun.channels.commands import CommandMessage
from dxlrun.log.log_reader import Log, read_log
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import replay_log

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class TypedCommand:
    """`dxlrun ROBOT name:=value ... --play MOTION`, as a person would type it in the clone."""

    robot: Path
    arguments: dict[str, str]
    motion: Path


@dataclass(frozen=True)
class Run:
    robot: VirtualRobot
    log: Log


def command_of(motion: Path) -> TypedCommand:
    """Return the command that a motion file tells its reader to type; there is exactly one."""
    (line,) = [line for line in motion.read_text().splitlines() if line.startswith("#   dxlrun ")]
    _, _, robot, *words = shlex.split(line)
    *assignments, option, motion_name = words
    assert option == "--play"
    return TypedCommand(ROOT / robot, dict(word.split(":=") for word in assignments), ROOT / motion_name)


def played(directory: Path, command: TypedCommand, duration_s: float | None = None) -> Run:
    """Run a command on virtual time, not longer than `duration_s`."""
    log = directory / "run.mcap"
    robot = simulated_robot(
        command.robot, arguments=command.arguments, play=[command.motion], duration_s=duration_s, log=log
    )
    robot.run()
    return Run(robot, read_log(log))


@dataclass(frozen=True)
class Ask:
    """A command or a goal of a client, as it would send it; taken by the first cycle at or after `at_s`."""

    at_s: float
    controller: str
    kind: str
    command: dict[str, object]
    lease_s: float = 0.0


def clients_of(robot: VirtualRobot, asks: Sequence[Ask]) -> Clients:
    """Let clients ask when the time has come; commands go through the gateway's checks."""
    asked: dict[int, list[CommandMessage]] = {}
    for number, one in enumerate(sorted(asks, key=lambda one: one.at_s), 1):
        command = (
            prepared(robot, one.controller, one.kind, **one.command)
            if one.controller
            else ask(one.kind, one.command)
        )
        cycle = math.ceil(round(one.at_s * 1e9) / robot.plan.loop.period_ns)
        lease_ns = round(one.lease_s * 1e9)
        asked.setdefault(cycle, []).append(replace(command, number=number, lease_ns=lease_ns))
    return Clients(robot, asked)


def steered(
    directory: Path,
    robot: Path,
    duration_s: float,
    asks: Sequence[Ask] = (),
    *,
    arguments: dict[str, str] | None = None,
    before: Callable[[VirtualRobot], None] = lambda robot: None,
    play: Sequence[Path] = (),
) -> Run:
    """Run a robot file on virtual time while a client asks, and compare the run with its replay."""
    log = directory / "steered.mcap"
    virtual = simulated_robot(robot, arguments=arguments or {}, duration_s=duration_s, play=play, log=log)
    client = clients_of(virtual, asks)
    before(virtual)
    result = virtual.run()
    assert (result.reason, result.detail, virtual.failures) == ("ended", "", ())
    refused = {
        number: answer for number, answer in client.answers.items() if not isinstance(answer, Completion)
    }
    assert not refused, refused
    report = replay_log(log)
    assert (report.different, report.compared) == (0, report.cycles)
    return Run(virtual, read_log(log))
