import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

POSVEL = """\
name: wave
motions:
  - controller: arms
    start: 2 s
    points:
      - time: 0 s
        joints:
          left_arm_joint: {position: 10 deg, velocity: 1 rad/s}
          right_arm_joint: {position: 20 deg, velocity: 2 rad/s}
      - time: 1500 ms
        joints:
          right_arm_joint: {position: 30 deg, velocity: 3 rad/s}
"""
TRAJECTORY = """\
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


GROUP = "    type: joint_group_posvel_controller\n"
SPARE_ACTIVE = PAIR.replace("active: false", "active: true").replace(GROUP, f"{GROUP}    active: false\n")


def floats(data: bytes) -> list[float]:
    return list(np.frombuffer(data, dtype="<f8"))


def test_points_for_a_group_controller_become_one_command_each():
    plan = compile_text(PAIR, POSVEL).plan.loop

    first, second = plan.commands
    assert (first.at_ns, second.at_ns) == (2_000_000_000, 3_500_000_000)
    assert (first.controller, first.kind) == ("arms", "posvel")
    assert floats(first.data) == pytest.approx([math.radians(10), math.radians(20), 1.0, 2.0])
    # what the second point does not name keeps its target
    assert floats(second.data) == pytest.approx([math.radians(10), math.radians(30), 1.0, 3.0])
    assert second.origin.endswith("motion0.yaml:10:9")
    way_ns = round(math.radians(10) / 3.0 * 1e9)  # of the last 10 deg, at the speed of their command
    assert plan.end_ns == pytest.approx(4_500_000_000 + way_ns, abs=1)  # 1 s to settle


def test_formulas_for_a_group_controller_become_one_command_a_sample():
    motion = TRAJECTORY.replace("spare", "arms")

    commands = compile_text(PAIR, motion).plan.loop.commands

    assert [c.at_ns for c in commands] == [3_000_000_000 + i * 1_000_000_000 for i in range(5)]
    for t, command in enumerate(commands):
        expected = [0.5 * math.sin(t), t / 10, 0.5 * math.cos(t), 0.1]
        assert floats(command.data) == pytest.approx(expected)


def test_formulas_for_a_trajectory_controller_become_one_trajectory():
    from dxlrun_controllers.laws.spline import SplineSample, Trajectory

    compiled = compile_text(SPARE_ACTIVE, TRAJECTORY)

    (command,) = compiled.plan.loop.commands
    assert (command.at_ns, command.kind) == (3_000_000_000, "trajectory")
    trajectory, sample = Trajectory(2), SplineSample(2)
    trajectory.load(np.frombuffer(command.data, dtype="<f8"), SplineSample(2))
    for t in range(5):
        trajectory.sample(1.0 + t, sample)  # it begins 1 s after it was handed over
        assert sample.position == pytest.approx([0.5 * math.sin(t), t / 10])
        if t < 4:  # at its end it rests
            assert sample.velocity == pytest.approx([0.5 * math.cos(t), 0.1])
    # 3 s start, 1 s lead, 4 s long, 1 s to settle
    assert compiled.plan.loop.end_ns == 9_000_000_000
    assert compiled.parts[0].points == 5


def test_a_trajectory_that_begins_later_than_zero_needs_no_lead():
    motion = """\
    name: later
    motions:
      - controller: spare
        points:
          - {time: 2 s, joints: {left_arm_joint: {position: 0 rad}, right_arm_joint: {position: 0 rad}}}
    """

    assert compile_text(SPARE_ACTIVE, motion).plan.loop.end_ns == 3_000_000_000


def test_the_goal_time_of_the_controller_ends_the_part():
    text = SPARE_ACTIVE.replace("active: true\n", "active: true\n    tolerances: {goal_time: 5 s}\n")

    assert compile_text(text, TRAJECTORY).plan.loop.end_ns == 13_000_000_000


def test_duration_overrules_the_end_of_the_motions():
    assert compile_text(PAIR, POSVEL, duration_ns=7).plan.loop.end_ns == 7
    assert compile_text(PAIR).plan.loop.end_ns is None


def test_commands_of_several_files_are_sorted_by_time():
    late = POSVEL.replace("start: 2 s", "start: 20 s")

    times = [c.at_ns for c in compile_text(PAIR, late, POSVEL).plan.loop.commands]

    assert times == sorted(times)
    assert len(times) == 4


def test_motion_for_a_controller_that_still_plays_another_one_is_refused():
    (problem,) = problems_in(PAIR, POSVEL, POSVEL.replace("start: 2 s", "start: 2100 ms"))

    assert "starts at 2.1 s, but the motion at" in problem.what


def test_mistakes_of_form_of_robot_and_motion_are_reported_together_and_before_others():
    motion = POSVEL.replace("controller: arms", "controller: amrs", 1)
    assert motion != POSVEL

    found = problems_in(PAIR.replace("id: 2", "id: 999"), motion + "x: 1\n")
    assert [Path(p.mark.file).name for p in found] == ["robot.yaml", "motion0.yaml"]
    assert [p.what for p in problems_in(PAIR, motion + "x: 1\n")] == ["the file has an unknown key 'x'"]
    assert [p.what for p in problems_in(PAIR, motion)] == ["the robot has no controller amrs"]


def many(samples: int, formula: str = "sin(t)") -> str:
    part = """
  - controller: spare
    start: {start} s
    duration: 4 s
    samples: {samples}
    joints:
      left_arm_joint: {{position: "{formula}"}}
      right_arm_joint: {{position: "{formula}"}}
"""
    parts = "".join(
        part.format(start=10 * number, samples=count, formula=formula)
        for number, count in enumerate((20, samples))
    )
    return f"name: swing\nmotions:{parts}"


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (
            many(1_000_000),
            "swing has 2000040 targets (samples x joints, of all parts); 200000 are allowed",
        ),
        (
            many(90_000, "+".join(["(t + t)"] * 60)),
            "characters of formulas (samples x length, of all parts); 20000000 are allowed",
        ),
    ],
)
def test_what_would_take_minutes_is_refused_at_once(monkeypatch: pytest.MonkeyPatch, motion: str, says: str):
    monkeypatch.setattr("dxlrun.compile.motion_samples.Expression.at", lambda *_: pytest.fail("evaluated"))

    (problem,) = problems_in(PAIR, motion)

    assert says in problem.what
    assert problem.mark.line == 14  # the part with the most
    assert "lower samples" in problem.fix


TOO_FAST = """\
name: dash
motions:
  - controller: spare
    points:
      - time: 0 s
        joints:
          left_arm_joint: {position: 0 deg}
          right_arm_joint: {position: 0 deg}
      - time: 100 ms
        joints:
          left_arm_joint: {position: 57.3 deg}
          right_arm_joint: {position: 20 deg}
"""
"""The left arm at 10 rad/s, an AX-12A turns at 8.2 at most; the right one at 3.5."""


def test_a_trajectory_faster_than_the_servo_is_refused_also_without_a_velocity_limit():
    (problem,) = problems_in(SPARE_ACTIVE, TOO_FAST)
    assert problem.severity == "error"
    assert (problem.mark.line, problem.mark.column) == (11, 11)
    assert problem.what == (
        "left_arm_joint is commanded to 10 rad/s at 1.100 s, more than 8.238 rad/s, "
        "the top speed of its servo"
    )


@pytest.mark.parametrize("way", ["20", "-20"])
def test_a_trajectory_faster_than_the_files_limit_is_a_warning(way: str):
    limited = SPARE_ACTIVE.replace("60 deg]}", "60 deg], velocity: 3 rad/s}")
    (problem,) = problems_in(limited, TOO_FAST.replace("57.3", "40").replace("20 deg", f"{way} deg"))
    assert problem.severity == "warning"
    assert (
        "right_arm_joint is commanded to 3.491 rad/s at 1.100 s, more than 3 rad/s, its velocity"
        in problem.what
    )


def test_single_goals_of_a_group_controller_may_be_far_apart_but_their_speeds_are_checked():
    speeds = TOO_FAST.replace("deg}", "deg, velocity: 1 rad/s}").replace("spare", "arms")
    assert problems_in(PAIR, speeds) == ()
    (problem,) = problems_in(PAIR, speeds.replace("1 rad/s", "9 rad/s", 1))
    assert problem.severity == "error"
    assert "left_arm_joint is commanded to 9 rad/s at 0.000 s" in problem.what


def test_a_formula_faster_than_the_servo_is_refused():
    fast = TRAJECTORY.replace("t / 10, velocity: 0.1", "t / 10, velocity: 9")
    (problem,) = problems_in(SPARE_ACTIVE, fast)
    assert problem.severity == "error"
    assert "right_arm_joint is commanded to 9 rad/s" in problem.what
