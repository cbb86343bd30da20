"""A small arm with a PID law, a short motion, a controller that makes trouble, and the command line."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

ROBOT = """name: arm
arguments:
  rate: {default: 100}
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {latency: 1 ms}, return_delay_time: 0 us}
loop: {rate: "${rate}"}
joints:
  elbow:
    bus: main
    id: 1
    model: XM430-W350
    reference: 180 deg
    direction: 1
    limits: {position: [-90 deg, 90 deg], velocity: 4 rad/s, effort: 1.2 A}
    simulation: {inertia: 0.004 kg m^2, gravity: 0.2 Nm}
controllers:
  arm: {type: joint_trajectory_controller, joints: [elbow], into: [arm_pid]}
  arm_pid:
    type: pid_controller
    joints: [elbow]
    command_interface: effort
    gains: {p: 6.0, i: 8.0, d: 0.15}
"""
MOTION = """name: lift
motions:
  - controller: arm
    points:
      - {time: 0.2 s, joints: {elbow: {position: 0 rad, velocity: 0 rad/s}}}
      - {time: 0.6 s, joints: {elbow: {position: 0.3 rad, velocity: 0 rad/s}}}
"""


class Files(NamedTuple):
    """A robot file and a motion in a directory of their own, which is the working directory."""

    robot: Path
    motion: Path


@pytest.fixture(scope="session")
def texts():
    """A robot file and a motion."""
    return ROBOT, MOTION


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = Files(Path("robot.yaml"), Path("motion.yaml"))
    found.robot.write_text(ROBOT)
    found.motion.write_text(MOTION)
    return found


@pytest.fixture
def sweep(files, dxlrun):
    """Run `dxlrun sweep` on the robot and its motion in this process."""
    return partial(dxlrun, "sweep", files.robot, "--play", files.motion)


PLUGIN = """import os, signal, time

import dxlrun


class Parameters(dxlrun.ParametersModel):
    trouble: str = "none"


class Troubled(dxlrun.Controller[Parameters]):
    Parameters = Parameters

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints=())

    def update(self, time_ns, period_ns):
        trouble = self.parameters.trouble
        if trouble == "raises":
            raise RuntimeError("out of ideas")
        if trouble == "crashes":
            os.kill(os.getpid(), signal.SIGSEGV)
        if trouble == "hangs":
            time.sleep(1000)
        if trouble == "slow":
            time.sleep(0.3)


@dxlrun.hookimpl
def dxlrun_contract():
    return dxlrun.CONTRACT_VERSION


@dxlrun.hookimpl
def dxlrun_controllers():
    return {"troubled": Troubled}
"""


@pytest.fixture(scope="session")
def plugin(tmp_path_factory):
    """A directory with a controller that makes trouble, as pip would install it."""
    directory = tmp_path_factory.mktemp("plugin")
    (directory / "troubled.py").write_text(PLUGIN)
    info = directory / "troubled-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: troubled\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dxlrun]\ntroubled = troubled\n")
    return directory
