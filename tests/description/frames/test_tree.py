"""Where frames lie: against pinocchio on random poses, mimic joints, and the body that its IMU turns."""

import math
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.kit.campaigns import campaign

from dxlrun.description.frames.tree import FrameTree
from dxlrun.errors import InputError
from dxlsim.geometry.transform import Quaternion, Transform, from_rpy, near, unit
from dxlsim.geometry.urdf import Urdf, read_urdf

ROBOTS = Path(__file__).parents[3] / "robots"
EVERY_KIND = """\
<robot name="every_kind">
  <link name="base_link"/><link name="rail"/><link name="arm"/><link name="imu_link"/><link name="wheel"/>
  <link name="left"/><link name="right"/><link name="shut"/>
  <joint name="rail" type="prismatic"><parent link="base_link"/><child link="rail"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 2.6"/><axis xyz="1 2 -2"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="arm" type="revolute"><parent link="rail"/><child link="arm"/>
    <origin xyz="0 0.2 0" rpy="-1.2 1.5707963267948966 0.7"/><axis xyz="0.3 -0.4 1.2"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="imu_mount" type="fixed"><parent link="arm"/><child link="imu_link"/>
    <origin xyz="0 0 0.05" rpy="3.14159 0 0.3"/></joint>
  <joint name="wheel" type="continuous"><parent link="arm"/><child link="wheel"/><axis xyz="0 -1 0"/></joint>
  <joint name="left" type="prismatic"><parent link="arm"/><child link="left"/><axis xyz="0 1 0"/>
    <limit lower="0.01" upper="0.05" effort="1" velocity="1"/></joint>
  <joint name="right" type="prismatic"><parent link="arm"/><child link="right"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="left" multiplier="-1.5" offset="0.002"/></joint>
  <joint name="shut" type="revolute"><parent link="base_link"/><child link="shut"/><axis xyz="0 0 1"/>
    <limit lower="0.5" upper="1.5" effort="1" velocity="1"/></joint>
</robot>
"""  # noqa: E501  lines of another language
SERVOS = ("rail", "arm", "wheel", "left")


def texts() -> Iterator[tuple[str, str]]:
    yield "every_kind", EVERY_KIND
    for path in sorted(ROBOTS.rglob("*.urdf")):
        yield path.stem, path.read_text()


def test_no_robot_with_a_urdf_is_left_out() -> None:
    assert "bioloid_torso" in dict(texts())


@campaign(ci=10, night=200, release=1000)
@pytest.mark.parametrize("text", [text for _, text in texts()], ids=[name for name, _ in texts()])
def test_poses_of_frames_are_those_of_pinocchio(text: str, amount: float, chance: random.Random) -> None:
    pin = pytest.importorskip("pinocchio", reason="pin has 380 MB, so only the extra `full` has it")
    urdf = read_urdf(text)
    tree = FrameTree(urdf, ())
    model = pin.buildModelFromXML(text, mimic=True)
    data = model.createData()
    moving = [joint for joint in urdf.joints if joint.moves and joint.mimic is None]
    for _ in range(int(amount)):
        positions = {joint.name: chance.uniform(-7, 7) for joint in moving}
        q = pin.neutral(model)
        for joint, position in positions.items():
            place = model.joints[model.getJointId(joint)]
            if place.nq == 2:  # a continuous joint
                q[place.idx_q : place.idx_q + 2] = math.cos(position), math.sin(position)
            else:
                q[place.idx_q] = position
        pin.framesForwardKinematics(model, data, q)
        assert urdf.links
        for link in urdf.links:
            expected = data.oMf[model.getFrameId(link, pin.BODY)].homogeneous
            found = np.array(tree.pose(link, positions=positions).matrix)
            assert np.abs(found - expected).max() < 1e-9, (link, positions)


@pytest.fixture
def urdf() -> Urdf:
    return read_urdf(EVERY_KIND)


def test_a_mimic_joint_follows_in_the_same_pose(urdf: Urdf) -> None:
    tree = FrameTree(urdf, SERVOS)
    assert tree.position("right", {"left": 0.04}) == pytest.approx(-0.058)
    assert tree.pose("right", "arm", {"left": 0.04}).translation == pytest.approx((0, -0.058, 0))
    by = {frame.name: frame.moved_by for frame in tree.frames}
    assert (by["left"], by["right"], by["shut"], by["imu_link"]) == ("servo", "mimic", "nothing", "fixed")


def test_a_mimic_joint_of_a_joint_without_a_servo_rests(urdf: Urdf) -> None:
    assert {frame.name: frame.moved_by for frame in FrameTree(urdf, ()).frames}["right"] == "nothing"


def test_joints_that_are_not_given_rest_inside_their_limits(urdf: Urdf) -> None:
    tree = FrameTree(urdf, ())
    assert [tree.position(name, {}) for name in ("arm", "left", "shut")] == [0, pytest.approx(0.03), 1.0]


def test_one_frame_is_seen_from_any_other(urdf: Urdf) -> None:
    tree = FrameTree(urdf, SERVOS)
    positions = {"rail": 0.3, "arm": -1.1, "wheel": 40.0}
    seen = tree.pose("wheel", "imu_link", positions) @ tree.pose("imu_link", "wheel", positions)
    direct = tree.pose("imu_link", "shut", positions)
    round_about = tree.pose("wheel", "shut", positions) @ tree.pose("imu_link", "wheel", positions)
    assert np.array(seen.matrix) == pytest.approx(np.eye(4), abs=1e-12)
    assert np.array(direct.matrix) == pytest.approx(np.array(round_about.matrix), abs=1e-12)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ({"of": "arn"}, "frame arn not found; did you mean arm?"),
        ({"of": "arm", "relative_to": "head"}, "frame head not found; known: arm, base_link"),
        ({"of": "arm", "positions": {"whel": 1.0}}, "movable joint whel not found; did you mean wheel?"),
        ({"of": "arm", "positions": {"imu_mount": 1.0}}, "movable joint imu_mount not found"),
    ],
)
def test_an_unknown_name_is_refused(urdf: Urdf, words: dict[str, object], expected: str) -> None:
    with pytest.raises(LookupError, match=expected.replace("?", r"\?")):
        FrameTree(urdf, SERVOS).pose(**words)  # type: ignore[arg-type]  # as a person may give them


def test_a_pose_that_depends_on_an_unknown_position_is_refused(urdf: Urdf) -> None:
    with pytest.raises(ValueError, match="a position is missing"):
        FrameTree(urdf, SERVOS).pose("arm", positions={"arm": math.nan})


# The body that its IMU turns


def rotation_of(transform: Transform) -> NDArray[np.float64]:
    return np.array(transform.matrix)[:3, :3]


def test_an_imu_in_the_body_turns_the_whole_body(urdf: Urdf) -> None:
    from scipy.spatial.transform import Rotation

    tree = FrameTree(urdf, SERVOS, "imu")
    measured = Rotation.from_euler("xyz", [0.3, -0.8, 2.0])
    orientation: Quaternion = tuple(measured.as_quat().tolist())
    positions = {"rail": 0.2, "arm": 1.3}
    assert [frame.name for frame in tree.frames[:2]] == ["odom", "base_link"]
    assert tree.frames[1].moved_by == "imu"
    found = tree.pose("imu_link", "odom", positions, orientation)
    assert rotation_of(found) == pytest.approx(measured.as_matrix(), abs=1e-12)
    assert tree.pose("base_link", "odom", positions, orientation).translation == (0, 0, 0)
    # and the body itself is as without an IMU
    inside = tree.pose("wheel", "base_link", positions, orientation)
    assert np.array(inside.matrix) == pytest.approx(
        np.array(FrameTree(urdf, SERVOS).pose("wheel", "", positions).matrix)
    )


def test_what_hangs_from_the_imu_turns_with_it() -> None:
    from scipy.spatial.transform import Rotation

    text = (ROBOTS / "urdf/bioloid_torso.urdf").read_text()
    tree = FrameTree(read_urdf(text), (), "imu")
    measured = Rotation.from_euler("xyz", [0.1, 0.7, -1.0])
    orientation: Quaternion = tuple(measured.as_quat().tolist())
    odom = tree.pose("odom", "world", orientation=orientation)
    torso = tree.pose("torso_link", "odom", orientation=orientation)
    assert odom.translation == pytest.approx((0, 0, 0.3))
    turned = measured.as_matrix() @ rotation_of(tree.pose("torso_link", "odom"))
    assert rotation_of(torso) == pytest.approx(turned, abs=1e-12)
    assert {frame.name: frame.moved_by for frame in tree.frames}["imu"] == "imu"
    # what is measured is the whole turn between the two, whatever stands in the URDF
    before, joint, rest = text.partition('"odom_to_imu"')
    text = before + joint + rest.replace('xyz="0 0 0" rpy="0 0 0"', 'xyz="0 0 1" rpy="0 0.2 3"', 1)
    imu = FrameTree(read_urdf(text), (), "imu").pose("imu", "odom", orientation=orientation)
    assert (imu.translation, imu.rotation) == (pytest.approx((0, 0, 1)), pytest.approx(orientation))


@pytest.mark.parametrize(
    ("imu", "right", "wrong", "expected"),
    [
        ("gyro", "", "", "the URDF has no link for the IMU gyro: gyro, gyro_link or gyro_frame"),
        (
            "imu",
            '"base_link"',
            '"world"',
            "the URDF has the frame world, so it needs a fixed joint from odom to imu_link, the link of "
            "the IMU",
        ),
    ],
)
def test_an_imu_that_fits_nowhere_is_refused(imu: str, right: str, wrong: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        FrameTree(read_urdf(EVERY_KIND.replace(right, wrong) if right else EVERY_KIND), (), imu)


# Transforms


@pytest.mark.parametrize("pitch", [0.3, math.pi / 2, -math.pi / 2])
def test_roll_pitch_and_yaw_make_the_rotation_that_they_came_from(pitch: float) -> None:
    from scipy.spatial.transform import Rotation

    made = Transform(rotation=from_rpy((0.4, pitch, -2.1)))
    again = Transform(rotation=from_rpy(made.rpy))
    assert rotation_of(again) == pytest.approx(rotation_of(made), abs=1e-9)
    expected = Rotation.from_euler("xyz", [0.4, pitch, -2.1]).as_matrix()
    assert rotation_of(made) == pytest.approx(expected, abs=1e-12)


def test_a_quaternion_is_brought_to_length_one_or_is_none() -> None:
    assert unit((0.0, 0.0, 3.0, 4.0)) == (0, 0, 0.6, 0.8)
    assert [unit((0.0, 0.0, 0.0, 0.0)), unit((0.0, math.nan, 0.0, 1.0)), unit((math.inf, 0.0, 0.0, 1.0))] == [
        None
    ] * 3


def test_of_two_quaternions_the_nearer_one_is_taken() -> None:
    assert near((0.0, 0.0, 0.6, 0.8), (0.0, 0.0, -0.6, -0.8)) == (0, 0, -0.6, -0.8)
    assert near((0.0, 0.0, 0.6, 0.8), (0.0, 0.0, 0.5, 0.1)) == (0, 0, 0.6, 0.8)


def test_last_joint_of_a_long_chain_of_mimic_joints_moves_with_the_first() -> None:
    names = [f"j{number}" for number in range(1500)]
    links = "".join(f'<link name="{name}"/>' for name in ("base", *names))

    def joint(name: str, followed: str) -> str:
        multiplier = {"j0": -3, "j1": 2}.get(name, -1)
        mimic = f'<mimic joint="{followed}" multiplier="{multiplier}" offset="1"/>' if followed else ""
        ends = f'<parent link="base"/><child link="{name}"/>'
        return f'<joint name="{name}" type="revolute">{ends}{mimic}</joint>'

    joints = "".join(map(joint, names, [*names[1:], ""]))
    tree = FrameTree(read_urdf(f"<robot>{links}{joints}</robot>"), ["j1499"])
    assert tree.position("j0", {"j1499": 0.2}) == pytest.approx(-3 * (2 * (1 - 0.2) + 1) + 1)
    assert {frame.moved_by for frame in tree.frames[1:]} == {"servo", "mimic"}
