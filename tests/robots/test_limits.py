"""A joint beyond its limit is driven back, also after its run; others: run/stories/joint_limits.txt."""

import itertools
import math
from pathlib import Path

import pytest
from tests.kit.line_faults import turn_by_hand
from tests.kit.virtual_run import VirtualRun

LIMIT = math.radians(60)
LOOK_MS = 50
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
    run = VirtualRun.of_text(tmp_path, ROBOT, 0.5)
    servo = run.servos["arm"]
    run.at(300, lambda: turn_by_hand(servo, math.pi + LIMIT + 0.5))
    run.sample([servo], LOOK_MS, 300.001)
    run.finish()
    run.buses[0].advance_to(run.clock.now_ns() + 2_000_000_000)
    angles = run.shaft(servo) - math.pi
    assert servo.torque_on
    assert angles[0] == pytest.approx(LIMIT + 0.5, abs=0.01)
    assert angles[-1] == pytest.approx(LIMIT, abs=0.01)
    steps = [before - after for before, after in itertools.pairwise(angles)]
    assert max(steps) < 0.6 * LOOK_MS * 1e-3
