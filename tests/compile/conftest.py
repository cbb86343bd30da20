from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest

from dxlrun.compile import Compiled, compile_files
from dxlrun.errors import InputError, Problem

ROBOT = """\
name: pair
buses:
  main: {port: /dev/ttyUSB0, protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  left_arm_joint:
    bus: main
    id: 1
    model: AX-12A
    reference: 60 deg
    direction: -1
  right_arm_joint:
    bus: main
    id: 2
    model: AX-12A
    reference: 240 deg
    direction: 1
    limits: {position: [-90 deg, 60 deg]}
controllers:
  states: {type: joint_state_broadcaster, rate: 25}
  arms:
    type: joint_group_posvel_controller
    joints: [left_arm_joint, right_arm_joint]
  spare:
    type: joint_trajectory_controller
    active: false
    joints: [left_arm_joint, right_arm_joint]
"""


@pytest.fixture
def robot_text() -> str:
    """A small robot in which everything is right; tests break one thing of it."""
    return ROBOT


@pytest.fixture
def compile_text(tmp_path: Path) -> Callable[..., Compiled]:
    """Compile the text of a robot file, and of motion files."""

    def compile_text(text: str, *motions: str, duration_ns: int | None = None) -> Compiled:
        robot = tmp_path / "robot.yaml"
        robot.write_text(text, encoding="utf-8")
        paths = []
        for number, motion in enumerate(motions):
            path = tmp_path / f"motion{number}.yaml"
            path.write_text(dedent(motion), encoding="utf-8")
            paths.append(path)
        return compile_files(robot, {}, paths, duration_ns)

    return compile_text


@pytest.fixture
def problems_in(compile_text: Callable[..., Compiled]) -> Callable[..., tuple[Problem, ...]]:
    """Return the problems of a text, errors and warnings."""

    def problems_in(text: str, *motions: str) -> tuple[Problem, ...]:
        try:
            return compile_text(text, *motions).warnings
        except InputError as error:
            return error.problems

    return problems_in
