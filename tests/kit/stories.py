"""Stories: what clients ask of a robot on virtual time, cycle by cycle, and the replay of such a run."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from dxlrun.channels.commands import CommandMessage, QueueInbox
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.log.log_reader import Log, read_log
from dxlrun.remote.preparation import Preparation
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlrun_analysis.replay import ReplayDifference, ReplayReport, Setting, replay_log

Asked = Mapping[int, Sequence[CommandMessage]]
"""Commands by the cycle that takes them."""


def ask(kind: str, data: object = None) -> CommandMessage:
    return CommandMessage(0, "", kind, b"" if data is None else msgspec.json.encode(data), "anna")


def send(controller: str, kind: str, *numbers: float, lease_ns: int = 0) -> CommandMessage:
    """Return a command for a controller, as it was prepared."""
    return CommandMessage(0, controller, kind, np.array(numbers).tobytes(), "anna", lease_ns)


def prepared(robot: VirtualRobot, controller: str, kind: str, **data: object) -> CommandMessage:
    """Return a command for a controller, prepared from what a client sends, as by the gateway."""
    loop = robot.plan.loop
    preparation = Preparation({joint.name: joint for joint in loop.joints}, load_plugins())
    plan = next(one for one in loop.controllers if one.name == controller)
    found = preparation.command(plan, kind, json.dumps(data).encode(), units=False)
    return CommandMessage(0, controller, kind, found.data, "anna")


def switch(activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> CommandMessage:
    return ask("switch", {"activate": activate, "deactivate": deactivate})


def rate(hz: float) -> CommandMessage:
    return ask("rate", {"rate": hz})


def torque(joints: Sequence[str], *, on: bool, release: bool = False) -> CommandMessage:
    return ask("torque", {"joints": joints, "on": on, "release": release})


class Clients(QueueInbox):
    """Ask what they ask in the cycle that the story says, or in the next one where that is skipped."""

    def __init__(self, robot: VirtualRobot, asked: Asked) -> None:
        super().__init__()
        self.record, self.asked, self._last = robot.record, asked, -1
        robot.robot.loop.steering.inbox = self

    def drain_commands(self) -> Sequence[CommandMessage]:
        for cycle in range(self._last + 1, self.record.cycle + 1):
            self.waiting.extend(self.asked.get(cycle, ()))
        self._last = self.record.cycle
        return super().drain_commands()


def tell(
    file: Path,
    asked: Asked,
    log: Path,
    *,
    seconds: float = 1.0,
    play: Sequence[Path] = (),
    before: Callable[[VirtualRobot], object] = lambda robot: None,
) -> Path:
    """Run a robot while clients ask of it; `before` sees it before it runs. Return the log."""
    log.unlink(missing_ok=True)
    robot = simulated_robot(file, play=play, duration_s=seconds, log=log)
    Clients(robot, asked)
    before(robot)
    robot.run()
    return log


def silence(robot: VirtualRobot, servos: Sequence[int], begin_ms: float, end_ms: float) -> None:
    """Let servos of the first bus say nothing for a time."""
    bus = robot.buses[0]
    for at_ms, silent in ((begin_ms, True), (end_ms, False)):
        bus.at(
            round(at_ms * 1e6),
            lambda silent=silent: [bus.servo(servo).silence(silent) for servo in servos],
        )


def replayed(path: Path) -> Log:
    """Return a log; its replay compares every cycle and finds no difference."""
    log, report = read_log(path), replay_log(path)
    assert (report.compared, report.different, report.first) == (len(log.cycles), 0, None)
    assert (report.fault, report.stopped, report.remarks) == ("", "", ())
    assert log.complete
    return log


def differing(path: Path, *settings: str) -> tuple[ReplayReport, ReplayDifference]:
    """Return the report of a replay, with other parameters, and the first difference, which there must be."""
    report = replay_log(path, [Setting.parse(text) for text in settings])
    assert not report.same
    assert report.first is not None
    return report, report.first
