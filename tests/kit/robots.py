"""Robot files: texts, and what becomes of them; files are written into the working directory."""

from pathlib import Path
from textwrap import dedent

from tests.kit.cases import read_head

from dxlrun.compile.robot_compiler import CompiledRobot, compile_files
from dxlrun.errors import InputError, Problem

CASES = Path(__file__).parents[1] / "compile" / "cases"
"""Robot files, and what is said of them when they are changed; see `robot_cases.py`."""


def robot_text(name: str) -> str:
    """Return the robot file of a text of cases."""
    return whole_text(read_head(CASES / f"{name}.txt")).partition("---- ")[0]


def whole_text(head: str) -> str:
    """Return the files at the head of a text of cases, with the robot file that `like NAME` stands for."""
    first, _, more = head.partition("\n")
    return robot_text(first.removeprefix("like ")) + more if first.startswith("like ") else head


PAIR = robot_text("pair")
"""A small robot in which everything is right; tests break one thing of it."""


def compile_text(text: str, *motions: str, duration_ns: int | None = None) -> CompiledRobot:
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
