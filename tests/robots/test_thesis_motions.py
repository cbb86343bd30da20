"""The thesis' experiments on virtual time: steps of Figures 19 and 20, and the tracking motion."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.examples import command_of
from tests.kit.virtual_run import VirtualRun

from dxlrun.testing import Log
from dxlsim.motion.motor import motor_of
from dxlwire.control_table import find_table

pytestmark = pytest.mark.long

MOTIONS = Path(__file__).parents[2] / "robots" / "motions"
STEP_S = 3.0
REST = 3
"""Ticks from the goal at which friction lets them come to rest"""
CASES = [("single_joint_step", "joint", "MX-64"), ("whole_body", "head_yaw_joint", "AX-12A")]


def play(folder: Path, name: str, seconds: float | None = None) -> Log:
    """Run the command that a motion names; return its log."""
    robot, arguments, motion = command_of(MOTIONS / f"{name}.yaml")
    run = VirtualRun(robot, folder / "run.mcap", arguments=arguments, play=[motion], duration_s=seconds)
    return run.finish()


def step(log: Log, joint: str) -> tuple[Any, Any, Any]:
    """Return time since the step, s, position, rad, and speed, rad/s, of a joint from the step on."""
    cycles, row = log.cycles, log.joints.index(joint)
    t = (cycles["read_ns"] - cycles["scheduled_ns"][0]) * 1e-9 - STEP_S
    after = (t >= 0) & (t < STEP_S)
    return t[after], cycles["position"][after, row], cycles["velocity"][after, row]


@pytest.mark.parametrize(("name", "joint", "model"), CASES)
def test_a_step_of_the_position_alone_is_as_fast_as_the_servo_can(name, joint, model, tmp_path):
    t, q, speed = step(play(tmp_path, f"{name}_position"), joint)
    table = find_table(model, 1.0)

    fastest = motor_of(table).no_load_speed
    assert (q[0], q[-1]) == pytest.approx((-1.0, 1.0), abs=REST * table.rad_per_tick)
    on_the_way = (q > -0.5) & (q < 0.5)
    assert np.polyfit(t[on_the_way], q[on_the_way], 1)[0] == pytest.approx(fastest, rel=0.03)
    assert speed.max() == pytest.approx(fastest, rel=0.03)


def test_the_tracking_motion_keeps_its_time(tmp_path):
    """A motion that is sent by number, not by time, stretches: the thesis' old library by 5 s in 30 s."""
    cycles = play(tmp_path, "single_joint_tracking", 10.0).cycles
    t = (cycles["read_ns"] - cycles["scheduled_ns"][0]) * 1e-9 - 1.0
    moving = t > 0.5

    def wanted(delay: float) -> Any:
        return 0.5 * (np.sin(2 * (t - delay)) - np.sin(4 * (t - delay)))

    def error(delay: float) -> float:
        return float(np.sqrt(np.mean((cycles["position"][:, 0] - wanted(delay))[moving] ** 2)))

    assert error(0.0) < 0.056
    assert min(np.arange(0.0, 0.1, 0.005), key=error) < 0.04
    late = t > 8.0
    assert np.abs(cycles["position"][late, 0] - wanted(0.0)[late]).max() < 0.09
