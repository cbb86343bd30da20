"""The controller on simulated servos and virtual time: the same loop and the same bus as on a robot."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from dxlrun import InputError
from dxlrun.testing import plan_of, read_log, simulated_robot
from dxlrun_easing import Easing, PositionsCommand

HERE = Path(__file__).parents[1]
PERIOD_S = 0.02
TOP_STEP = math.radians(60) * PERIOD_S
"""What example.yaml allows in one cycle, rad."""


def test_it_arrives_and_is_never_faster_than_the_file_says(tmp_path: Path) -> None:
    log = tmp_path / "nod.mcap"
    robot = simulated_robot(HERE / "example.yaml", play=[HERE / "nod.yaml"], duration_s=4.0, log=log)
    assert robot.run().detail == ""
    assert robot.record.states.position == pytest.approx([math.pi / 3, math.pi / 12], abs=0.01)
    goals = read_log(log).cycles["goal_position"]
    steps = np.abs(np.diff(goals, axis=0))
    assert steps.max() == pytest.approx(TOP_STEP)
    assert len(goals) == 200


def test_without_a_command_it_holds() -> None:
    robot = simulated_robot(HERE / "example.yaml", duration_s=0.5)
    robot.run()
    assert robot.record.goals.position == pytest.approx(robot.record.states.position, abs=0.01)


def test_a_command_for_another_number_of_joints_is_refused() -> None:
    parameters = Easing.Parameters.model_validate({"joints": ["pan_joint", "tilt_joint"]})
    with pytest.raises(ValueError, match="1 positions for 2 joints"):
        Easing.prepare("positions", PositionsCommand(positions=(0.5,)), parameters)


def test_wrong_parameters_are_refused_with_their_place(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text((HERE / "example.yaml").read_text().replace("60 deg/s", "0 deg/s"))
    with pytest.raises(InputError, match=rf"{path}:12:\d+: controllers\.head\.speed"):
        plan_of(path)
