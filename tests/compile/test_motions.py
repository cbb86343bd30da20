"""Motions as commands of controllers, and formulas."""

import math
import re

import numpy as np
import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.compile.joints.poses import Poses, WrongPose
from dxlrun.compile.motion_samples import LONGEST_FORMULA, Expression
from dxlrun.features.feature import SolvedPose
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


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("t", 3.0),
        ("-t ** 2", -9.0),
        ("2 * pi", 2 * math.pi),
        ("sqrt(abs(-16)) + exp(0) - tan(0)", 5.0),
        ("min(t, 1) + max(t, 5)", 6.0),
        ("7 % 4 / 2", 1.5),
        ("t" + "+t" * 90, 273.0),
    ],
)
def test_operations(text: str, value: float):
    assert Expression(text).at(3.0) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("sin(x)", "unknown name x"),
        ("sinus(t)", "unknown function sinus"),
        ("__import__('os').getcwd()", "an operator is missing"),
        ("t.real", "Attribute"),
        ("'a' * 9", "not a real number"),
        ("1j * t", "not a real number"),
        ("True", "not a real number"),
        ("[t for t in (1,)]", "ListComp"),
        ("t if t > 1 else 0", "IfExp"),
        ("1 << 9", "LShift"),
        ("2(t)", "write 2 * (t)"),
        ("t = 1", "not an expression"),
        ("sin(t", "not an expression"),
        ("", "not an expression"),
        ("sin + t", "unknown name sin"),
        ("(" * 500 + "t" + ")" * 500, "at most"),
        ("(" * 450 + "t" + ")" * 450, "not an expression"),
        ("t" + "+t" * 300, "group long sums"),
        ("t" + "+t" * LONGEST_FORMULA, "at most"),
    ],
)
def test_what_is_no_formula_is_refused_with_a_sentence(text: str, says: str):
    with pytest.raises(ValueError, match=re.escape(says)):
        Expression(text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 / t", "division by zero"),
        ("t % 0", "division by zero"),
        ("sqrt(t - 1)", "undefined"),
        ("(t - 1) ** 0.5", "undefined"),
        ("exp(1000)", "too large"),
        ("9 ** 9 ** 9", "too large"),
        ("abs(" + "9" * 400 + ")", "too large"),
        ("1e308 * 10", "not finite"),
        ("sin(t, t)", "wrong number of arguments"),
    ],
)
def test_where_a_formula_has_no_value_it_says_why(text: str, says: str):
    with pytest.raises(ValueError, match=says):
        Expression(text).at(0.0)


def test_a_pose_without_positions_has_its_problem_as_data():
    with pytest.raises(WrongPose) as wrong:
        Poses({"up": SolvedPose({"a": 0.1})}).find_pose("up;\ndown; now")
    assert wrong.value.problems == (((), "the robot has no pose up;\ndown; now", "known: up"),)
