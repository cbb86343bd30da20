"""A joint is not called blocked where its tolerance, or that of its goal, allows the distance."""

from __future__ import annotations

from pathlib import Path

import pytest

from dxlrun.testing import simulated_robot
from dxlrun_analysis.report import analyze_log

ROBOT = """name: weak
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}}}
loop: {rate: 50}
joint_defaults: {bus: main, model: XL-320, reference: 150 deg, direction: 1, limits: {velocity: 3 rad/s}}
joints:
  a:
    id: 1
    limits: {position: [-120 deg, 120 deg]}
    simulation: {gravity: 0.12 Nm, inertia: 0.001 kg m^2, gravity_angle: -90 deg}
    TOLERANCE
controllers:
  arm: {type: joint_trajectory_controller, joints: [a], tolerances: {GOAL}}
"""
MOTION = """name: up
motions:
  - controller: arm
    points:
      - {time: 1 s, joints: {a: {position: 0 deg}}}
      - {time: 2 s, joints: {a: {position: 20 deg}}}
"""


@pytest.mark.parametrize(
    ("joint", "goal", "good"),
    [
        ("", "", False),
        ("tolerance: 10 deg", "", False),
        ("tolerance: 40 deg", "", True),
        ("tolerance: {position: inf, velocity: inf}", "", True),
        ("", "goal: 40 deg", True),
    ],
)
def test_joint_is_blocked_only_beyond_its_tolerance(
    tmp_path: Path, joint: str, goal: str, good: bool
) -> None:
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("TOLERANCE", joint).replace("GOAL", goal))
    (tmp_path / "up.yaml").write_text(MOTION)
    log = tmp_path / "run.mcap"
    simulated_robot(tmp_path / "robot.yaml", play=[tmp_path / "up.yaml"], log=log).run()

    verdict = analyze_log(log).verdict

    assert verdict.good == good, verdict.sentences
    first = verdict.sentences[0]
    assert ("1 of 1 goal reached" in first) == good
    still = {"stood_still", "follows_worse"}
    assert bool(still & {one.code for one in verdict.findings}) != good, verdict.sentences
