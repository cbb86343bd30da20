"""Runs whose controllers change the modes of their servos: what a client sees, and the same in a replay."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.stories import replayed, send, switch, tell

from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log, read_log
from dxlrun_analysis.conduct.client_commands import client_commands
from dxlwire.modes import Mode

ROBOT = """\
name: wheels
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 100}
joints:
  left: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1, continuous: true}
  right: {bus: main, id: 2, model: XL430-W250, reference: 180 deg, direction: -1, continuous: true}
  arm: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1, limits: {effort: 1 A}}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [left, right]}
  arm: {type: joint_group_position_controller, joints: [arm]}
  pull: {type: joint_group_effort_controller, joints: [arm], active: false}
  push: {type: joint_group_pwm_controller, joints: [arm], active: false}
  grip: {type: joint_group_poseffort_controller, joints: [arm], active: false}
  turn: {type: joint_group_position_controller, joints: [left, right], active: false}
policies: {on_exit: hold}
"""
ARM = 2


STORY = {
    5: [send("drive", "velocities", 3.0, -2.0), send("arm", "positions", 0.4)],
    120: [switch(["pull"], ["arm"])],
    170: [send("pull", "efforts", -0.05)],
    180: [switch(["push"], ["pull"])],
    230: [send("push", "pwm", 0.3), switch(["turn"], ["drive"])],
    250: [switch(["grip"], ["push"])],
    300: [send("grip", "poseffort", 0.2, 0.3), send("turn", "positions", 12.0, -9.0)],
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    folder = tmp_path_factory.mktemp("modes")
    (folder / "wheels.yaml").write_text(ROBOT)
    return read_log(tell(folder / "wheels.yaml", STORY, folder / "run.mcap", seconds=6.0))


def test_a_servo_follows_in_every_mode_what_its_controller_wants(log: Log) -> None:
    assert {one.refusal for one in client_commands(log)} == {""}
    cycles = log.cycles
    arm = cycles["mode"][:, ARM]
    changes = arm[np.flatnonzero(np.diff(arm, prepend=0))]
    wanted = [Mode.POSITION, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION, Mode.POSITION]
    assert [mode for mode in changes.tolist() if mode] == wanted
    assert cycles["velocity"][225, :2] == pytest.approx([3.0, -2.0], abs=0.1)
    assert cycles["position"][110, ARM] == pytest.approx(0.4, abs=0.02)
    assert cycles["position"][-1] == pytest.approx([12.0, -9.0, 0.2], abs=0.05)
    assert np.nanmin(cycles["goal_effort"][:, ARM]) == -0.05
    assert np.nanmax(cycles["goal_pwm"][:, ARM]) == 0.3
    assert cycles["goal_effort"][500, ARM] == 0.3


def test_no_joint_has_a_goal_while_its_mode_changes(log: Log) -> None:
    cycles = log.cycles
    for name in ("position", "velocity", "effort", "pwm"):
        assert np.isnan(cycles[f"goal_{name}"][cycles["mode"] == Mode.UNKNOWN]).all()
    assert 0 < (cycles["mode"] == Mode.UNKNOWN).any(axis=1).sum() < 100


def test_no_joint_jumps_when_its_mode_changes(log: Log) -> None:
    """A position mode begins where the joint is, within what it turned since the last read."""
    cycles = log.cycles
    led = np.isin(cycles["mode"], (Mode.POSITION, Mode.EFFORT_POSITION))
    begins = led & ~np.vstack([led[:1], led[:-1]])
    assert begins.sum() == 4
    assert np.abs(cycles["goal_position"] - cycles["position"])[begins] == pytest.approx(0.0, abs=1e-9)


def test_wheels_that_are_held_at_the_end_stand(log: Log) -> None:
    assert log.cycles["velocity"][-1, :2] == pytest.approx([0.0, 0.0], abs=0.05)


def test_the_log_has_what_was_waited_for(log: Log) -> None:
    waits = [
        event.source
        for event in log.events
        if event.code == EventCode.MODE and event.text == "waits for the mode changes of its joints"
    ]
    assert waits == ["pull", "push", "turn", "grip"]


def test_the_replay_has_no_difference(log: Log) -> None:
    replayed(log.path)
