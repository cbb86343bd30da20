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


UNITS = {
    "position": 2 * np.pi / 4096,
    "velocity": 0.229 * 2 * np.pi / 60,
    "effort": 2.69e-3,
    "pwm": 1 / 885,
}
"""One step of a goal on the wire, of an XM430."""
READ: dict[str, list[np.ndarray]] = {}
"""What each part found in `reads`, update by update; the newest run's."""


class PartParameters(ParametersModel):
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    exports: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    takeovers: tuple[str, ...] = ()
    steps: float = 0.0
    orientation: str = ""


class Part(Controller[PartParameters]):
    """A controller of any place in the graph: adds its own steps to what is commanded of it.

    A hundred-millionth more of them with each update shows which update a value is from.
    """

    Parameters = PartParameters

    @classmethod
    def interfaces(cls, parameters, joints):
        own = parameters
        return Interfaces(
            own.joints, own.command, own.exports, own.reads, own.motors, takeovers=own.takeovers
        )

    def on_activate(self, time_ns):
        self.updates = 0
        READ[self.context.name] = []

    def update(self, time_ns, period_ns):
        self.updates += 1
        READ[self.context.name].append(self.context.reads.copy())
        references, commands = self.context.references, self.context.commands
        for interface in self.parameters.command:
            above = getattr(references, interface)
            own = self.parameters.steps * (1 + self.updates * 1e-8) * UNITS[interface]
            getattr(commands, interface)[:] = own + np.where(np.isfinite(above), above, 0.0)


@pytest.fixture
def part_plugins(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[np.ndarray]]:
    """Offer the type `part`, to the compiler and to runs on virtual time; return what parts read."""
    offers = {**load_plugins().controllers, "part": Offer("part", Part, "elsewhere 2.1")}
    sensors = load_plugins().sensors
    for room in (robot, virtual_run):
        monkeypatch.setattr(room, "load_plugins", lambda: PlugIns(offers, {}, sensors=sensors))
    return READ
