import os
import re
import subprocess
import sys
from importlib import metadata

import pytest
from tests.kit.answers import read_answer
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels import c_sources
from dxlrun.cli import inputs
from dxlrun.errors import DxlrunError, InputError, Mark, PortError, Problem


def loaded_by(*words: str, whole: bool = False) -> tuple[int, set[str]]:
    """Exit code and imported packages of a command line in a fresh interpreter; `whole`: modules."""
    name = "name" if whole else "name.partition('.')[0]"
    code = (
        "import sys; from dxlrun.cli import main; code = main(sys.argv[1:]); "
        f"print('modules', code, *sorted({{{name} for name in sys.modules}}))"
    )
    run = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    words_out = run.stdout.splitlines()[-1].split()
    assert words_out[0] == "modules"
    return int(words_out[1]), set(words_out[2:])


@pytest.mark.parametrize(
    "words", [("--help",), ("check", "--help"), ("pause", "--help"), ("--version",), ("no_such_verb",)]
)
def test_what_needs_no_robot_imports_neither_numpy_nor_pydantic(words: tuple[str, ...]):
    _, modules = loaded_by(*words)

    assert ("cyclopts" in modules) == (words not in {("--version",), ("--help",)})
    assert modules.isdisjoint({"numpy", "pydantic", "yaml", "mcap", "serial", "msgspec", "markdown_it"})


def test_a_command_is_imported_alone():
    _, modules = loaded_by("check", "--help", whole=True)

    assert {name for name in modules if name.startswith("dxlrun.")} == {
        *("dxlrun.cli", "dxlrun.cli.app", "dxlrun.cli.inputs", "dxlrun.cli.run", "dxlrun.cli.check"),
        *("dxlrun.cli.verb_registry", "dxlrun.installed_plugins"),
        *("dxlrun.cli.tools", "dxlrun.cli.tools.tool_log"),
        *("dxlrun.output", "dxlrun.output.json", "dxlrun.output.text_table", "dxlrun.output.terminal"),
        *("dxlrun.output.escaping", "dxlrun.output.target"),
        "dxlrun.output.unblocked",
        "dxlrun.errors",
    }
    assert "rich.markdown" not in modules
    assert "cyclopts.completion" not in modules


def test_the_version_is_that_of_the_package(dxlrun):
    said = dxlrun("--version")

    assert (said.code, said.out) == (0, f"{metadata.version('dxlrun')}, with its compiled parts\n")
    assert dxlrun("check", "--version").out == said.out


def test_the_version_shows_that_the_kernel_is_missing(dxlrun, monkeypatch, tmp_path):
    monkeypatch.setattr(c_sources, "SOURCES", [tmp_path / "kernel.c"])
    said = dxlrun("--version")
    assert said.code == 0
    assert said.out.endswith(", but the compiled kernel is missing; install dxlrun again\n")


def test_help_names_every_command_and_option(dxlrun):
    said = dxlrun("--help")

    assert said.code == 0
    for word in (
        "check",
        "analyze",
        "--play",
        "--duration",
        "--no-record",
        "--take-over",
        "--virtual",
        "--debug",
    ):
        assert word in said.out


def test_nothing_to_do_shows_ten_commands_and_is_wrong_input(dxlrun):
    said = dxlrun()

    assert said.code == 2
    assert said.out.startswith("Usage: dxlrun")
    commands = said.out.partition("\nEvery day\n")[2].partition("\n\n")[0].splitlines()
    assert [line.split()[0] for line in commands] == [
        *("demo", "examples", "doctor", "scan", "check", "list", "watch", "play", "stop", "analyze")
    ]
    assert said.out.endswith(
        "`dxlrun --help` lists all commands, `dxlrun help COMMAND` shows one with examples.\n"
    )


def test_a_value_may_hold_the_sign(torso):
    assert inputs.parse_assignments(["port:=a:=b"]) == {"port": "a:=b"}


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (PortError("port /dev/ttyUSB0 is held by minicom (4711)"), 1, "dxlrun: port /dev/ttyUSB0 is held"),
        (DxlrunError("first\nsecond"), 1, "dxlrun: first\ndxlrun: second"),
        (InputError("no"), 2, "dxlrun: no"),
        (InputError([Problem(Mark("f.yaml", 3, 7), "bad", "mend")]), 2, "f.yaml:3:7: bad; mend"),
        (
            InputError([Problem(Mark("a\nb\x1b[31m", 3, 7), "bad", "mend")]),
            2,
            "a\\nb\\x1b[31m:3:7: bad; mend",
        ),
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
    dxlrun, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, says: str
):
    def fail(*_: object):
        raise error

    monkeypatch.setattr("dxlrun.cli.check.compiled", fail)

    said = dxlrun("check", "robot.yaml")

    assert said.code == code
    assert said.err.startswith(says)
    assert "Traceback" not in said.err
    assert not re.search("\x1b", said.out + said.err)


def test_debug_shows_the_traceback(dxlrun, torso, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object):
        raise PortError("gone")

    monkeypatch.setattr("dxlrun.cli.check.compiled", fail)

    said = dxlrun("check", torso, "--debug")

    assert said.code == 1
    assert "Traceback" in said.err
    assert said.errors[-1] == "dxlrun: gone"


def test_a_reader_that_goes_away_is_no_traceback(torso):
    code = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"
    read_end, write_end = os.pipe()
    os.close(read_end)
    try:
        run = subprocess.run(
            [sys.executable, "-c", code, "check", str(torso), "--json"],
            stdout=write_end,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(write_end)

    assert (run.returncode, run.stderr) == (1, "")


def test_an_interrupt_under_json_is_json(dxlrun, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: object):
        raise KeyboardInterrupt

    monkeypatch.setattr("dxlrun.cli.check.compiled", interrupt)

    said = dxlrun("check", "robot.yaml", "--json")

    assert (said.code, [one.what for one in read_answer(said.out).errors]) == (130, ["interrupted"])


def test_the_usage_shows_that_a_robot_and_a_command_are_alternatives(dxlrun):
    assert dxlrun("--help").out.splitlines()[:2] == [
        "Usage: dxlrun ROBOT.yaml [ARG:=VALUE ...] [OPTIONS]",
        "       dxlrun COMMAND ...",
    ]


@pytest.mark.parametrize(
    "words", [("--help",), ("models", "AX-12A"), ("models",), ("check", "{torso}"), ("doctor",)]
)
def test_a_pipe_gets_no_blanks_at_the_ends_of_lines(dxlrun, torso, words: tuple[str, ...]):
    out = dxlrun(*(word.format(torso=torso) for word in words)).out

    assert [line for line in out.splitlines() if line.endswith(" ")] == []


def test_tab_completion_is_installed_where_it_is_asked_for_and_completes(tmp_path):
    home = os.environ | {"HOME": str(tmp_path)}
    code = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"
    words = [sys.executable, "-c", code, "--install-completion", "--shell", "bash"]
    subprocess.run(words, env=home, check=True, capture_output=True)
    script = tmp_path / ".local/share/bash-completion/completions/dxlrun"
    asked = "; ".join(
        f"COMP_WORDS=(dxlrun {words}); COMP_CWORD={number}; _dxlrun; echo ${{COMPREPLY[@]}}"
        for words, number in (("ana", 1), ("check --on", 2), ("--vir", 1))
    )
    shown = subprocess.run(
        ["/bin/bash", "-c", f". {script}; {asked}"], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    assert shown.stdout.splitlines() == ["analyze", "--online", "--virtual"]


def test_the_package_is_run_as_the_program() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "dxlrun", "check", "none.yaml"],
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE_S,
    )
    assert ran.returncode == 2
    assert "none.yaml" in ran.stderr
