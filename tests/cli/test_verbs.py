"""Verbs that packages add, and the help that names all of them."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.kit.commands import Dxlrun
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


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    with installing(tmp_path, monkeypatch) as install:
        (tmp_path / "greeting_work.py").write_text(WORK)
        yield install


def greeting(**changes: str) -> str:
    """Return a package with other words in place of some."""
    text = GREETING
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


def test_text_of_the_help_is_what_the_commands_say(capsys: pytest.CaptureFixture[str]) -> None:
    app.build(listed=True).help_print([])
    assert capsys.readouterr().out == TEXT.read_text()


@pytest.mark.parametrize("name", verb_registry.names())
def test_help_of_a_verb_has_examples_that_can_be_typed(name: str, dxlrun: Dxlrun) -> None:
    said = dxlrun("help", name)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith(dxlrun(name, "--help").out)
    lines = said.out.partition("\nExamples\n")[2].splitlines()
    assert lines
    built = app.build(name)
    for line in lines:
        program, *words = shlex.split(line)
        assert (program, words[0]) == ("dxlrun", name)
        built.parse_args(words, print_error=False, exit_on_error=False)
    if (packaged := verb_registry.packaged().get(name)) is not None:  # its docstring alone describes it
        assert packaged.help == ""
        assert built[name].help.partition("\n")[0]
        assert verb_registry.package_of(name) == packaged.place.partition(".")[0]
        assert packaged.group in verb_registry.GROUPS


def test_foreign_verb_is_in_the_group_that_it_names_or_after_all(install: Install, dxlrun: Dxlrun) -> None:
    install("in-a-group", "grouped", greeting(Manners="Servos"))
    install("without-one", "lonely", greeting(**{', "Manners"': "", '"greet"': '"wave"'}))
    install("without-help", "silent", greeting(**{', "Greet a robot.", "Manners"': "", '"greet"': '"nod"'}))
    parts = dxlrun("--help").out.split("\n\n")
    servos = next(part for part in parts if part.startswith("Servos\n"))
    assert servos.endswith("\ngreet         Greet a robot.")
    assert "Other commands\nwave  Greet a robot.\nnod   greeting_work." in parts


def test_foreign_package_adds_a_verb_and_takes_none(install: Install, dxlrun: Dxlrun) -> None:
    install("good-manners", "greeting", GREETING)
    install("bold", "bold", greeting(**{'"greet"': '"check"'}))
    assert dxlrun("greet", "op3") == (3, "hello op3\n", "")
    assert "\n\nManners\ngreet  Greet a robot.\n\nArguments\n" in dxlrun("--help").out
    assert "command greet" in dxlrun("plugins").out
    assert "did you mean get or greet?" in dxlrun("gret").err
    assert dxlrun("check", "--help").out.startswith("Usage: dxlrun check")


@pytest.mark.parametrize("source", ["import nowhere\n", "raise SystemExit(3)\n", greeting(greet="run")])
def test_broken_package_costs_no_verb(install: Install, dxlrun: Dxlrun, source: str) -> None:
    install("bad-manners", "rude", source)
    assert dxlrun("doctor", "--help").code == 0
    said = dxlrun("greet", "op3")
    assert (said.code, said.out) == (2, "")
    assert "'greet' is neither a command nor a robot file" in said.err
    assert "Traceback" not in dxlrun("run", "op3").err


def test_verb_that_cannot_be_imported_is_the_fault_of_its_package(
    install: Install, dxlrun: Dxlrun, tmp_path: Path
) -> None:
    install("no-manners", "absent", greeting(greeting_work="no_such_work"))
    said = dxlrun("greet", "op3")
    assert said.code == 1
    (line,) = said.errors
    assert line.startswith("dxlrun: command greet (no_such_work:greet) failed: ImportError: ")
    assert line.endswith("; reinstall its package, or report it to its author")
    (tmp_path / "greeting_gone.py").write_text("import nowhere\n")
    install("bad-manners", "bad", greeting(**{"greeting_work": "greeting_gone", '"greet"': '"bow"'}))
    install("good-manners", "good", greeting(**{'"greet"': '"nod"'}))
    assert {"bow", "nod"} <= {*verb_registry.packaged()}
    listed = app.build(listed=True)
    assert ("nod" in listed, "bow" in listed) == (True, False)


@pytest.mark.parametrize(
    ("verb", "package", "place"),
    [("analyze", "dxlrun_analysis", "."), ("view", "dxlrun_view", "./plugins/dxlrun_view")],
)
def test_verb_whose_package_is_absent_names_the_line_that_installs_it(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, verb: str, package: str, place: str
) -> None:
    monkeypatch.setattr(verb_registry, "packaged", dict)
    for problem, spec in (("which is not installed", None), ("whose import failed", "broken")):
        monkeypatch.setattr(verb_registry, "find_spec", lambda _, spec=spec: spec)
        for words in ([verb, "run.mcap"], [verb, "--robot", "c"], [verb, "c", "--open"], [verb, "--help"]):
            said = dxlrun(*words)
            assert said.code == 2
            assert said.errors == [
                f"dxlrun: `dxlrun {verb}` needs the package {package}, {problem}; "
                f"run `pip install {place}` in a clone of dxlrun"
            ]
