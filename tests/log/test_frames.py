"""/tf and /tf_static: what other programs read of them; rate, stamps, and what is unknown."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from msgspec.structs import replace
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from tests.kit.campaigns import campaign
from tests.kit.decoded import decode_log

from dxlrun.channels.cycle import CycleRecord
from dxlrun.description.frames.tree import ORIENTATION, FramesPlan, FrameTree
from dxlrun.log import schemas
from dxlrun.log.log_reader import open_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.packing.frame_messages import FrameMessages
from dxlrun.log.schemas import LogHeader
from dxlrun.testing import read_log, simulated_robot
from dxlsim.geometry.urdf import read_urdf

ROBOTS = Path(__file__).parents[2] / "robots"
TORSO = ROBOTS / "urdf/bioloid_torso.urdf"
ROUNDED = 1e-6
"""Difference to the exact pose, of which the log has quaternions in steps of 2**-24."""
STORE = get_typestore(Stores.ROS2_HUMBLE)
Matrix = NDArray[np.float64]
Transforms = dict[tuple[str, str], Matrix]


def matrix(transform: Any) -> Matrix:
    """Return translation and rotation of a decoded message as a homogeneous matrix."""
    at, turn = transform.translation, transform.rotation
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    found[:3, 3] = at.x, at.y, at.z
    return found


def transforms(message: Any) -> Transforms:
    return {
        (each.header.frame_id, each.child_frame_id): matrix(each.transform) for each in message.transforms
    }


def in_root(link: str, found: Mapping[tuple[str, str], Matrix]) -> Matrix:
    """Return where a link lies in the root, by nothing but transforms as they were logged."""
    parents = {child: (parent, local) for (parent, child), local in found.items()}
    result = np.eye(4)
    while link in parents:
        link, local = parents[link]
        result = local @ result
    return result


class Scene:
    """Messages of a robot whose joints, and IMU, are put anywhere."""

    def __init__(self, urdf: str, joints: tuple[str, ...], imu: str = "", rate: float = 30.0) -> None:
        sources = {imu: ORIENTATION} if imu else {}
        self.header = LogHeader("robot", joints, (), (), 1, 0, sources=sources)
        self.record = CycleRecord(self.header.layout)
        self.record.states.position[:] = 0.0
        self.messages = FrameMessages(urdf, FramesPlan(rate, joints, imu), self.header)
        self.rate, self.cycle = rate, 0

    def at(self, positions: Mapping[str, float], orientation: tuple[float, ...] | None = None) -> Any:
        """Return the decoded message of the next cycle that has one; None: it has none."""
        for joint, position in positions.items():
            self.record.states.position[self.header.joints.index(joint)] = position
        if orientation is not None:
            self.record.sources.values[:] = orientation
        self.cycle += 1
        self.record.scheduled_ns = math.ceil(self.cycle * 1e9 / self.rate)
        row = np.frombuffer(self.record.raw, self.header.layout.dtype)[0]
        data = self.messages.pack_frames(row, (5, 6))
        return None if data is None else STORE.deserialize_cdr(data, schemas.FRAMES.name)

    @property
    def still(self) -> Any:
        return STORE.deserialize_cdr(self.messages.still((5, 6)), schemas.FRAMES.name)


# The bytes that rosbags reads, against the tree, which tests/description/frames compares with pinocchio


@campaign(ci=10, night=200, release=1000)
@pytest.mark.parametrize("path", sorted(ROBOTS.rglob("*.urdf")), ids=lambda path: path.stem)
def test_poses_of_logged_frames_are_those_of_the_tree(path, amount, chance):
    urdf = read_urdf(path.read_text())
    moving = tuple(joint.name for joint in urdf.joints if joint.moves and joint.mimic is None)
    scene, tree = Scene(path.read_text(), moving), FrameTree(urdf, moving)
    still = transforms(scene.still) if scene.messages.any_still else {}
    assert urdf.links
    for _ in range(int(amount)):
        positions = {name: chance.uniform(-4, 4) for name in moving}
        found = still | transforms(scene.at(positions))
        for link in urdf.links:
            expected = np.array(tree.pose(link, positions=positions).matrix)
            assert np.abs(in_root(link, found) - expected).max() < ROUNDED, (link, positions)


def test_stamps_are_those_of_cycles_and_angles_those_of_the_joints(torso):
    read, urdf = read_log(torso / "whole.mcap"), read_urdf(TORSO.read_text())
    cycles = {int(cycle["read_ns"]) + read.header.epoch_offset_ns: cycle for cycle in read.cycles}
    yaw = urdf.joint("head_yaw_joint")
    assert yaw is not None
    angles = []
    for _, t_ns, message, *_ in decode_log(torso / "whole.mcap", "/tf"):
        stamps = {(each.header.stamp.sec, each.header.stamp.nanosec) for each in message.transforms}
        assert stamps == {divmod(t_ns, 1_000_000_000)}
        local = transforms(message)[yaw.parent, yaw.child]
        angles.append(Rotation.from_matrix(local[:3, :3]).as_rotvec()[2])
        row = read.joints.index(yaw.name)
        assert angles[-1] == pytest.approx(cycles[t_ns]["position"][row], abs=ROUNDED)
        assert local[:3, 3] == pytest.approx(yaw.xyz)
    assert len(angles) in {75, 76}  # 30 a second, from the first cycle on
    assert np.ptp(angles) > 0.3


def test_what_does_not_move_is_logged_once_and_kept_for_who_comes_later(torso):
    urdf = read_urdf(TORSO.read_text())
    for log in (torso / "whole.mcap", *sorted((torso / "parts").iterdir())):
        (fixed,) = decode_log(log, "/tf_static")
        moved = [*decode_log(log, "/tf")]
        pairs = {(joint.parent, joint.child): joint.moves for joint in urdf.joints}
        assert {pair for one in moved for pair in transforms(one.message)} == {p for p in pairs if pairs[p]}
        assert set(transforms(fixed.message)) == {pair for pair, moves in pairs.items() if not moves}
        assert "offered_qos_profiles" not in moved[0].channel.metadata  # an old place is worth nothing
        (profile,) = yaml.safe_load(fixed.channel.metadata["offered_qos_profiles"])
        assert (profile["durability"], profile["history"], profile["depth"]) == (1, 1, 1)


@pytest.mark.parametrize(("rate", "counts"), [(0, {0}), (10, {4, 5}), (1000, {20})])
def test_the_rate_is_that_of_the_file_and_never_above_the_loop(rate, counts, path):
    text = (ROBOTS / "bioloid_torso.yaml").read_text()
    robot = path.with_name("robot.yaml")
    model = f"{{urdf: {TORSO}, frames_rate: {rate}}}"
    robot.write_text(text.replace("{urdf: urdf/bioloid_torso.urdf}", model))
    simulated_robot(robot, duration_s=0.4, log=path).run()
    topics = open_log(path).topics
    assert len([*decode_log(path, "/tf")]) in counts
    assert ("/tf_static" in topics) == (rate > 0)
    assert "/robot_description" in topics


# What is unknown, and signs


def test_a_joint_that_was_never_read_is_shown_when_it_is_and_stays_where_it_was():
    scene = Scene(TORSO.read_text(), ("left_elbow_joint", "head_yaw_joint"))
    assert scene.at({"left_elbow_joint": math.nan, "head_yaw_joint": math.nan}) is None
    first = transforms(scene.at({"head_yaw_joint": 0.5}))
    assert set(first) == {("base_link", "neck_link")}
    both = transforms(scene.at({"left_elbow_joint": 0.25}))
    scene.record.states.valid[:] = False  # its values stay
    assert {pair: local.tolist() for pair, local in transforms(scene.at({})).items()} == {
        pair: local.tolist() for pair, local in both.items()
    }
    # joints without servos are where they rest, with those that cannot move
    assert ("neck_link", "head_link") in transforms(scene.still)


def test_the_torso_turns_with_its_imu_from_when_that_is_known():
    scene = Scene(TORSO.read_text(), ("head_yaw_joint",), "imu")
    assert ("odom", "imu") not in transforms(scene.at({}))
    turned = Rotation.from_euler("xyz", [0.2, -0.3, 0.4])
    found = transforms(scene.at({}, tuple(2.0 * turned.as_quat())))
    assert found["odom", "imu"][:3, :3] == pytest.approx(turned.as_matrix(), abs=ROUNDED)
    assert ("odom", "imu") not in transforms(scene.still)
    everything = transforms(scene.still) | found
    upright = in_root("torso_link", everything)[:3, :3]
    level = in_root("torso_link", {**everything, ("odom", "imu"): np.eye(4)})[:3, :3]
    assert upright == pytest.approx(turned.as_matrix() @ level, abs=ROUNDED)
    # an orientation that is none is not shown
    assert ("odom", "imu") not in transforms(scene.at({}, (0.0, 0.0, 0.0, 0.0)))


def test_quaternions_are_of_length_one_and_never_change_their_sign_at_once():
    scene = Scene(TORSO.read_text(), ("head_yaw_joint",), "imu")
    last: dict[str, NDArray[np.float64]] = {}
    for number in range(220):
        angle = 0.1 * number
        jump = 2 * math.pi * (number // 100)  # a servo that counts its turns anew
        sign = -1.0 if number % 3 else 1.0  # a filter may return either quaternion of a rotation
        turn = sign * Rotation.from_euler("xyz", [angle, 0.3, -angle]).as_quat()
        found = scene.at({"head_yaw_joint": angle - jump}, tuple(turn)).transforms
        assert found
        for each in found:
            rotation = each.transform.rotation
            quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
            assert np.linalg.norm(quaternion) == pytest.approx(1, abs=ROUNDED)
            assert quaternion @ last.get(each.child_frame_id, quaternion) > 0.9
            last[each.child_frame_id] = quaternion


def test_a_robot_without_a_urdf_has_no_frames(header, path):
    assert header.robot_description is None
    LogWriter(path, replace(header, frames=FramesPlan(30))).close()
    assert schemas.LogTopic.FRAMES not in open_log(path).topics


# An IMU on a moving link

TILTING = """\
<robot name="tilting"><link name="base_link"/><link name="arm"/><link name="imu_link"/>
<joint name="tilt" type="revolute"><parent link="base_link"/><child link="arm"/><origin xyz="0 0 0.3"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="5" effort="1"/></joint>
<joint name="mount" type="fixed"><parent link="arm"/><child link="imu_link"/>
<origin xyz="0 0 0.05" rpy="0.4 0 0"/></joint></robot>
"""


def test_a_body_whose_imu_is_on_a_moving_link_stands_upright():
    """What the IMU measures is only how its link moves: `tilt` about y, and its mount about x."""
    scene = Scene(TILTING, ("tilt",), "imu")
    for angle in np.linspace(-1.5, 1.5, 7):
        measured = Rotation.from_euler("y", angle) * Rotation.from_euler("x", 0.4)
        found = transforms(scene.still) | transforms(scene.at({"tilt": angle}, tuple(measured.as_quat())))
        assert in_root("imu_link", found)[:3, :3] == pytest.approx(measured.as_matrix(), abs=ROUNDED)
        assert in_root("base_link", found)[:3, :3] == pytest.approx(np.eye(3), abs=ROUNDED)
