from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from dxlrun import Controller, Interfaces, ParametersModel
from dxlrun.compile import Compiled, compile_files, robot
from dxlrun.control.controllers.plugins import Offer, PlugIns, load_plugins
from dxlrun.errors import InputError, Problem
from dxlrun.run import virtual_run

ROBOT = """\
name: pair
buses:
  main: {port: /dev/ttyUSB0, protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  left_arm_joint:
    bus: main
    id: 1
    model: AX-12A
    reference: 60 deg
    direction: -1
  right_arm_joint:
    bus: main
    id: 2
    model: AX-12A
    reference: 240 deg
    direction: 1
    limits: {position: [-90 deg, 60 deg]}
controllers:
  states: {type: joint_state_broadcaster, rate: 25}
  arms:
    type: joint_group_posvel_controller
    joints: [left_arm_joint, right_arm_joint]
  spare:
    type: joint_trajectory_controller
    active: false
    joints: [left_arm_joint, right_arm_joint]
"""


@pytest.fixture
def robot_text() -> str:
    """A small robot in which everything is right; tests break one thing of it."""
    return ROBOT


@pytest.fixture
def compile_text(tmp_path: Path) -> Callable[..., Compiled]:
    """Compile the text of a robot file, and of motion files."""

    def compile_text(text: str, *motions: str, duration_ns: int | None = None) -> Compiled:
        robot = tmp_path / "robot.yaml"
        robot.write_text(text, encoding="utf-8")
        paths = []
        for number, motion in enumerate(motions):
            path = tmp_path / f"motion{number}.yaml"
            path.write_text(dedent(motion), encoding="utf-8")
            paths.append(path)
        return compile_files(robot, {}, paths, duration_ns)

    return compile_text


@pytest.fixture
def problems_in(compile_text: Callable[..., Compiled]) -> Callable[..., tuple[Problem, ...]]:
    """Return the problems of a text, errors and warnings."""

    def problems_in(text: str, *motions: str) -> tuple[Problem, ...]:
        try:
            return compile_text(text, *motions).warnings
        except InputError as error:
            return error.problems

    return problems_in


class PartParameters(ParametersModel):
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    exports: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    step: float = 0.0


class Part(Controller[PartParameters]):
    """A controller of any place in the graph: forwards its references, plus what it counts by itself."""

    Parameters = PartParameters

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(parameters.joints, parameters.command, parameters.exports, parameters.reads)

    def on_activate(self, time_ns):
        self.count = 0

    def update(self, time_ns, period_ns):
        self.count += 1
        references, commands = self.context.references, self.context.commands
        for interface in self.parameters.command:
            above = getattr(references, interface)
            own = np.full(len(above), self.count * self.parameters.step)
            getattr(commands, interface)[:] = own + np.where(np.isfinite(above), above, 0.0)


@pytest.fixture
def part_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the type `part`, to the compiler and to runs on virtual time."""
    offers = {**load_plugins().controllers, "part": Offer("part", Part, "elsewhere 2.1")}
    for room in (robot, virtual_run):
        monkeypatch.setattr(room, "load_plugins", lambda: PlugIns(offers, {}))
