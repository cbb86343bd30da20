"""The torso's URDF: a tree with the thesis' joints, whose sides are mirror images."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from numpy.typing import NDArray

from dxlrun.compile.robot_compiler import compile_files

ROBOTS = Path(__file__).parents[2] / "robots"
Matrix = NDArray[np.float64]
LIMITS = {
    "left_shoulder_swing_joint": (-math.pi, math.pi),
    "left_shoulder_lateral_joint": (-math.pi, math.pi),
    "left_elbow_joint": (-1.77, 1.77),
    "right_shoulder_swing_joint": (-math.pi, math.pi),
    "right_shoulder_lateral_joint": (-math.pi, math.pi),
    "right_elbow_joint": (-1.77, 1.77),
    "head_pitch_joint": (-1.3, 1.4),
    "head_yaw_joint": (-math.pi, math.pi),
}


@pytest.fixture(scope="module")
def root() -> Element:
    return ElementTree.parse(ROBOTS / "urdf/bioloid_torso.urdf").getroot()  # noqa: S314 (our own file)


@pytest.fixture(scope="module")
def joints(root: Element) -> dict[str, Element]:
    """Joints by the link below them."""
    return {child(joint, "child", "link"): joint for joint in root.iter("joint")}


@pytest.fixture
def pose(joints: dict[str, Element]) -> Callable[..., Matrix]:
    """Return the frame of a link in the world, shape (4, 4), at joint angles, rad; 0 where none is given."""
    from scipy.spatial.transform import Rotation

    def pose(link: str, **angles: float) -> Matrix:
        if link not in joints:
            return np.eye(4)
        joint = joints[link]
        frame = np.eye(4)
        frame[:3, :3] = Rotation.from_euler("xyz", numbers(child(joint, "origin", "rpy"))).as_matrix()
        frame[:3, 3] = numbers(child(joint, "origin", "xyz"))
        turn = np.eye(4)
        if joint.get("type") == "revolute":
            axis = np.array(numbers(child(joint, "axis", "xyz")))
            turn[:3, :3] = Rotation.from_rotvec(axis * angles.get(joint.get("name", ""), 0.0)).as_matrix()
        parent: Matrix = pose(child(joint, "parent", "link"), **angles)
        return parent @ frame @ turn

    return pose


def child(element: Element, tag: str, attribute: str) -> str:
    found = element.find(tag)
    assert found is not None
    return found.attrib[attribute]


def numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]


def test_links_form_one_tree_below_the_world(root, joints):
    links = [link.attrib["name"] for link in root.iter("link")]

    assert len(links) == len(set(links))
    assert set(links) - set(joints) == {"world"}
    assert len(joints) == len(list(root.iter("joint"))) == len(links) - 1
    for link in joints:
        above, seen = link, set()
        while above in joints:
            assert above not in seen
            seen.add(above)
            above = child(joints[above], "parent", "link")
        assert above == "world"


def test_the_turning_joints_and_their_limits_are_the_thesis(joints):
    turning = {joint.attrib["name"]: joint for joint in joints.values() if joint.get("type") == "revolute"}

    assert set(turning) == set(LIMITS)
    for name, joint in turning.items():
        limits = float(child(joint, "limit", "lower")), float(child(joint, "limit", "upper"))
        assert limits == pytest.approx(LIMITS[name], abs=1e-6)


@pytest.mark.parametrize(
    ("swing", "lateral", "elbow"), [(0, 0, 0), (0.4, 0, 0), (0, -0.7, 0), (0.3, 0.5, -1.2)]
)
def test_equal_angles_make_mirror_images_of_the_arms(pose, swing, lateral, elbow):
    def hand(side: str) -> Matrix:
        angles = {"shoulder_swing": swing, "shoulder_lateral": lateral, "elbow": elbow}
        turned = {f"{side}_{name}_joint": angle for name, angle in angles.items()}
        away = 0.07 if side == "left" else -0.07  # the hand, m along the lower arm
        in_world: Matrix = pose(f"{side}_hand_link", **turned) @ np.array([away, 0.0, 0.0, 1.0])
        return np.linalg.inv(pose("torso_link")) @ in_world

    left, right = hand("left"), hand("right")
    assert left[:3] == pytest.approx([-right[0], right[1], right[2]], abs=1e-6)


def test_at_zero_the_arms_point_sideways(pose):
    hand = np.linalg.inv(pose("torso_link")) @ pose("left_lower_arm_link")

    assert hand[0, 3] == pytest.approx(0.032 + 0.044 + 0.0675, abs=1e-6)
    assert abs(hand[1:3, 3]) == pytest.approx([0.014, 0.0], abs=1e-6)


def test_the_urdf_and_the_robot_file_agree():
    warnings = compile_files(ROBOTS / "bioloid_torso.yaml", {}, []).warnings

    assert not any("URDF" in warning.what for warning in warnings)
