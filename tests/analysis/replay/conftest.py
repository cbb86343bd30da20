"""A small robot whose plug-in depends on every input, and its log."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.changed_logs import write_changed
from tests.kit.packages import plugin_folder
from tests.kit.virtual_run import VirtualRun

ROBOT = """\
name: pair
arguments:
  port: {default: sim, help: "serial port"}
  rate: {default: 50, help: "loop rate, Hz"}
  speed: {default: 6 rad/s, help: "velocity limit of the pan joint"}
buses:
  main:
    port: "${port}"
    protocol: 1.0
    baud_rate: 1_000_000
    return_delay_time: 100 us
    adapter: {latency: 1 ms}
loop: {rate: "${rate}"}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1, limits: {velocity: "${speed}"}}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
  nod: {bus: main, id: 8, model: AX-12A, reference: 150 deg, direction: -1}
controllers:
  states: {type: joint_state_broadcaster}
  head: {type: joint_trajectory_controller, command_interface: posvel, joints: [pan], rate: 25}
  all_inputs: {type: all_inputs, joints: [tilt, nod]}
"""
MOTION = """\
name: look
motions:
  - controller: head
    start: 200 ms
    points:
      - {time: 0 s, joints: {pan: {position: 0.6 rad}}}
      - {time: 400 ms, joints: {pan: {position: 0.9 rad}}}
      - {time: 600 ms, joints: {pan: {position: 0.8 rad}}}
"""
PLUGIN = '''\
"""A controller whose command depends on every input that it ever had."""
from dataclasses import dataclass

import numpy as np
from dxlrun import CONTRACT_VERSION, Controller, Floats, Interfaces, ParametersModel, hookimpl
from dxlrun.messages import Header


@dataclass
class State:
    header: Header
    number: int
    sum: Floats


class AllInputsParameters(ParametersModel):
    joints: tuple[str, ...]
    gain: float = 1e-6
    give_up_after: float | None = None


class AllInputs(Controller[AllInputsParameters]):
    Parameters = AllInputsParameters
    Topics = {"state": State}
    number = 0

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(parameters.joints, ("position", "velocity"))

    def on_activate(self, time_ns):
        self.sum = np.zeros(len(self.context.joints))
        self.take(time_ns, 0)
        self.context.publish("state", State(Header(), 0, self.sum))

    def on_deactivate(self, time_ns):
        self.context.publish("state", State(Header(), -1, self.sum))

    def take(self, time_ns, period_ns):
        states, goals = self.context.states, self.context.goals
        for values in (states.position, states.velocity, states.effort, states.valid, states.age_ns * 1e-7):
            self.sum = self.sum * 0.99 + values
        self.sum += goals.position + np.nan_to_num(goals.velocity) + time_ns * 1e-9 + period_ns * 1e-7

    def update(self, time_ns, period_ns):
        if self.parameters.give_up_after is not None and time_ns * 1e-9 > self.parameters.give_up_after:
            raise RuntimeError("out of ideas")
        self.take(time_ns, period_ns)
        self.number += 1
        self.context.publish("state", State(Header(), self.number, self.sum))
        self.context.commands.position[:] = np.sin(self.sum) * 0.1 + self.parameters.gain
        self.context.commands.velocity[1] = 1.0 + np.cos(self.sum[1])


@hookimpl
def dxlrun_contract():
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers():
    return {"all_inputs": AllInputs}
'''


@pytest.fixture(scope="session")
def plugin(tmp_path_factory):
    return plugin_folder(tmp_path_factory.mktemp("plugin"), "all_inputs", PLUGIN, "all-inputs")


@pytest.fixture(autouse=True)
def _installed(plugin, monkeypatch):
    monkeypatch.syspath_prepend(plugin)


@pytest.fixture(scope="session")
def robot_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "pair.yaml"
    path.write_text(ROBOT)
    path.with_name("look.yaml").write_text(MOTION)
    return path


@pytest.fixture
def run(robot_file, tmp_path):
    """Run the robot for a second on virtual time, return its log; `before` sees the robot before it runs."""

    def begin(before: Callable[[VirtualRun], None], robot: Path = robot_file, seconds: float = 1.0) -> Path:
        play = [robot_file.with_name("look.yaml")]
        one = VirtualRun(robot, tmp_path / "run.mcap", play=play, duration_s=seconds)
        before(one)
        return one.logged()

    return begin


@pytest.fixture
def changed(tmp_path):
    """Write a changed copy of a log; tests/kit/changed_logs.py has the changes."""
    return lambda path, *changes, gaps=(): write_changed(path, tmp_path / "changed.mcap", *changes, gaps=gaps)


@pytest.fixture(scope="session")
def pair_log(plugin, robot_file, tmp_path_factory):
    """The log of the robot's second, made once."""
    path = tmp_path_factory.mktemp("pair") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(plugin)
        motion = robot_file.with_name("look.yaml")
        return VirtualRun(robot_file, path, play=[motion], duration_s=1.0).logged()
