"""A played motion of velocities: reached when the simulated shaft is at rest at its end."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot

ROBOT = """name: wheel
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}}}
loop: {rate: 50}
joints: {w: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1, continuous: true}}
controllers: {drive: {type: joint_group_velocity_controller, joints: [w]}}
"""
MOTION = """name: turn
motions:
  - controller: drive
    points:
      - {{time: 0 s, joints: {{w: {{velocity: 0.5 rad/s}}}}}}
      - {{time: 1 s, joints: {{w: {{velocity: {last} rad/s}}}}}}
"""


@pytest.mark.parametrize(("last", "status"), [(0.0, "reached"), (0.4, "missed"), (0.08, "missed")])
def test_motion_is_reached_only_when_its_joint_is_at_rest(tmp_path: Path, last: float, status: str) -> None:
    robot, motion, log = tmp_path / "robot.yaml", tmp_path / "turn.yaml", tmp_path / "run.mcap"
    robot.write_text(ROBOT)
    motion.write_text(MOTION.format(last=last))
    run = simulated_robot(robot, play=[motion], log=log)
    before: list[float] = []
    run.clock.call_at(1_600_000_000, lambda: before.append(run.buses[0].servo(1).shaft_angle))
    after: list[float] = []
    run.clock.call_at(1_800_000_000, lambda: after.append(run.buses[0].servo(1).shaft_angle))

    run.run()

    goals = run.events.goals
    assert (goals.asked, goals.reached) == (1, int(status == "reached"))
    assert [report.status for report in goals.failed] == [status] * (status == "missed")
    turned = after[0] - before[0]
    assert (abs(turned) > math.radians(0.5)) == (status == "missed")
    assert len(read_log(log).cycles) > 0
