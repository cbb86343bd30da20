"""What the README tells a reader to type works."""

import re
from pathlib import Path

import numpy as np
import pytest

from dxlrun import Commands, Context, JointLimits, States
from dxlrun.compile import compile_files

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def test_the_files_of_the_first_command_exist():
    command = next(line for line in README.splitlines() if line.startswith("python3 -m venv"))
    files = [word for word in command.split() if word.endswith(".yaml")]

    assert len(files) == 2
    compile_files(ROOT / files[0], {}, [ROOT / files[1]])


def test_the_robot_file_and_the_motion_compile(tmp_path: Path):
    robot, motion = tmp_path / "robot.yaml", tmp_path / "motion.yaml"
    robot_text, motion_text = blocks("yaml")
    robot.write_text(robot_text)
    motion.write_text(motion_text)

    compiled = compile_files(robot, {}, [motion])

    assert compiled.warnings == ()
    assert len(compiled.plan.loop.commands) == 300


def test_the_controller_nods():
    names: dict = {}
    exec(blocks("python")[0], names)  # noqa: S102  # the README is ours
    kind = names["dxlrun_controllers"]()["nod"]
    controller = kind(kind.Parameters(joint="head"))
    none = np.array([np.nan])
    context = Context(
        name="nod",
        joints=("head",),
        period_ns=20_000_000,
        limits=JointLimits(none, none, none),
        states=States.empty(1),
        goals=Commands(np.array([0.1]), none.copy()),
        commands=Commands.empty(1),
        say=lambda _: None,
        publish=lambda: None,
    )
    controller.on_configure(context)
    controller.on_activate(1_000_000_000)

    controller.update(1_000_000_000, 20_000_000)
    assert context.commands.position[0] == pytest.approx(0.1)
    controller.update(1_500_000_000, 20_000_000)
    assert context.commands.position[0] == pytest.approx(0.1 + 0.3 * np.sin(1.0))
