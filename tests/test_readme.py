"""Every command and every example of the README does what the README says."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from dxlrun.cli.inputs import COMMANDS_WHILE_IT_RUNS
from dxlrun.compile import compile_files
from dxlrun.testing import simulated_robot

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BIN = Path(sys.executable).parent
ACTIVATE = ". .venv/bin/activate"
COMMANDS = [line.strip() for line in README.splitlines() if line.startswith("    ")]
RUNS = [line for line in COMMANDS if line.startswith("dxlrun") and "/dev/tty" not in line and "*" not in line]
ELSEWHERE = {*COMMANDS_WHILE_IT_RUNS, "analyze"}  # tests/cli/test_steer.py, and behind the first run
RUNS = [line for line in RUNS if line.split()[1] not in ELSEWHERE]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def shell(line: str, directory: Path) -> subprocess.CompletedProcess[str]:
    """Run a line as in a new terminal of the reader's: no environment is active."""
    path = ":".join(one for one in os.environ["PATH"].split(":") if Path(one) != BIN)
    environment = os.environ | {"PATH": path}
    return subprocess.run(
        ["/bin/bash", "-c", line], cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A directory that looks like the clone in which a reader types the commands."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return tmp_path


def test_the_first_screen_has_two_commands() -> None:
    first_screen = "\n".join(README.splitlines()[:20])
    assert len([line for line in first_screen.splitlines() if line.startswith("    python3")]) == 2


def test_the_first_command_moves_the_robot_and_the_next_one_explains_it(clone: Path) -> None:
    ran = shell(COMMANDS[0].split(" && ")[-1], clone)
    assert ran.returncode == 0, ran.stderr
    assert "bioloid_torso: " in ran.stdout  # a busy machine delays replies until servos count as lost
    analyze = next(line for line in COMMANDS if line.startswith("dxlrun analyze"))
    told = shell(f"{ACTIVATE} && {analyze}", clone)
    assert told.returncode == 0, told.stderr
    assert "1750" in told.stdout  # periods of 20 ms in 35 s; how many were kept depends on the machine


def test_the_environment_is_activated_before_the_first_command_that_needs_it(clone: Path) -> None:
    bare = next(index for index, line in enumerate(COMMANDS) if line.startswith("dxlrun "))
    assert ACTIVATE in COMMANDS[:bare]
    assert shell("dxlrun --help", clone).returncode == 127
    assert shell(f"{ACTIVATE} && dxlrun --help", clone).returncode == 0


def test_the_check_for_a_real_port_opens_none(clone: Path) -> None:
    line = next(line for line in COMMANDS if line.startswith("dxlrun check"))
    told = shell(f"{ACTIVATE} && {line}", clone)
    assert told.returncode == 0, told.stderr
    assert "71 Hz" in told.stdout


def test_the_run_on_a_real_port_says_that_it_is_missing(clone: Path) -> None:
    line = next(line for line in COMMANDS if line.startswith("dxlrun robots") and "/dev/tty" in line)
    told = shell(f"{ACTIVATE} && " + line.replace("/dev/ttyUSB0", "/dev/ttyNowhere"), clone)
    assert told.returncode == 1
    assert "/dev/ttyNowhere" in told.stderr


@pytest.mark.parametrize("line", RUNS)
def test_the_other_runs_end_well(clone: Path, line: str) -> None:
    told = shell(f"{ACTIVATE} && {line}", clone)
    assert told.returncode == 0, told.stderr
    assert shlex.split(line)[0] == "dxlrun"


def test_the_robot_file_runs(tmp_path: Path) -> None:
    path = tmp_path / "pan_tilt.yaml"
    path.write_text(blocks("yaml")[0])
    robot = simulated_robot(path, duration_s=0.5)
    assert robot.run().cycles == 50


def test_the_controller_moves_the_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (controller,) = (block for block in blocks("python") if "class Wave" in block)
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package/__init__.py").touch()
    (tmp_path / "my_package/wave.py").write_text(controller)
    info = tmp_path / "my_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    entry_points = blocks("toml")[0].replace("[project.entry-points.dxlrun]", "[dxlrun]").replace('"', "")
    (info / "entry_points.txt").write_text(entry_points)
    monkeypatch.syspath_prepend(tmp_path)
    text = blocks("yaml")[0].replace(
        "type: joint_group_position_controller,", "type: wave, amplitude: 30 deg,"
    )
    path = tmp_path / "waving.yaml"
    path.write_text(text)
    robot = simulated_robot(path, duration_s=1.6)
    assert robot.run().detail == ""
    assert robot.record.states.position == pytest.approx([0.52, 0.52], abs=0.02)


def test_the_motion_fits_the_robot(tmp_path: Path) -> None:
    robot_text, motion_text = blocks("yaml")
    robot, motion = tmp_path / "robot.yaml", tmp_path / "motion.yaml"
    robot.write_text(robot_text)
    motion.write_text(motion_text)
    compiled = compile_files(robot, {}, [motion])
    assert compiled.warnings == ()
    assert len(compiled.plan.loop.commands) == 300
