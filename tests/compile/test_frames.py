# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""What the compiler makes of a URDF's frames: which joints move them, and the IMU that turns the body."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.description.frames.tree import FramesPlan

ROBOTS = Path(__file__).parents[2] / "robots"
URDF = """\
<robot name="pair">
  <link name="body"/><link name="left_arm"/><link name="right_arm"/><link name="thumb"/>
  <link name="imu_link"/>
  <joint name="left_arm_joint" type="revolute"><limit lower="-9" upper="9" velocity="9"/>
    <parent link="body"/><child link="left_arm"/></joint>
  <joint name="right_arm_joint" type="continuous"><parent link="body"/><child link="right_arm"/></joint>
  <joint name="thumb_joint" type="prismatic"><parent link="left_arm"/><child link="thumb"/>
    <mimic joint="left_arm_joint" multiplier="0.01"/></joint>
  <joint name="imu_mount" type="fixed"><parent link="left_arm"/><child link="imu_link"/></joint>
</robot>
"""


def with_model(words: str = "", urdf: str = URDF) -> str:
    """Return a robot file with a URDF and these words behind it in `model`."""
    Path("pair.urdf").write_text(urdf, encoding="utf-8")
    return PAIR + f"model: {{urdf: pair.urdf{words}}}\n"


def test_joints_of_both_files_move_frames() -> None:
    plan = compile_text(with_model(", frames_rate: 12.5")).plan

    assert plan.frames == FramesPlan(12.5, ("left_arm_joint", "right_arm_joint"))


def test_a_robot_without_a_urdf_has_no_frames() -> None:
    assert compile_text(PAIR).plan.frames is None


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        (
            '"right_arm_joint" type="continuous"',
            '"right_arm_joint" type="prismatic"',
            "the URDF slides right_arm_joint, but the robot file has angles for positions: the frames of the log will not move; add "
            "travel_per_turn here, or make it revolute in the URDF and add a prismatic mimic joint",
        ),
        (
            '"right_arm"/></joint>',
            '"right_arm"/><mimic joint="left_arm_joint"/></joint>',
            "right_arm_joint mimics left_arm_joint in the URDF, but its servo has priority; remove the mimic "
            "from the URDF, or the joint from this file",
        ),
        (
            '"right_arm_joint"',
            '"rigth_arm_joint"',
            "the URDF has no joint right_arm_joint; use the same names in both files; joints missing "
            "in the URDF are not shown",
        ),
    ],
)
def test_what_moves_otherwise_in_the_urdf_is_a_warning(right: str, wrong: str, expected: str) -> None:
    assert right in URDF
    found = [each for each in problems_in(with_model(urdf=URDF.replace(right, wrong))) if "URDF" in each.what]

    assert [(f"{each.what}; {each.fix}", each.severity) for each in found] == [(expected, "warning")]


@pytest.mark.parametrize(
    ("imu", "expected"),
    [
        ("gyro", "model.imu gyro is not a device, sensor or controller with states; there is none"),
        ("arms", "model.imu arms is not a device, sensor or controller with states; there is none"),
    ],
)
def test_an_imu_that_is_no_source_is_an_error_at_its_place(imu: str, expected: str) -> None:
    text = with_model(f", imu: {imu}")
    (error,) = [each for each in problems_in(text) if each.severity == "error"]

    assert f"{error.what}; {error.fix}" == expected
    line = text.splitlines()[error.mark.line - 1]
    assert line[error.mark.column - 1 :].startswith(imu)


def test_a_mistake_in_the_urdf_refuses_the_robot_at_its_line() -> None:
    found = problems_in(with_model(urdf=URDF.replace('joint="left_arm_joint" mult', 'joint="left" mult')))
    (error,) = [each for each in found if each.severity == "error"]

    assert (Path(error.mark.file).name, error.mark.line, error.mark.column) == ("pair.urdf", 7, 3)
    assert error.what == "joint thumb_joint mimics the unknown joint left"


LINEAR = """\
name: jaw
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 50}
joints:
  jaw: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, travel_per_turn: 60 mm, limits: {position: [0 mm, 20 mm], velocity: 50 mm/s}}
model: {urdf: jaw.urdf}
"""
JAW = """\
<robot name="jaw"><link name="hand"/><link name="finger"/>
<joint name="jaw" type="prismatic"><parent link="hand"/><child link="finger"/>
<limit lower="0" upper="0.03" velocity="0.1" effort="1"/></joint></robot>
"""


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("", "", []),
        ('"0.03"', '"0.01"', ["jaw may move 0..+20 mm, beyond its limits in the URDF, 0..+10 mm"]),
        ('"0.1"', '"0.01"', ["jaw may move at 0.05 m/s, faster than in the URDF, 0.01 m/s"]),
        (
            "prismatic",
            "revolute",
            [
                "the URDF turns jaw, but the robot file has lengths for positions: the frames of the log will not move"
            ],
        ),
    ],
)
def test_a_linear_joint_slides_in_the_urdf(right: str, wrong: str, expected: list[str]) -> None:
    Path("jaw.urdf").write_text(JAW.replace(right, wrong))
    compiled = compile_text(LINEAR)

    assert [warning.what for warning in compiled.warnings] == expected
    assert compiled.plan.frames == FramesPlan(30.0, () if "revolute" in wrong else ("jaw",))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (", imu_link: left_arm", FramesPlan(30.0, ("left_arm_joint", "right_arm_joint"), "imu", "left_arm")),
        ("", FramesPlan(30.0, ("left_arm_joint", "right_arm_joint"), "imu", "imu_link")),
        (", imu_link: left_arn", "the URDF has no link left_arn for the IMU imu; did you mean left_arm?"),
    ],
)
def test_the_link_of_the_imu_is_named_or_called_like_it(words: str, expected: FramesPlan | str) -> None:
    text = with_model(f", imu: imu{words}").replace("port: /dev/ttyUSB0", "port: sim")
    text = text.replace("controllers:", "controllers:\n  imu: {type: imu_sensor_broadcaster, sensor: gyro}")
    text += "sensors: {gyro: {type: simulated_imu, rate: 50, link: left_arm}}\n"
    if isinstance(expected, FramesPlan):
        assert compile_text(text).plan.frames == expected
    else:
        (error,) = [each for each in problems_in(text) if each.severity == "error"]
        assert f"{error.what}; {error.fix}" == expected


def test_a_source_without_orientation_turns_nothing() -> None:
    text = with_model(", imu: gyro").replace("port: /dev/ttyUSB0", "port: sim")
    found = problems_in(text + "sensors: {gyro: {type: simulated_imu, rate: 50, link: left_arm}}\n")
    (error,) = [each for each in found if each.severity == "error"]

    assert error.what == "model.imu gyro has no orientation (x, y, z, w)"
    assert error.fix == "add an imu_sensor_broadcaster for gyro, and write its name"


IMUS = """\
<robot name="pair">
  <link name="body"/><link name="left_arm"/><link name="right_arm"/><link name="imu_link"/><link name="tilted"/>
  <link name="rolled"/>
  <joint name="left_arm_joint" type="revolute"><limit lower="-9" upper="9" velocity="9"/>
    <parent link="body"/><child link="left_arm"/></joint>
  <joint name="right_arm_joint" type="continuous"><parent link="body"/><child link="right_arm"/></joint>
  <joint name="imu_mount" type="fixed"><parent link="body"/><child link="imu_link"/><origin xyz="0 0 1"/></joint>
  <joint name="tilt" type="fixed"><parent link="imu_link"/><child link="tilted"/><origin rpy="0 0.5236 0"/></joint>
  <joint name="roll" type="fixed"><parent link="tilted"/><child link="rolled"/><origin rpy="0.5236 0 0"/></joint>
</robot>
"""


@pytest.mark.parametrize(
    ("link", "frame", "model", "holder", "expected"),
    [
        ("body", "body", "imu", "imu", ""),
        ("imu_link", "body", "imu, imu_link: body", "imu", ""),  # beside it, and not turned
        ("tilted", "body, mounting: [0 deg, 30 deg, 0 deg]", "imu, imu_link: body", "imu", ""),
        ("rolled", "body, mounting: [30 deg, 30 deg, 0 deg]", "imu, imu_link: body", "imu", ""),
        ("tilted", "tilted, mounting: [0 deg, 0.5 deg, 0 deg]", "imu, imu_link: tilted", "none", ""),
        ("body", "bdy", "", "none", "frame: the frame bdy of imu is not a link of the URDF; did you mean body?"),
        ("left_arm", "body", "", "none", "frame: the frame of imu is body, but unit is on left_arm: these links move relative to each other; write `frame: left_arm`, or the rotation of unit as `mounting`"),
        ("tilted", "body", "", "none", "frame: the frame of imu is body, but unit is on tilted: these links differ by 30 deg; write"),
        ("body", "tilted, mounting: [0 deg, 30 deg, 0 deg]", "", "none", "frame: the frame of imu is tilted, but unit is on body: these links differ by 60 deg with the mounting; write"),
        ("left_arm", "left_arm", "imu, imu_link: body", "none", "imu_link: imu measures in the frame left_arm, but `imu_link` is body: these links move relative to each other; write `imu_link: left_arm`"),
        ("left_arm", "left_arm", "imu", "none", "imu: imu measures in the frame left_arm, but `imu_link` is imu_link: these links move relative to each other"),
        ("tilted", "tilted", "", "imu", "orientation: imu measures the orientation of tilted, but gravity uses it as that of body, the URDF's first link: these links differ by 30 deg; use the orientation of an IMU on body"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("part_plugins")
def test_links_of_an_orientation_are_compared(
    link: str, frame: str, model: str, holder: str, expected: str
) -> None:
    Path("pair.urdf").write_text(IMUS, encoding="utf-8")
    gravity = f"  gravity: {{type: part, orientation: {holder}/orientation}}\n" * (holder != "none")
    text = PAIR.replace("/dev/ttyUSB0", "sim") + (
        f"  imu: {{type: imu_sensor_broadcaster, sensor: unit, frame: {frame}}}\n{gravity}"
        f"sensors: {{unit: {{type: simulated_imu, link: {link}}}}}\n"
        f"model: {{urdf: pair.urdf{', imu: ' * bool(model)}{model}}}\n"
    )

    found = problems_in(text)

    assert [one.severity for one in found] == ["warning"] * bool(expected), [str(one) for one in found]
    for one in found:
        key, _, start = expected.partition(": ")
        assert str(one).partition("warning: ")[2].startswith(start)
        line = text.splitlines()[one.mark.line - 1]
        assert line[: one.mark.column - 1].endswith(f"{key}: ")


def test_the_frame_of_odometry_is_none_of_a_sensor() -> None:
    assert problems_in((ROBOTS / "diff_drive.yaml").read_text().replace("urdf/", f"{ROBOTS}/urdf/")) == ()
