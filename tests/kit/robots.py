"""Robot files: texts, and what becomes of them; files are written into the working directory."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

from dxlrun.compile import Compiled, compile_files
from dxlrun.errors import InputError, Problem

PAIR = """\
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
"""A small robot in which everything is right; tests break one thing of it."""


def compile_text(text: str, *motions: str, duration_ns: int | None = None) -> Compiled:
    """Compile the text of a robot file, and of motion files."""
    robot = Path.cwd() / "robot.yaml"
    robot.write_text(text, encoding="utf-8")
    paths = [robot.with_name(f"motion{number}.yaml") for number in range(len(motions))]
    for path, motion in zip(paths, motions, strict=True):
        path.write_text(dedent(motion), encoding="utf-8")
    return compile_files(robot, {}, paths, duration_ns)


def problems_in(text: str, *motions: str) -> tuple[Problem, ...]:
    """Return the problems of a text: errors, and warnings."""
    try:
        return compile_text(text, *motions).warnings
    except InputError as error:
        return error.problems
