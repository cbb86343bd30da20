# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
import json
import math

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in, robot_text


def test_a_right_file_has_no_problem():
    assert problems_in(PAIR) == ()


@pytest.mark.parametrize("loop", [3000, 7000, 30_000])
def test_rate_of_a_controller_divides_a_fast_loop(loop: int) -> None:
    """Its period is not a whole number of ns."""
    text = PAIR.replace("{rate: 50}", f"{{rate: {loop}}}").replace("rate: 25}", f"rate: {loop // 2}}}")
    assert f"rate: {loop // 2}" in text
    assert not [problem.what for problem in problems_in(text) if "of states" in problem.what]


MOTION = """\
name: nod
motions:
- controller: arms
  points:
  - {time: 1 s, joints: {arms: {position: 10 deg, velocity: 1 rad/s}, left_arm_joint: {position: 0 deg, velocity: 1 rad/s}}}
"""


def test_groups_stand_for_joints_in_the_plan() -> None:
    compiled = compile_text(robot_text("groups"), MOTION)
    plan, both = compiled.plan, ("left_arm_joint", "right_arm_joint")

    assert (plan.groups, compiled.report["groups"]) == ({"arms": both}, {"arms": both})
    assert [one.joints for one in plan.loop.controllers if one.command] == [both, both]
    assert "arms" not in plan.loop.controllers[1].parameters
    (command,) = plan.loop.commands
    assert json.loads(command.request)["positions"] == pytest.approx([0.0, math.radians(10)])
