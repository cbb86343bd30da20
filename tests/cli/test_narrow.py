"""`dxlrun check` on a terminal: everything is there however narrow it is."""

import os
import pty
import re
import struct
import subprocess
import sys
import termios
from fcntl import ioctl
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

CODE = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"


def on_terminal(columns: int, *words: str, terminal: str = "xterm") -> str:
    """Return what a terminal of that width gets to show."""
    ours, theirs = pty.openpty()
    ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", CODE, *words],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment | {"TERM": terminal, "NO_COLOR": "1"},
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:  # how Linux says that the terminal has no writer any more
            break
        shown += piece
    os.close(ours)
    assert process.wait() == 0
    return re.sub(r"\x1b\[[0-9;]*m", "", shown.decode())


@pytest.mark.parametrize("columns", [20, 40, 160])
def test_no_fact_is_lost_on_a_narrow_terminal(torso: Path, columns: int):
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


def test_a_wide_terminal_gets_tables(torso: Path):
    assert "─────" in on_terminal(160, "check", str(torso))


@pytest.mark.parametrize("terminal", ["xterm", "dumb"])
@pytest.mark.parametrize("words", [("models", "--protocol", "1.0"), ("models", "AX-12A")])
def test_no_head_is_cut_on_80_columns(words: tuple[str, ...], terminal: str):
    shown = on_terminal(80, *words, terminal=terminal)

    assert "…" not in shown
    assert "300 deg" in shown
    assert max(map(len, shown.splitlines())) <= 81  # soft wraps end behind the last column


@pytest.mark.parametrize("terminal", ["xterm", "dumb"])
def test_a_table_with_short_heads_fits_80_columns(torso: Path, terminal: str):
    shown = on_terminal(80, "check", str(torso), terminal=terminal).split("Time of one cycle")[1]

    assert "─────" in shown
    assert "…" not in shown
