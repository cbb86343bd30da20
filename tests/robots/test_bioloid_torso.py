"""The torso of the thesis: its table, its URDF, its controllers, its motions."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from numpy.typing import NDArray

from dxlrun.compile.robot_compiler import CompiledRobot, compile_files
from dxlrun_controllers.laws.spline import SplineSample, Trajectory

ROBOTS = Path(__file__).parents[2] / "robots"
Matrix = NDArray[np.float64]
FULL, ELBOW, PITCH = (-math.pi, math.pi), (-1.77, 1.77), (-1.3, 1.4)
# name, ID, reference deg, direction, URDF limit rad: the table of the thesis
TABLE = [
    ("left_shoulder_swing_joint", 1, 60, -1, FULL),
    ("left_shoulder_lateral_joint", 3, 150, -1, FULL),
    ("left_elbow_joint", 5, 150, -1, ELBOW),
    ("right_shoulder_swing_joint", 6, 240, 1, FULL),
    ("right_shoulder_lateral_joint", 2, 240, 1, FULL),
    ("right_elbow_joint", 4, 150, 1, ELBOW),
    ("head_pitch_joint", 20, 150, -1, PITCH),
    ("head_yaw_joint", 21, 150, 1, FULL),
]


@pytest.fixture(scope="module")
def torso() -> CompiledRobot:
    return compile_files(ROBOTS / "bioloid_torso.yaml", {}, [ROBOTS / "motions" / "three_parts.yaml"])


def test_the_joints_are_those_of_the_table_cut_to_their_reach(torso):
    servos = [(joint.plan.name, joint.servos[0].described) for joint in torso.joints]
    found = [(name, s.id, round(math.degrees(s.reference), 9), s.direction) for name, s in servos]
    assert found == [row[:4] for row in TABLE]
    assert {servo.model for _, servo in servos} == {"AX-12A"}
    assert [s.servo_id for s in torso.plan.buses[0].servos] == [row[1] for row in TABLE]
    for joint, (_, _, reference, direction, urdf) in zip(torso.plan.loop.joints, TABLE, strict=True):
        ends = sorted(direction * math.radians(theta - reference) for theta in (0, 300))
        assert joint.lower == pytest.approx(max(ends[0], urdf[0]))
        assert joint.upper == pytest.approx(min(ends[1], urdf[1]))


def left(t: float) -> list[float]:
    return [0.2 * (math.sin(2 * t) - math.sin(4 * t)) - 0.4] * 3


def right(t: float) -> list[float]:
    return [
        0.2 * (math.cos(t) - math.sin(2 * t)) - 0.4,
        0.2 * (math.sin(2 * t) - math.cos(1.5 * t)) - 0.4,
        0.2 * (math.sin(2 * t) - math.sin(t)) - 0.4,
    ]


def test_the_parts_start_one_after_the_other_and_follow_their_formulas(torso):
    starts: dict[str, int] = {}
    for command in torso.plan.loop.commands:
        starts.setdefault(command.controller, command.at_ns)
    assert starts == {"head": 0, "right_arm": 1_000_000_000, "left_arm": 3_000_000_000}
    assert torso.plan.loop.end_ns == 35_000_000_000
    commands = {c.controller: c for c in torso.plan.loop.commands if c.kind == "trajectory"}
    for name, formula, duration in (("left_arm", left, 30.0), ("right_arm", right, 20.0)):
        trajectory, sample = Trajectory(3), SplineSample(3)
        trajectory.load(np.frombuffer(commands[name].data, dtype="<f8"), SplineSample(3))
        for i in range(500):
            t = duration * i / 499
            trajectory.sample(1.0 + t, sample)
            assert sample.position == pytest.approx(formula(t), abs=1e-6)
        assert trajectory.duration_s == pytest.approx(1.0 + duration)


# The URDF


def child(element: Element, tag: str, attribute: str) -> str:
    found = element.find(tag)
    assert found is not None
    return found.attrib[attribute]


def numbers(element: Element, tag: str, attribute: str) -> list[float]:
    return [float(number) for number in child(element, tag, attribute).split()]


@pytest.fixture(scope="module")
def root() -> Element:
    return ElementTree.parse(ROBOTS / "urdf/bioloid_torso.urdf").getroot()  # noqa: S314 (our own file)


@pytest.fixture(scope="module")
def joints(root: Element) -> dict[str, Element]:
    """Joints by the link below them."""
    return {child(joint, "child", "link"): joint for joint in root.iter("joint")}


def pose(joints: dict[str, Element], link: str, **angles: float) -> Matrix:
    """Return the frame of a link in the world, shape (4, 4), at joint angles, rad; 0 where none is given."""
    from scipy.spatial.transform import Rotation

    if link not in joints:
        return np.eye(4)
    joint, frame, turn = joints[link], np.eye(4), np.eye(4)
    frame[:3, :3] = Rotation.from_euler("xyz", numbers(joint, "origin", "rpy")).as_matrix()
    frame[:3, 3] = numbers(joint, "origin", "xyz")
    if joint.get("type") == "revolute":
        axis = np.array(numbers(joint, "axis", "xyz"))
        turn[:3, :3] = Rotation.from_rotvec(axis * angles.get(joint.get("name", ""), 0.0)).as_matrix()
    return pose(joints, child(joint, "parent", "link"), **angles) @ frame @ turn


@pytest.mark.parametrize(
    ("swing", "lateral", "elbow"), [(0, 0, 0), (0.4, 0, 0), (0, -0.7, 0), (0.3, 0.5, -1.2)]
)
def test_equal_angles_make_mirror_images_of_the_arms(joints, swing, lateral, elbow):
    def hand(side: str) -> Matrix:
        angles = {"shoulder_swing": swing, "shoulder_lateral": lateral, "elbow": elbow}
        turned = {f"{side}_{name}_joint": angle for name, angle in angles.items()}
        away = 0.07 if side == "left" else -0.07  # the hand, m along the lower arm
        in_world = pose(joints, f"{side}_hand_link", **turned) @ np.array([away, 0.0, 0.0, 1.0])
        return np.linalg.inv(pose(joints, "torso_link")) @ in_world

    x, y, z, _ = hand("right")
    assert hand("left")[:3] == pytest.approx([-x, y, z], abs=1e-6)
