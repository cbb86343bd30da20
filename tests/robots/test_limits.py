"""A joint beyond its limit is driven back, also after its run; others: run/stories/joint_limits.txt."""

import itertools
import math
from pathlib import Path

import pytest
from tests.kit.clients import steered
from tests.kit.line_faults import turn_by_hand

from dxlrun.run.virtual_run import VirtualRobot

LIMIT = math.radians(60)
LOOK_NS = 50_000_000
ROBOT = """\
name: one
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 20 us, adapter: {latency: 0 ms}}
loop: {rate: 100}
joints:
  arm: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
        simulation: {inertia: 0.02 kg m^2},
        limits: {position: [-60 deg, 60 deg], effort: 1.2 A}}
controllers: {mover: {type: joint_group_effort_controller, joints: [arm]}}
policies: {exit_timeout: 20 s, on_exit: hold}
"""


def test_a_joint_beyond_its_limit_is_driven_back_slowly_by_its_effort_and_by_hold(tmp_path: Path) -> None:
    """A push sends it beyond; the servo goes on by itself when the run is over."""
    angles = []

    def look(robot: VirtualRobot, t_ns: int) -> None:
        servo = robot.buses[0].servo(1)
        servo.advance_to(t_ns)
        angles.append(servo.shaft_angle - math.pi)

    def push(robot: VirtualRobot) -> None:
        servo = robot.buses[0].servo(1)
        robot.buses[0].at(300_000_000, lambda: turn_by_hand(servo, math.pi + LIMIT + 0.5))
        for t_ns in range(300_000_001, 600_000_000, LOOK_NS):
            robot.buses[0].at(t_ns, lambda t_ns=t_ns: look(robot, t_ns))

    (tmp_path / "robot.yaml").write_text(ROBOT)
    robot = steered(tmp_path, tmp_path / "robot.yaml", 0.5, before=push).robot
    end_ns = robot.clock.now_ns()
    for t_ns in range(end_ns, end_ns + 2_000_000_000, LOOK_NS):
        look(robot, t_ns)
    assert robot.buses[0].servo(1).torque_on
    assert angles[0] == pytest.approx(LIMIT + 0.5, abs=0.01)
    assert angles[-1] == pytest.approx(LIMIT, abs=0.01)
    steps = [before - after for before, after in itertools.pairwise(angles)]
    assert max(steps) < 0.6 * LOOK_NS * 1e-9
