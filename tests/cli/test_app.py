"""The program as a whole: version, help, errors and exit codes, completion, streams."""

import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import NoReturn

import pytest
from tests.kit.answers import read_answer
from tests.kit.commands import Dxlrun

from dxlrun.channels import c_sources
from dxlrun.cli import inputs
from dxlrun.errors import DxlrunError, InputError, Mark, PortError, Problem

PROGRAM = [sys.executable, "-m", "dxlrun"]


def test_version_is_that_of_the_package(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said = dxlrun("--version")
    assert (said.code, said.out) == (0, f"{metadata.version('dxlrun')}, with its compiled parts\n")
    assert dxlrun("check", "--version").out == said.out
    monkeypatch.setattr(c_sources, "SOURCES", [tmp_path / "kernel.c"])
    said = dxlrun("--version")
    assert said.code == 0
    assert said.out.endswith(", but the compiled kernel is missing; install dxlrun again\n")


def test_nothing_to_do_shows_ten_commands_and_is_wrong_input(dxlrun: Dxlrun) -> None:
    said = dxlrun()
    assert said.code == 2
    assert said.out.startswith("Usage: dxlrun")
    commands = said.out.partition("\nEvery day\n")[2].partition("\n\n")[0].splitlines()
    ten = "demo examples doctor scan check list watch play stop analyze"
    assert [line.split()[0] for line in commands] == ten.split()
    assert said.out.endswith(
        "`dxlrun --help` lists all commands, `dxlrun help COMMAND` shows one with examples.\n"
    )


def test_option_without_its_value_is_not_reported_as_absent(dxlrun: Dxlrun) -> None:
    said = dxlrun("send", "arm", "position", "elbow=20deg", "--in")
    assert said.errors == [
        'dxlrun: Command "send" parameter --in requires an argument; `dxlrun send --help` shows the usage'
    ]


def test_value_may_hold_the_sign() -> None:
    assert inputs.parse_assignments(["port:=a:=b"]) == {"port": "a:=b"}


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (PortError("port /dev/ttyUSB0 is held by minicom (4711)"), 1, "dxlrun: port /dev/ttyUSB0 is held"),
        (DxlrunError("first\nsecond"), 1, "dxlrun: first\ndxlrun: second"),
        (InputError("no"), 2, "dxlrun: no"),
        (InputError([Problem(Mark("f.yaml", 3, 7), "bad", "fix")]), 2, "f.yaml:3:7: bad; fix"),
        (InputError([Problem(Mark("a\nb\x1b[31m", 3, 7), "bad", "fix")]), 2, "a\\nb\\x1b[31m:3:7: bad; fix"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (
            FileNotFoundError(2, "No such file or directory", "x"),
            1,
            "dxlrun: x: No such file or directory; run with --debug for details",
        ),
        (ZeroDivisionError("oops"), 1, "dxlrun: internal error: ZeroDivisionError: oops"),
    ],
)
def test_every_error_is_a_sentence_and_an_exit_code(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, says: str
) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise error

    monkeypatch.setattr("dxlrun.cli.check.compiled", fail)
    said = dxlrun("check", "robot.yaml")
    assert said.code == code
    assert said.err.startswith(says)
    assert "Traceback" not in said.err
    assert not re.search("\x1b", said.out + said.err)
    for_programs = dxlrun("check", "robot.yaml", "--json")
    assert for_programs.code == code
    assert read_answer(for_programs.out).errors
    if not isinstance(error, KeyboardInterrupt):
        traced = dxlrun("check", "robot.yaml", "--debug")
        assert (traced.code, "Traceback" in traced.err) == (code, True)
        assert traced.errors[-1].partition(";")[0] == said.errors[-1].partition(";")[0]


def test_reader_that_goes_away_gets_no_traceback(torso: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    try:
        words = [*PROGRAM, "check", str(torso), "--json"]
        ran = subprocess.run(words, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(write_end)
    assert (ran.returncode, ran.stderr) == (1, "")


@pytest.mark.parametrize(
    "words", [("--help",), ("models", "AX-12A"), ("models",), ("check", "{torso}"), ("doctor",)]
)
def test_pipe_gets_no_blanks_at_the_ends_of_lines(
    dxlrun: Dxlrun, torso: Path, words: tuple[str, ...]
) -> None:
    out = dxlrun(*(word.format(torso=torso) for word in words)).out
    assert out
    assert [line for line in out.splitlines() if line.endswith(" ")] == []


def test_tab_completion_is_installed_where_it_is_asked_for_and_completes(tmp_path: Path) -> None:
    words = [*PROGRAM, "--install-completion", "--shell", "bash"]
    subprocess.run(words, env=os.environ | {"HOME": str(tmp_path)}, check=True, capture_output=True)
    script = tmp_path / ".local/share/bash-completion/completions/dxlrun"
    asked = "; ".join(
        f"COMP_WORDS=(dxlrun {words}); COMP_CWORD={number}; _dxlrun; echo ${{COMPREPLY[@]}}"
        for words, number in (("ana", 1), ("check --on", 2), ("--vir", 1))
    )
    shell = ["/bin/bash", "-c", f". {script}; {asked}"]
    shown = subprocess.run(shell, check=True, capture_output=True, text=True, cwd=tmp_path)
    assert shown.stdout.splitlines() == ["analyze", "--online", "--virtual"]
