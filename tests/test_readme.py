"""Every command and every example of the README does what the README has it do."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit import awaited

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BIN = Path(sys.executable).parent
ACTIVATE = ". .venv/bin/activate"
COMMANDS = [line.strip() for line in README.splitlines() if line.startswith("    ")]
OWN_ROBOT = README[
    README.index("## Your own robot in five minutes") : README.index("## A robot file by hand")
]
STEPS = [line.strip() for line in OWN_ROBOT.splitlines() if line.startswith("    dxlrun")]


def shell(line: str, directory: Path) -> subprocess.CompletedProcess[str]:
    """Run a line as in a new terminal of the reader's: no environment is active."""
    return subprocess.run(["/bin/bash", "-c", line], **terminal(directory), check=False)


def terminal(directory: Path) -> dict[str, object]:
    """Where and how the commands of a reader run; what each robot listens on lies in the directory, too."""
    path = ":".join(one for one in os.environ["PATH"].split(":") if Path(one) != BIN)
    environment = os.environ | {"PATH": path, "XDG_RUNTIME_DIR": str(directory)}
    return {
        "cwd": directory,
        "env": environment,
        "text": True,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
    }


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A directory that looks like the clone in which a reader types the commands."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return tmp_path


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) < 150


def test_the_first_screen_has_two_commands() -> None:
    first_screen = "\n".join(README.splitlines()[:20])
    assert len([line for line in first_screen.splitlines() if line.startswith("    python3")]) == 2


def test_the_first_command_moves_the_robot_and_the_next_one_explains_it(clone: Path) -> None:
    """Its 35 s are for a reader: here two seconds through all processes, and all of it on virtual time."""
    command = COMMANDS[0].split(" && ")[-1]
    ran = shell(f"{command} --duration 2", clone)
    assert ran.returncode == 1, ran.stderr  # its motions are not over
    assert "bioloid_torso: " in ran.stdout  # a busy machine delays replies until servos count as lost
    whole = shell(f"{command} --virtual", clone)
    assert whole.returncode == 0, whole.stderr
    analyze = next(line for line in COMMANDS if line.startswith("dxlrun analyze"))
    analyzed = shell(f"{ACTIVATE} && {analyze}", clone)
    assert analyzed.returncode == 0, analyzed.stderr
    assert "1750" in analyzed.stdout  # periods of 20 ms in 35 s


def test_the_environment_is_activated_before_the_first_command_that_needs_it(clone: Path) -> None:
    bare = next(index for index, line in enumerate(COMMANDS) if line.startswith("dxlrun "))
    assert ACTIVATE in COMMANDS[:bare]
    assert shell("dxlrun --help", clone).returncode == 127
    assert shell(f"{ACTIVATE} && dxlrun --help", clone).returncode == 0


def test_the_run_on_virtual_time_ends_well(clone: Path) -> None:
    (line,) = (line for line in COMMANDS if "--virtual" in line)
    ran = shell(f"{ACTIVATE} && {line}", clone)
    assert ran.returncode == 0, ran.stderr


def test_the_page_of_the_readme_is_written(clone: Path) -> None:
    (line,) = re.findall(r"`(dxlrun analyze --report .+?)`", README)
    assert (
        shell(f"{ACTIVATE} && dxlrun robots/single_joint.yaml --virtual --duration 0.5", clone).returncode
        == 0
    )
    assert shell(f"{ACTIVATE} && {line}", clone).returncode == 0
    assert (clone / line.split()[-1]).read_text().startswith("<!DOCTYPE html>")


def test_a_robot_of_ones_own_from_scan_to_stop(clone: Path) -> None:
    """The five minutes, on the simulated servos that the README names."""
    simulate, *steps = STEPS
    port = clone / "servos"
    assert "/tmp/servos" in simulate  # noqa: S108
    assert [step.split()[1] for step in steps] == [
        "scan",
        "check",
        "check",
        "arm.yaml",
        "list",
        "send",
        "stop",
    ]

    def began(line: str) -> subprocess.Popen[str]:
        return subprocess.Popen(["/bin/bash", "-c", f"{ACTIVATE} && exec {line}"], **terminal(clone))

    def until(done: Callable[[], object], process: subprocess.Popen[str]) -> None:
        def lives() -> None:
            assert process.poll() is None, process.communicate()

        awaited.until(done, check=lives)

    def typed(step: str) -> str:
        done = shell(f"{ACTIVATE} && {step}", clone)
        assert done.returncode == 0, (step, done.stdout, done.stderr)
        return done.stdout

    servos = began(simulate.replace("/tmp/servos", str(port)))  # noqa: S108
    try:
        until(port.exists, servos)
        scan, check, online, run, listed, send, stop = (
            step.replace("/dev/ttyUSB0", str(port)) for step in steps
        )
        assert "XL430-W250" in typed(f"{scan} --protocol 2.0 --baud 57600")  # in half a minute without these
        assert "good" in typed(check)
        assert "3 servos compared with the file, no differences" in typed(online)
        robot = began(run)
        try:
            until(lambda: "active" in shell(f"{ACTIVATE} && {listed}", clone).stdout, robot)
            assert "all_joints" in typed(listed)
            assert "all_joints" in typed(send)
            typed(stop)
            out, err = robot.communicate(timeout=awaited.DEADLINE_S)
        finally:
            robot.kill()
        assert robot.returncode == 0, (out, err)
    finally:
        servos.terminate()
        servos.communicate(timeout=awaited.DEADLINE_S)


def test_the_robot_file_runs(clone: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    (clone / "pan_tilt.yaml").write_text(text)
    (line,) = (line for line in COMMANDS if line.startswith("dxlrun pan_tilt.yaml"))
    ran = shell(f"{ACTIVATE} && {line} --virtual", clone)
    assert ran.returncode == 0, ran.stderr
    assert ": 0 of 500 periods skipped" in ran.stdout
