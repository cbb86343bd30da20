"""The torso of the thesis: its table, its controllers, its motions."""

import math
from pathlib import Path

import numpy as np
import pytest

from dxlrun.compile.robot_compiler import CompiledRobot, compile_files
from dxlrun_controllers.laws.spline import SplineSample, Trajectory

ROBOTS = Path(__file__).parents[2] / "robots"

# name, ID, reference deg, direction, URDF limit rad: the table of the thesis
TABLE = [
    ("left_shoulder_swing_joint", 1, 60, -1, (-math.pi, math.pi)),
    ("left_shoulder_lateral_joint", 3, 150, -1, (-math.pi, math.pi)),
    ("left_elbow_joint", 5, 150, -1, (-1.77, 1.77)),
    ("right_shoulder_swing_joint", 6, 240, 1, (-math.pi, math.pi)),
    ("right_shoulder_lateral_joint", 2, 240, 1, (-math.pi, math.pi)),
    ("right_elbow_joint", 4, 150, 1, (-1.77, 1.77)),
    ("head_pitch_joint", 20, 150, -1, (-1.3, 1.4)),
    ("head_yaw_joint", 21, 150, 1, (-math.pi, math.pi)),
]


@pytest.fixture(scope="module")
def torso() -> CompiledRobot:
    return compile_files(ROBOTS / "bioloid_torso.yaml", {}, [ROBOTS / "motions" / "three_parts.yaml"])


def test_the_joints_are_those_of_the_table(torso):
    servos = [(joint.plan.name, joint.servos[0].described) for joint in torso.joints]
    found = [(name, s.id, round(math.degrees(s.reference), 9), s.direction) for name, s in servos]
    assert found == [row[:4] for row in TABLE]
    assert {servo.model for _, servo in servos} == {"AX-12A"}
    assert [s.servo_id for s in torso.plan.buses[0].servos] == [row[1] for row in TABLE]


def test_the_limits_are_those_of_the_urdf_cut_to_the_reach(torso):
    travel = math.radians(300)
    for joint, (_, _, reference, direction, urdf) in zip(torso.plan.loop.joints, TABLE, strict=True):
        ends = sorted(direction * (theta - math.radians(reference)) for theta in (0, travel))

        assert joint.lower == pytest.approx(max(ends[0], urdf[0]))
        assert joint.upper == pytest.approx(min(ends[1], urdf[1]))


def test_loop_and_bus(torso):
    loop, (bus,) = torso.plan.loop, torso.plan.buses

    assert loop.period_ns == 20_000_000
    assert (loop.scheduler.policy, loop.scheduler.priority, loop.scheduler.lock_memory) == (
        "round_robin",
        31,
        True,
    )
    assert (bus.port, bus.protocol, bus.baud_rate, bus.return_delay_ns) == ("sim", 1.0, 1_000_000, 500_000)
    assert torso.plan.arguments == {"port": "sim", "rate": "50"}


def test_the_independent_parts_are_active(torso):
    active = {c.name: c.joints for c in torso.plan.loop.controllers if c.active and c.command}

    assert active == {
        "head": ("head_pitch_joint", "head_yaw_joint"),
        "left_arm": tuple(row[0] for row in TABLE[:3]),
        "right_arm": tuple(row[0] for row in TABLE[3:6]),
    }
    assert {c.name for c in torso.plan.loop.controllers if not c.active} == {
        "whole_body_position",
        "whole_body_posvel",
        "whole_body_trajectory",
    }
    (broadcaster,) = [c for c in torso.plan.loop.controllers if c.publishes]
    assert (broadcaster.active, broadcaster.every) == (True, 1)


def test_the_only_warning_is_the_odd_twin(torso):
    (warning,) = torso.warnings

    assert warning.what.startswith(
        "right_shoulder_lateral_joint is not a mirror image of left_shoulder_lateral_joint"
    )


def test_each_arm_follows_its_formula(torso):
    def left(t: float) -> list[float]:
        return [0.2 * (math.sin(2 * t) - math.sin(4 * t)) - 0.4] * 3

    def right(t: float) -> list[float]:
        return [
            0.2 * (math.cos(t) - math.sin(2 * t)) - 0.4,
            0.2 * (math.sin(2 * t) - math.cos(1.5 * t)) - 0.4,
            0.2 * (math.sin(2 * t) - math.sin(t)) - 0.4,
        ]

    commands = {c.controller: c for c in torso.plan.loop.commands if c.kind == "trajectory"}
    for name, formula, duration in (("left_arm", left, 30.0), ("right_arm", right, 20.0)):
        trajectory, sample = Trajectory(3), SplineSample(3)
        trajectory.load(np.frombuffer(commands[name].data, dtype="<f8"), SplineSample(3))
        for i in range(500):
            t = duration * i / 499
            trajectory.sample(1.0 + t, sample)
            assert sample.position == pytest.approx(formula(t), abs=1e-6)
        assert trajectory.duration_s == pytest.approx(1.0 + duration)


def test_the_parts_start_one_after_the_other_and_end_after_35_seconds(torso):
    starts = {}
    for command in torso.plan.loop.commands:
        starts.setdefault(command.controller, command.at_ns)

    assert starts == {"head": 0, "right_arm": 1_000_000_000, "left_arm": 3_000_000_000}
    assert torso.plan.loop.end_ns == 35_000_000_000
