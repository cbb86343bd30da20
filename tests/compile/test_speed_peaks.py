# ruff: noqa: E501 (a robot file and a sentence are read best in one line)
"""Speeds on the peak of a way: one rule for files, commands and motions that controllers play by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dxlrun.compile.robot_compiler import compile_robot
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.motion import read_motion
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError, Problem
from dxlrun.remote.preparation import Preparation, RefusedRequest

ROBOT = """
name: peaks
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}}
loop: {rate: 50}
joints:
  elbow: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, limits: {position: [-90 deg, 90 deg], velocity: 1 rad/s}}
controllers:
  arm: {type: joint_trajectory_controller, joints: [elbow]}
  poses:
    type: keyframe_player
    active: false
    joints: [elbow]
    motions:
      there: {steps: [{time: 2 s, pose: {elbow: 0 deg}}, {time: TIME, pose: {elbow: 0.8 rad}, interpolation: WAY}]}
"""
MOTION = """
name: peak
motions:
  - controller: arm
    points:
      - {time: 1 s, joints: {elbow: {position: 0 rad, velocity: 0 rad/s}}}
      - {time: 2 s, joints: {elbow: {position: 0.8 rad, velocity: 0 rad/s}}}
"""
SLOW = ROBOT.replace("TIME", "2 s").replace("WAY", "smooth")
PEAK = "elbow is commanded to 1.2 rad/s at"
"""0.8 rad in 1 s from rest to rest: 0.8 rad/s on average, 1.5 times as much in the middle."""
MORE = "more than 1 rad/s, its velocity limit"


def problems_of(folder: Path, robot: str, motion: str = "") -> list[Problem]:
    (folder / "robot.yaml").write_text(robot)
    (folder / "motion.yaml").write_text(motion)
    description = read_robot(folder / "robot.yaml", {})
    motions = [read_motion(folder / "motion.yaml", description.groups)] if motion else []
    try:
        return list(compile_robot(description, motions).warnings)
    except InputError as error:
        return list(error.problems)


def send(folder: Path, controller: str, kind: str, **fields: object) -> None:
    (folder / "robot.yaml").write_text(SLOW)
    loop = compile_robot(read_robot(folder / "robot.yaml", {}), []).plan.loop
    preparation = Preparation({joint.name: joint for joint in loop.joints}, load_plugins())
    plan = next(one for one in loop.controllers if one.name == controller)
    preparation.command(plan, kind, json.dumps(fields).encode()).require_within_limits()


def points(*rows: tuple[float, float]) -> list[dict[str, object]]:
    return [{"time": time, "positions": [at], "velocities": [0.0]} for time, at in rows]


def test_a_motion_file_is_judged_by_the_peak_between_its_points(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, SLOW, MOTION)
    assert (problem.severity, problem.mark.line) == ("warning", 7)
    assert problem.what == f"{PEAK} 1.500 s, {MORE}"
    assert "allow more time, 1.2 times as long" in problem.fix
    assert problems_of(tmp_path, SLOW, MOTION.replace("2 s", "2.21 s")) == []


def test_a_motion_file_beyond_the_servo_is_an_error(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, SLOW, MOTION.replace("2 s", "1.1 s"))
    assert (problem.severity, problem.what.split(",")[0]) == (
        "error",
        "elbow is commanded to 12 rad/s at 1.050 s",
    )
    assert "the top speed of its servo" in problem.what


def test_a_command_is_refused_by_the_same_sentence(tmp_path: Path) -> None:
    with pytest.raises(RefusedRequest) as refused:
        send(tmp_path, "arm", "trajectory", points=points((1.0, 0.0), (2.0, 0.8)))
    assert f"{PEAK} 1.500 s, from point 1 to 2, {MORE}: allow more time, 1.2 times as long" in str(
        refused.value
    )
    send(tmp_path, "arm", "trajectory", points=points((1.0, 0.0), (2.21, 0.8)))


def test_the_factor_of_speed_of_the_controller_counts(tmp_path: Path) -> None:
    faster = SLOW.replace("joints: [elbow]}", "joints: [elbow], speed: 2.0}")
    (problem,) = problems_of(tmp_path, faster, MOTION.replace("0.8 rad", "0.4 rad"))
    assert problem.what == f"{PEAK} 1.500 s, {MORE}"


def test_keyframes_of_a_file_are_judged_by_their_peaks(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, ROBOT.replace("TIME", "1 s").replace("WAY", "smooth"))
    assert (problem.severity, problem.mark.line) == ("warning", 14)
    assert problem.what == f"{PEAK} 2.500 s, on the way to step 2 of there, {MORE}"
    assert problems_of(tmp_path, ROBOT.replace("TIME", "1 s").replace("WAY", "linear")) == []
    assert problems_of(tmp_path, ROBOT.replace("TIME", "1.21 s").replace("WAY", "smooth")) == []


def test_keyframes_are_refused_where_the_speed_of_the_goal_makes_them_too_fast(tmp_path: Path) -> None:
    send(tmp_path, "poses", "play", motion="there")
    with pytest.raises(RefusedRequest) as refused:
        send(tmp_path, "poses", "play", motion="there", speed=2.0)
    assert f"{PEAK} 1.500 s, on the way to step 2 of there, {MORE}" in str(refused.value)


def test_a_way_back_to_the_first_pose_of_a_repetition_counts(tmp_path: Path) -> None:
    again = SLOW.replace("there: {", "there: {repeat: 9, ").replace(
        "time: 2 s, pose: {elbow: 0", "time: 1 s, pose: {elbow: 0", 1
    )
    (problem,) = problems_of(tmp_path, again)
    assert "elbow is commanded to -1.2 rad/s at 3.500 s, on the way to step 1 of there" in problem.what
