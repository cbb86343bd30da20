"""Whatever dxlrun is started with: closed streams, full disks behind them, readers that leave."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

CODE = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"


def shell(line: str, directory: Path) -> "subprocess.CompletedProcess[str]":

    return subprocess.run(
        ["/bin/bash", "-c", f'dxlrun() {{ {sys.executable} -P -c "{CODE}" "$@"; }}; {line}'],
        cwd=directory,
        capture_output=True,
        text=True,
        check=False,
    )


ALL = ">&- 2>&- <&-"


@pytest.mark.parametrize(
    ("words", "code", "closed"),
    [
        *(("check missing.yaml", 2, closed) for closed in (">&-", ">&- <&-", ALL, "2>&-")),
        ("check {torso}", 0, ALL),
        ("{torso} --virtual --duration 0.2 --no-record", 0, ALL),  # in real time: tests/run/test_exits.py
    ],
)
def test_closed_streams_change_nothing_but_what_is_seen(
    tmp_path: Path, torso: Path, words: str, code: int, closed: str
):
    said = shell(f"dxlrun {words.format(torso=torso)} {closed}", tmp_path)

    assert said.returncode == code, said.stdout + said.stderr
    assert "Traceback" not in said.stderr
    assert said.stdout == "" or closed == "2>&-"


def test_a_full_disk_behind_the_output_is_one_sentence(tmp_path: Path, torso: Path):
    said = shell(f"dxlrun check {torso} > /dev/full", tmp_path)

    assert said.returncode == 1
    assert said.stderr.splitlines()[-1] == "dxlrun: No space left on device; run with --debug for details"
    assert "internal error" not in said.stderr


def test_a_full_disk_behind_the_errors_keeps_the_exit_code(tmp_path: Path):
    assert shell("dxlrun check missing.yaml 2> /dev/full", tmp_path).returncode == 2


@pytest.mark.parametrize("words", ["check {torso}", "check {torso} --json", "--help", "check missing.yaml"])
def test_a_reader_that_leaves_early_gets_no_traceback(tmp_path: Path, torso: Path, words: str):
    said = shell(f"dxlrun {words.format(torso=torso)} 2>&1 | head -n 1", tmp_path)

    assert said.stderr == ""
    assert "Traceback" not in said.stdout


def test_a_terminal_that_knows_ascii_alone_gets_tables_and_graphs_in_it(tmp_path: Path, torso: Path):
    said = shell(
        f"export PYTHONIOENCODING=ascii; dxlrun check {torso} --graph && dxlrun check {torso}", tmp_path
    )
    assert (said.returncode, said.stdout.isascii()) == (0, True), said.stderr
    assert "\n" + "-" * 80 in said.stdout
