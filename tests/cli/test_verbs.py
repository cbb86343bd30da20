"""Verbs that packages add, and the help that names all of them."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.kit.packages import Install, installing

from dxlrun.cli import app, verb_registry
from dxlrun.cli.help import TEXT

GREETING = """
from dxlrun import Command, hookimpl

@hookimpl
def dxlrun_contract():
    return 4

@hookimpl
def dxlrun_commands():
    return [Command("greet", "greeting_work:greet", "Greet a robot.", "Manners")]
"""
WORK = '''
def greet(name: str, /) -> int:
    """Greet a robot.

    Parameters
    ----------
    name
        Its name.
    """
    print(f"hello {name}")
    return 3
'''
Dxlrun = Callable[..., Any]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    with installing(tmp_path, monkeypatch) as install:
        (tmp_path / "greeting_work.py").write_text(WORK)
        yield install


def test_the_text_of_the_help_is_what_the_commands_say(capsys: pytest.CaptureFixture[str]) -> None:
    app.build(listed=True).help_print([])
    assert capsys.readouterr().out == TEXT.read_text()


@pytest.mark.parametrize("name", verb_registry.packaged())
def test_a_verb_of_our_packages_is_described_by_its_docstring_alone(name: str) -> None:
    assert verb_registry.packaged()[name].help == ""
    assert app.build(name)[name].help.partition("\n")[0]
    assert verb_registry.package_of(name) == verb_registry.packaged()[name].place.partition(".")[0]


@pytest.mark.parametrize("name", verb_registry.names())
def test_the_help_of_a_verb_has_examples_that_can_be_typed(name: str, dxlrun: Dxlrun) -> None:
    said = dxlrun("help", name)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith(dxlrun(name, "--help").out)
    lines = said.out.partition("\nExamples\n")[2].splitlines()
    assert lines
    for line in lines:
        program, *words = shlex.split(line)
        assert (program, words[0]) == ("dxlrun", name)
        app.build(name).parse_args(words, print_error=False, exit_on_error=False)


def test_help_without_a_verb_lists_them_and_an_unknown_one_is_refused(dxlrun: Dxlrun) -> None:
    assert dxlrun("help").out == dxlrun("--help").out
    assert "did you mean check?" in dxlrun("help", "chek").err
    assert dxlrun("help", "check", "more").errors == [
        "dxlrun: there is no command check more; `dxlrun help` lists all of them"
    ]


def test_a_verb_of_each_package_has_a_heading_of_the_help() -> None:
    assert {one.group for one in verb_registry.packaged().values()} <= set(verb_registry.GROUPS)
    assert len(verb_registry.GROUPS[verb_registry.EVERY_DAY]) == 10  # `help`, and with `analyze` ten more


def test_a_foreign_verb_stands_in_the_group_that_it_names_or_behind_all(
    install: Install, dxlrun: Dxlrun
) -> None:
    install("in-a-group", "grouped", GREETING.replace('"Manners"', '"Servos"'))
    install("without-one", "lonely", GREETING.replace(', "Manners"', "").replace('"greet"', '"wave"'))
    silent = GREETING.replace(', "Greet a robot.", "Manners"', "").replace('"greet"', '"nod"')
    install("without-help", "silent", silent)
    parts = dxlrun("--help").out.split("\n\n")
    assert next(part for part in parts if part.startswith("Servos\n")).endswith(
        "\ngreet         Greet a robot."
    )
    assert {"Other commands\nwave  Greet a robot.\nnod   greeting_work."} <= {*parts}


def test_a_foreign_package_adds_a_verb(install: Install, dxlrun: Dxlrun) -> None:
    install("good-manners", "greeting", GREETING)
    said = dxlrun("greet", "op3")
    assert (said.code, said.out) == (3, "hello op3\n")
    assert "\n\nManners\ngreet  Greet a robot.\n\nArguments\n" in dxlrun("--help").out
    assert "command greet" in dxlrun("plugins").out
    assert "did you mean get or greet?" in dxlrun("gret").err


@pytest.mark.parametrize(
    "source", ["import nowhere\n", "raise SystemExit(3)\n", GREETING.replace("greet", "run")]
)
def test_a_broken_package_costs_no_verb(install: Install, dxlrun: Dxlrun, source: str) -> None:
    install("bad-manners", "rude", source)
    assert dxlrun("doctor", "--help").code == 0
    said = dxlrun("greet", "op3")
    assert (said.code, said.out) == (2, "")
    assert "'greet' is neither a command nor a robot file" in said.err
    assert "Traceback" not in dxlrun("run", "op3").err


def test_a_verb_that_cannot_be_imported_is_the_fault_of_its_package(install: Install, dxlrun: Dxlrun) -> None:
    install("no-manners", "nowhere", GREETING.replace("greeting_work", "no_such_work"))
    said = dxlrun("greet", "op3")
    assert said.code == 1
    (line,) = said.errors
    assert line.startswith("dxlrun: command greet (no_such_work:greet) failed: ImportError: ")
    assert line.endswith("; reinstall its package, or report it to its author")


def test_a_verb_whose_code_is_broken_is_left_out_of_the_list(install: Install, tmp_path: Path) -> None:
    install("good-manners", "greeting", GREETING)
    assert "greet" in app.build(listed=True)
    (tmp_path / "greeting_gone.py").write_text("import nowhere\n")
    install(
        "bad-manners", "bad", GREETING.replace("greeting_work", "greeting_gone").replace('"greet"', '"bow"')
    )
    assert {"greet", "bow"} <= {*verb_registry.packaged()}
    assert "bow" not in app.build(listed=True)


def test_a_package_takes_no_verb_of_the_core(install: Install, dxlrun: Dxlrun) -> None:
    install("bold", "bold", GREETING.replace('"greet"', '"check"'))
    assert dxlrun("check", "--help").out.startswith("Usage: dxlrun check")


@pytest.mark.parametrize(
    ("verb", "package", "place"),
    [("analyze", "dxlrun_analysis", "."), ("view", "dxlrun_view", "./plugins/dxlrun_view")],
)
def test_a_verb_whose_package_is_absent_names_the_line_that_installs_it(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, verb: str, package: str, place: str
) -> None:
    monkeypatch.setattr(verb_registry, "packaged", dict)
    said = dxlrun(verb, "run.mcap")
    assert said.code == 2
    assert said.errors == [
        f"dxlrun: `dxlrun {verb}` needs the package {package}, whose import failed; "
        f"run `pip install {place}` in a clone of dxlrun"
    ]
