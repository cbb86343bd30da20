"""A robot of two joints, a log in which it moved, and foreign recordings written by other libraries."""

import pytest

from dxlrun.cli import main

ROBOT = """\
name: pair
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 100 us}
loop: {rate: 100}
joints:
  pan:
    bus: main
    id: 1
    model: XL430-W250
    reference: 180 deg
    direction: 1
    limits: {position: [-60 deg, 60 deg]}
  tilt:
    bus: main
    id: 2
    model: XL430-W250
    reference: 180 deg
    direction: 1
    limits: {position: [-90 deg, 90 deg], acceleration: 30 rad/s^2}
controllers:
  states: {type: joint_state_broadcaster}
  both: {type: joint_trajectory_controller, joints: [pan, tilt]}
"""
MOTION = """\
name: swing
motions:
  - controller: both
    start: 200 ms
    duration: 2 s
    samples: 40
    joints:
      pan: {position: 0.4 * sin(4 * t)}
      tilt: {position: 0.3 * cos(3 * t) - 0.3}
"""


@pytest.fixture(scope="session")
def swing(tmp_path_factory):
    """The log of the motion."""
    place = tmp_path_factory.mktemp("swing")
    (place / "pair.yaml").write_text(ROBOT + f"recording: {{directory: {place / 'logs'}}}\n")
    (place / "swing.yaml").write_text(MOTION)
    assert main([str(place / "pair.yaml"), "--virtual", "--play", str(place / "swing.yaml")]) == 0
    (log,) = (place / "logs").glob("*.mcap")
    return log


@pytest.fixture
def place(swing, tmp_path, monkeypatch):
    """A working directory with the robot and its log."""
    (tmp_path / "swing.mcap").symlink_to(swing)
    (tmp_path / "pair.yaml").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    return tmp_path
