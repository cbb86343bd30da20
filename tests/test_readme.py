"""Every command and every example of the README does what the README has it do."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.commands import Dxlrun, Said

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ACTIVATE = ". .venv/bin/activate"
COMMANDS = [line.strip() for line in README.splitlines() if line.startswith("    ")]
FIRST = COMMANDS[0].split(" && ")[-1]
OWN_ROBOT = README.partition("## Your own robot in five minutes")[2].partition("## A robot file by hand")[0]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory that looks like the clone in which a reader types the commands."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


Begin = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def begin(clone: Path) -> Iterator[Begin]:
    """Run a line as in a new terminal of the reader's: no environment is active."""
    path = ":".join(one for one in os.environ["PATH"].split(":") if not (Path(one) / "dxlrun").exists())
    with ExitStack() as stack:

        def begin(line: str) -> subprocess.Popen[str]:
            pipe = subprocess.PIPE
            words = ["/bin/bash", "-c", line]
            shell = subprocess.Popen(
                words, env=os.environ | {"PATH": path}, text=True, stdout=pipe, stderr=pipe
            )
            stack.enter_context(shell)
            stack.callback(shell.kill)
            return shell

        yield begin


def typed(dxlrun: Dxlrun, line: str) -> Said:
    """Run a command of the README in this process."""
    said = dxlrun(*shlex.split(line.replace(".venv/bin/", ""))[1:])
    assert said.code == 0, (line, said)
    return said


def test_readme_is_short_and_its_first_screen_has_two_commands() -> None:
    lines = README.splitlines()
    assert len(lines) < 150
    assert len([line for line in lines[:20] if line.startswith("    python3")]) == 2


def test_environment_is_activated_before_the_first_command_that_needs_it(begin: Begin) -> None:
    """The first command's 35 s are for a reader: here two seconds through all processes.

    The picture of the terminal, which `test_reference.py` compares, has what the whole run prints.
    """
    bare = next(index for index, line in enumerate(COMMANDS) if line.startswith("dxlrun "))
    assert ACTIVATE in COMMANDS[:bare]
    assert begin("dxlrun --help").wait(DEADLINE_S) == 127
    ran = begin(f"{FIRST} --duration 2; {ACTIVATE} && dxlrun analyze")
    out, err = ran.communicate(timeout=DEADLINE_S)
    assert "bioloid_torso: " in out  # a busy machine delays replies until servos count as lost
    assert "\nlog: logs/" in out.partition("next: dxlrun analyze")[2], out + err


def test_run_on_virtual_time_ends_well(dxlrun: Dxlrun, clone: Path) -> None:
    (line,) = (line for line in COMMANDS if "--virtual" in line)
    assert ": 0 of 250 periods skipped" in typed(dxlrun, line.replace("--duration 60", "--duration 5")).out


@pytest.mark.needs("report")
def test_page_of_the_readme_is_written(dxlrun: Dxlrun, clone: Path) -> None:
    (line,) = re.findall(r"`(dxlrun analyze --report .+?)`", README)
    typed(dxlrun, "dxlrun robots/single_joint.yaml --virtual --duration 0.5")
    typed(dxlrun, line)
    assert (clone / line.split()[-1]).read_text().startswith("<!DOCTYPE html>")


def test_robot_of_ones_own_from_scan_to_stop(dxlrun: Dxlrun, clone: Path, begin: Begin) -> None:
    """The five minutes, on the simulated servos that the README names."""
    simulate, *steps = re.findall(r"^    (dxlrun .+)$", OWN_ROBOT, re.MULTILINE)
    port = clone / "servos"
    assert "/tmp/servos" in simulate  # noqa: S108
    verbs = ["scan", "check", "check", "arm.yaml", "list", "send", "stop"]
    assert [step.split()[1] for step in steps] == verbs

    def lives(process: subprocess.Popen[str]) -> None:
        assert process.poll() is None, process.communicate()

    servos = begin(f"{ACTIVATE} && exec {simulate}".replace("/tmp/servos", str(port)))  # noqa: S108
    until(port.exists, check=lambda: lives(servos))
    steps = [step.replace("/dev/ttyUSB0", str(port)) for step in steps]
    scan, check, online, run, listed, send, stop = steps
    # in half a minute without these
    assert "XL430-W250" in typed(dxlrun, f"{scan} --protocol 2.0 --baud 57600").out
    assert "good" in typed(dxlrun, check).out
    assert "3 servos compared with the file, no differences" in typed(dxlrun, online).out
    robot = begin(f"{ACTIVATE} && exec {run}")
    until(lambda: "active" in dxlrun(*shlex.split(listed)[1:]).out, check=lambda: lives(robot))
    assert "all_joints" in typed(dxlrun, listed).out
    assert "all_joints" in typed(dxlrun, send).out
    typed(dxlrun, stop)
    out, err = robot.communicate(timeout=DEADLINE_S)
    assert robot.returncode == 0, (out, err)


def test_robot_file_runs(dxlrun: Dxlrun, clone: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    (clone / "pan_tilt.yaml").write_text(text)
    (line,) = (line for line in COMMANDS if line.startswith("dxlrun pan_tilt.yaml"))
    assert ": 0 of 500 periods skipped" in typed(dxlrun, f"{line} --virtual").out
