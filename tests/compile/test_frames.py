"""What the compiler makes of a URDF's frames: which joints move them, and the IMU that turns the body."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dxlrun.compile import Compiled
from dxlrun.description.frames.tree import FramesPlan
from dxlrun.errors import Problem

Problems = Callable[..., tuple[Problem, ...]]
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


@pytest.fixture
def with_model(tmp_path: Path, robot_text: str) -> Callable[..., str]:
    """Return a robot file with a URDF and these words behind it in `model`, and more controllers."""

    def with_model(words: str = "", urdf: str = URDF) -> str:
        (tmp_path / "pair.urdf").write_text(urdf, encoding="utf-8")
        return robot_text + f"model: {{urdf: pair.urdf{words}}}\n"

    return with_model


def test_joints_of_both_files_move_frames(
    compile_text: Callable[..., Compiled], with_model: Callable[..., str]
) -> None:
    plan = compile_text(with_model(", frames_rate: 12.5")).plan

    assert plan.frames == FramesPlan(12.5, ("left_arm_joint", "right_arm_joint"), "")


def test_a_robot_without_a_urdf_has_no_frames(compile_text: Callable[..., Compiled], robot_text: str) -> None:
    assert compile_text(robot_text).plan.frames is None


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        (
            '"right_arm_joint" type="continuous"',
            '"right_arm_joint" type="prismatic"',
            "the URDF slides right_arm_joint, which a servo turns, so frames do not show it move; "
            "make it revolute there; what it slides can mimic it",
        ),
        (
            '"right_arm"/></joint>',
            '"right_arm"/><mimic joint="left_arm_joint"/></joint>',
            "right_arm_joint follows left_arm_joint in the URDF, but has a servo of its own, which is what "
            "counts; take the mimic out of the URDF, or the joint out of this file",
        ),
        (
            '"right_arm_joint"',
            '"rigth_arm_joint"',
            "the URDF has no joint right_arm_joint; give the joints of both files the same names; until then "
            "these are not shown",
        ),
    ],
)
def test_what_moves_otherwise_in_the_urdf_is_a_warning(
    problems_in: Problems, with_model: Callable[..., str], right: str, wrong: str, expected: str
) -> None:
    assert right in URDF
    found = [each for each in problems_in(with_model(urdf=URDF.replace(right, wrong))) if "URDF" in each.what]

    assert [(f"{each.what}; {each.fix}", each.severity) for each in found] == [(expected, "warning")]


@pytest.mark.parametrize(
    ("imu", "expected"),
    [
        ("gyro", "model.imu is gyro, which is no device, sensor or controller with states; there is none"),
        ("arms", "model.imu is arms, which is no device, sensor or controller with states; there is none"),
    ],
)
def test_an_imu_that_is_no_source_is_an_error_at_its_place(
    problems_in: Problems, with_model: Callable[..., str], imu: str, expected: str
) -> None:
    text = with_model(f", imu: {imu}")
    (error,) = [each for each in problems_in(text) if each.severity == "error"]

    assert f"{error.what}; {error.fix}" == expected
    line = text.splitlines()[error.mark.line - 1]
    assert line[error.mark.column - 1 :].startswith(imu)


def test_a_mistake_in_the_urdf_refuses_the_robot_at_its_line(
    problems_in: Problems, with_model: Callable[..., str]
) -> None:
    found = problems_in(with_model(urdf=URDF.replace('joint="left_arm_joint" mult', 'joint="left" mult')))
    (error,) = [each for each in found if each.severity == "error"]

    assert (Path(error.mark.file).name, error.mark.line, error.mark.column) == ("pair.urdf", 7, 3)
    assert error.what == "joint thumb_joint mimics left, which is not there"
