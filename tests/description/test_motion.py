# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import math

import pytest
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.description.motion import FormulaPart, PointsPart
from dxlrun.description.units import Measure

MOTION = """\
name: wave
motions:
  - controller: head
    start: 500 ms
    points:
      - {time: 1 s, joints: {yaw: {position: 90 deg, velocity: 0.5 rad/s}, pitch: {position: 0 rad}}}
      - {time: 2 s, joints: {yaw: {position: -1 rad, acceleration: 1 rad/s^2}}}
  - controller: arm
    duration: 30 s
    samples: 500
    joints:
      elbow: {position: 0.2*(sin(2*t) - sin(4*t)) - 0.4, velocity: cos(t), acceleration: -1}
      swing: {position: 0}
"""


def test_a_robot_file_is_no_motion_and_a_motion_no_robot() -> None:
    motion = "name: nod\nmotions:\n- {controller: c, points: [{time: 1 s, joints: {a: {position: 0 deg}}}]}\n"
    assert desk.refusals(motion) == [
        "robot.yaml:2:1: this is a motion file, not a robot file; run it with `dxlrun ROBOT.yaml --play robot.yaml`"
    ]
    assert desk.refusals("model: MX-64\ntorque_constant: 1.6 Nm/A\n") == [
        "robot.yaml:2:1: this is a motor file, not a robot file; name it in a robot file, at the joint: `motor: robot.yaml`"
    ]
    assert desk.motion_refusals(TORSO) == [
        "motion.yaml:1:1: this is a robot file, not a motion; run it with `dxlrun motion.yaml`, and give --play a motion file"
    ]
    assert len(desk.refusals("name: x\nmotions: []\njoints: {}\n")) > 1  # a robot with a key too much


def test_points_and_formulas_become_si_units() -> None:
    motion = desk.motion(MOTION).motion
    points, formulas = motion.motions
    assert isinstance(points, PointsPart)
    assert (points.controller, points.start) == ("head", 500_000_000)
    assert [point.time for point in points.points] == [1_000_000_000, 2_000_000_000]
    yaw = points.points[0].joints["yaw"]
    assert yaw.position == pytest.approx(math.pi / 2)
    assert (yaw.velocity, yaw.acceleration) == (Measure(0.5, "rad/s"), None)
    assert points.points[1].joints["yaw"].acceleration == Measure(1.0, "rad/s^2")
    assert [one.unit for one in yaw.quantities if one is not None] == ["rad", "rad/s"]
    assert isinstance(formulas, FormulaPart)
    assert (formulas.start, formulas.duration, formulas.samples) == (0, 30_000_000_000, 500)
    elbow = formulas.joints["elbow"]
    assert (elbow.position, elbow.velocity) == ("0.2*(sin(2*t) - sin(4*t)) - 0.4", "cos(t)")
    assert elbow.acceleration == "-1"
    assert formulas.joints["swing"].position == "0"


DAMAGES = [
    ("time: 1 s", "time: §1", "motions[0].points[0].time: 1 has no unit; write a duration"),
    ("position: 90 deg", "position: §90", "motions[0].points[0].joints.yaw.position: 90 has no unit; write an"),
    ("velocity: 0.5 rad/s", "velocity: §0.5 rad", "motions[0].points[0].joints.yaw.velocity: '0.5 rad' has the wrong unit"),
    ("{position: 0 rad}", "§{}", "motions[0].points[0].joints.pitch: the target is empty; give it"),
    ("{time: 2 s, ", "§{", "motions[0].points[1] has no time; add `time: 1 s`"),
    ("{time: 2 s, ", "{time: 2 s, §tiem: 3, ", "motions[0].points[1] has an unknown key 'tiem'; did you mean time?"),
    ("start: 500 ms", "§samples: 5", "motions[0].samples is not allowed here; write either points, or"),
    ("start: 500 ms", "§strat: 1 s", "motions[0] has an unknown key 'strat'; did you mean start?"),
    ("samples: 500", "samples: §1", "motions[1].samples is 1, but must be at least 2; write"),
    ("samples: 500", "samples: 500\n    §smaples: 500", "motions[1] has an unknown key 'smaples'; did you mean samples?"),
    ("controller: arm\n    duration: 30 s", "§controller: arm", "motions[1] has no duration; add `duration: 20 s`"),
    ("duration: 30 s", "duration: §0 s", "motions[1].duration is 0 s, but must be greater than 0; write"),
    ("velocity: cos(t)", "velocity: §[t]", "motions[1].joints.elbow.velocity is a list, but must be text; write"),
    ("{position: 0}", "{position: §true}", "motions[1].joints.swing.position is true, but must be text; put"),
    ("swing: {position: 0}", "§swing: {velocity: 0}", "motions[1].joints.swing has no position; add"),
    ("name: wave", "name: §${x}", "this file cannot contain ${...}; write the value"),
    ("name: wave\n", "§", "the file has no name; add"),
    ("name: wave\n", "name: wave\n§include: []\n", "the file has an unknown key 'include'; remove it"),
]  # fmt: skip


@pytest.mark.parametrize(("right", "wrong", "expected"), DAMAGES)
def test_each_mistake_is_named_where_it_stands(right: str, wrong: str, expected: str) -> None:
    text, place = desk.pointed(MOTION, right, wrong)
    (problem,) = desk.motion_refusals(text)
    assert problem.startswith(f"motion.yaml:{place}: {expected}")


def test_a_part_that_is_neither_points_nor_formulas_is_refused() -> None:
    assert len(desk.motion_refusals("name: x\nmotions: [{controller: a}]\n")) == 3
    assert desk.motion_refusals("name: x\nmotions: [5]\n") == [
        "motion.yaml:2:11: motions[0] is 5, but must be a mapping;"
        " write `key: value` lines below it, or {key: value, ...} after it"
    ]
    assert desk.motion_refusals("name: x\nmotions: []\n") == [
        "motion.yaml:2:10: motions has too few entries; write at least 1"
    ]
