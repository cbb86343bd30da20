"""Motions as commands of controllers, where more than one file or the trajectory itself is the point."""

import math

import numpy as np
import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun_controllers.laws.spline import SplineSample, Trajectory

GROUP = "    type: joint_group_posvel_controller\n"
SPARE_ACTIVE = PAIR.replace("active: false", "active: true").replace(GROUP, f"{GROUP}    active: false\n")
FORMULAS = """\
name: swing
motions:
  - controller: spare
    start: 3 s
    duration: 4 s
    samples: 5
    joints:
      left_arm_joint: {position: 0.5 * sin(t), velocity: 0.5 * cos(t)}
      right_arm_joint: {position: t / 10, velocity: 0.1}
"""


def test_formulas_for_a_trajectory_controller_become_one_trajectory():
    compiled = compile_text(SPARE_ACTIVE, FORMULAS)
    (command,) = compiled.plan.loop.commands
    assert (command.at_ns, command.kind, compiled.parts[0].points) == (3_000_000_000, "trajectory", 5)
    trajectory, sample = Trajectory(2), SplineSample(2)
    trajectory.load(np.frombuffer(command.data, dtype="<f8"), SplineSample(2))
    for t in range(5):
        trajectory.sample(1.0 + t, sample)  # it begins 1 s after it was handed over
        assert sample.position == pytest.approx([0.5 * math.sin(t), t / 10])
        if t < 4:  # at its end it rests
            assert sample.velocity == pytest.approx([0.5 * math.cos(t), 0.1])
    assert compiled.plan.loop.end_ns == 9_000_000_000  # 3 s start, 1 s lead, 4 s long, 1 s to settle


def test_long_formulas_of_many_samples_are_refused_before_they_are_evaluated(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dxlrun.compile.motion_samples.Expression.at", lambda *_: pytest.fail("evaluated"))
    long = FORMULAS.replace("samples: 5", "samples: 90_000").replace("t / 10", "+".join(["(t + t)"] * 120))
    (problem,) = problems_in(SPARE_ACTIVE, long)
    assert problem.what.endswith(
        "characters of formulas (samples x length, of all parts); 20000000 are allowed"
    )
    assert (problem.mark.line, problem.fix.partition(":")[0]) == (6, "lower samples, or shorten the formulas")
