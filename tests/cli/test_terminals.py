"""Narrow terminals, closed streams, full disks behind them, readers that leave: all of it in processes."""

import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit.hands import Screen, plain

pytestmark = pytest.mark.long

PROGRAM = [sys.executable, "-P", "-m", "dxlrun"]
ALL = ">&- 2>&- <&-"


def on_terminal(columns: int, *words: str) -> str:
    """Return what a terminal of that width gets to show."""
    with Screen(Path.cwd(), *words, columns=columns, TERM="xterm", NO_COLOR="1") as screen:
        assert screen.ended() == 0
        return plain(screen.shown)


@pytest.mark.parametrize("columns", [20, 40, 160])
def test_no_fact_is_lost_on_a_narrow_terminal(torso: Path, columns: int) -> None:
    shown = on_terminal(columns, "check", str(torso))
    words = set("".join(character if character.isprintable() else " " for character in shown).split())
    together = "".join(shown.split())
    assert "…" not in shown
    for fact in ("left_shoulder_lateral_joint", "joint_trajectory_controller", "-101.41..+101.41", "20"):
        assert fact in together
    assert {"main", "AX-12A"} <= {word.strip(",:") for word in words}
    joints = shown.split("Joints (deg)")[1].split("Controllers")[0]
    longest = max(len(line.rstrip()) for line in joints.splitlines())
    assert longest <= max(columns, len("  right_shoulder_lateral_joint,"))  # a name is never broken
    assert ("─────" in shown) >= (columns == 160)


def shell(line: str, directory: Path, **words: object) -> subprocess.CompletedProcess[str]:
    program = " ".join(PROGRAM)
    line = f'dxlrun() {{ {program} "$@"; }}; {line.format(**words)}'
    command = ["/bin/bash", "-c", line]
    return subprocess.run(command, cwd=directory, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "code", "closed"),
    [
        *(("check missing.yaml", 2, closed) for closed in (">&-", ">&- <&-", ALL, "2>&-", "2> /dev/full")),
        ("check {torso}", 0, ALL),
        ("{torso} --virtual --duration 0.2 --no-record", 0, ALL),  # in real time: tests/run/test_run.py
    ],
)
def test_closed_streams_change_nothing_but_what_is_seen(
    tmp_path: Path, torso: Path, words: str, code: int, closed: str
) -> None:
    said = shell(f"dxlrun {words} {closed}", tmp_path, torso=torso)
    assert said.returncode == code, said.stdout + said.stderr
    assert "Traceback" not in said.stderr
    assert said.stdout == "" or closed == "2>&-"


def test_full_disk_behind_the_output_is_one_sentence(tmp_path: Path, torso: Path) -> None:
    said = shell("dxlrun check {torso} > /dev/full", tmp_path, torso=torso)
    assert said.returncode == 1
    assert said.stderr.splitlines()[-1] == "dxlrun: No space left on device; run with --debug for details"


def test_terminal_that_knows_ascii_alone_gets_tables_and_graphs_in_it(tmp_path: Path, torso: Path) -> None:
    line = "export PYTHONIOENCODING=ascii; dxlrun check {torso} --graph && dxlrun check {torso}"
    said = shell(line, tmp_path, torso=torso)
    assert (said.returncode, said.stdout.isascii()) == (0, True), said.stderr
    assert "\n" + "-" * 80 in said.stdout
