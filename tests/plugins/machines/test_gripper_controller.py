"""gripper_controller: widths, and stalls under noise; single cases are in `scripts/gripper.txt`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun_controllers.gripper_controller import GripperController

GRIPPER = {"joint": "gripper", "effort": 0.4, "speed": "2 rad/s"}


def test_progress_never_decreases():
    robot = standing(GripperController, GRIPPER).activate()
    goal = robot.ask("grip", position=-0.6)
    for _ in range(40):
        robot.states.position[0] = max(-0.6, robot.states.position[0] - 0.04)
        robot.step()
    assert len(goal.steps) > 3
    assert goal.steps == sorted(goal.steps)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), lost=st.floats(0, 0.4))
def test_an_object_is_felt_under_noise_and_lost_replies(seed, lost):
    robot = standing(GripperController, GRIPPER).activate()
    goal, noise = robot.ask("grip", position=0.6), np.random.default_rng(seed)
    for _ in range(60):
        robot.states.position[0] = min(robot.time_ns * 2e-9, 0.3) + 0.0015 * noise.integers(-1, 2)
        robot.states.velocity[0] = noise.normal(scale=0.2)  # four times the speed of a stall
        robot.states.valid[0] = noise.random() >= lost
        robot.step()
        if goal.outcome is not None:
            break
    assert goal.text.startswith("stalled, holds something at ")
    assert 0.33 <= robot.time_ns * 1e-9 <= 0.65


@settings(max_examples=100, deadline=None)
@given(width=st.floats(0.02, 0.078), shrinking=st.booleans())
def test_a_width_is_the_inverse_of_its_angle(width, shrinking):
    sign = -1 if shrinking else 1
    points = ((-1.0, 0.02), (0.1, 0.03), (0.4, 0.078))
    table = [{"angle": f"{sign * angle} rad", "width": f"{wide} m"} for angle, wide in points]
    robot = standing(GripperController, GRIPPER | {"widths": table})
    angle, effort = robot.prepare("grip", width=width)
    assert robot.controller._width(angle) == pytest.approx(width, abs=1e-12)
    assert effort == 0.4
