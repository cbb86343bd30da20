"""Commands run in this process, and texts of what they print.

A text in `tests/cli` has files behind `---- NAME` lines up to `====`, and then cases with a blank line between them:

    check arm.yaml --online => 1
      > arm: good. ... 2 warnings
      ! Traceback
      warning: ID 3 has another model; ...

A line at the margin is a command and, behind `=>`, its exit code; without one that is 2 where errors are given,
else 0. Below it stand, each in the order of the output: lines of the output (`>`), words that are nowhere in what
it prints (`!`), values of its answer with --json (`json joints[0].id = 7`), and all lines of the errors without
`dxlrun: `. `...` stands for any words, and the number of spaces does not count. `robots` lies in the working
directory, whose path is cut from what is printed. A refused command writes nothing, and says the same with --json.

A stage adds lines of its own to a text: what is given before a command, and what is asked after it.
"""

from __future__ import annotations

import functools
import json
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.kit.answers import read_answer

from dxlrun.cli import main, verb_registry
from dxlrun.cli.app import build

ROOT = Path(__file__).parents[2]
TEXTS = ROOT / "tests" / "cli"
NEEDED = {"identify": "identify", "analyze LOG --report": "report"}
"""Beginnings of commands that need an extra."""


class Said(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        return self.err.splitlines()


Dxlrun = Callable[..., Said]


def command_line(capsys: pytest.CaptureFixture[str]) -> Dxlrun:
    """Return what runs `dxlrun` with some words."""

    def dxlrun(*words: object) -> Said:
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return Said(code, captured.out, captured.err)

    return dxlrun


class Case(NamedTuple):
    """Lines of a text with their numbers, and the files that they need."""

    text: str
    files: dict[str, str]
    lines: list[tuple[int, str]]


def cases(name: str) -> list[Any]:
    """Return the cases of a text as parameters of a test."""
    return [*_cases(name)]


def _cases(name: str) -> Iterator[Any]:
    head, rule, _ = (TEXTS / name).read_text("utf-8").rpartition("====\n")
    parts = re.split(r"^---- (.+)\n", head, flags=re.MULTILINE)
    files = dict(zip(parts[1::2], parts[2::2], strict=True))
    first = (head + rule).count("\n")
    block: list[tuple[int, str]] = []
    for number, line in enumerate([*(TEXTS / name).read_text("utf-8").splitlines(), ""], 1):
        if line.startswith("#") or number <= first:
            continue
        if line:
            block.append((number, line))
        elif block:
            marks = [
                pytest.mark.needs(extra) for start, extra in NEEDED.items() if block[0][1].startswith(start)
            ]
            yield pytest.param(Case(name, files, block), id=block[0][1], marks=marks)
            block = []


class Stage:
    """What the lines of a text can give before a command, ask after it, and name in it."""

    def __init__(self) -> None:
        self.given: dict[str, Callable[[str], object]] = {}
        """By the first word of a line at the margin: what takes the rest of the line"""
        self.asked: dict[str, Callable[[], Sequence[str]]] = {}
        """By the first word of lines below a command: what the rests of those lines are together"""
        self.names: dict[str, str] = {}
        """Words of commands, and what stands for them"""

    def place(self, case: Case) -> Path:
        """Write the files of a case into the working directory."""
        here = Path.cwd()
        if not (here / "robots").exists():
            (here / "robots").symlink_to(ROOT / "robots")
        for name, text in case.files.items():
            (here / name).parent.mkdir(parents=True, exist_ok=True)
            (here / name).write_text(text)
        return here


def play(case: Case, dxlrun: Dxlrun, stage: Stage | None = None) -> None:
    """Run the commands of a case and compare what they print."""
    bare, stage = stage is None, stage or Stage()
    here = stage.place(case)
    steps: list[tuple[int, str, list[str]]] = []
    for number, line in case.lines:
        if line.startswith("  "):
            steps[-1][2].append(line.strip())
        else:
            steps.append((number, line, []))
    for number, line, below in steps:
        word, _, rest = line.partition(" ")
        if word in stage.given:
            stage.given[word](rest)
        else:
            said, words = _check(f"{case.text}:{number}", line, below, dxlrun, stage, here)
            if "--json" not in words and (said.code == 2 or (bare and said.err and not said.out)):
                _check_json(f"{case.text}:{number}", words, said, dxlrun)


def _check(  # noqa: PLR0917
    place: str, line: str, below: list[str], dxlrun: Dxlrun, stage: Stage, here: Path
) -> tuple[Said, list[str]]:
    command, _, code = line.partition(" => ")
    words = [stage.names.get(word, word) for word in shlex.split(command)]
    expected: dict[str, list[str]] = {">": [], "!": [], "json": [], "": []} | {
        word: [] for word in stage.asked
    }
    for each in below:
        kind = each.partition(" ")[0]
        kind = kind if kind in expected else ""
        expected[kind].append(each.removeprefix(kind).strip())
    errors = expected[""]
    before = sorted(here.rglob("*"))
    said = dxlrun(*words)
    printed = [_squeezed(one, here) for one in said.out.splitlines()]
    told = [_squeezed(one.removeprefix("dxlrun: "), here) for one in said.errors]
    shown = f"{place}: {said.code}\n{said.out}{said.err}"

    assert said.code == int(code or 2 * bool(errors)), shown
    lines = iter(printed)
    for one in expected[">"]:
        assert any(matches(one, line) for line in lines), f"{one!r} is missing: {shown}"
    assert [one for one in expected["!"] if one in said.out + said.err] == [], shown
    assert len(told) == len(errors), shown
    assert all(map(matches, errors, told)), shown
    for word in stage.asked:
        if expected[word]:
            found = [_squeezed(one, here) for one in stage.asked[word]()]
            assert len(found) == len(expected[word]), (place, found)
            assert all(map(matches, expected[word], found)), (place, found)
    if said.code == 2:
        assert sorted(here.rglob("*")) == before, f"{place}: something is written"
    if expected["json"]:
        out = said.out if "--json" in words else dxlrun(*words, "--json").out
        answer = read_answer(out)
        for one in expected["json"]:
            path, _, value = one.partition(" = ")
            found = _item(answer.result, path)
            wanted = json.loads(value)
            wanted = pytest.approx(wanted) if isinstance(wanted, float) else wanted
            assert found == wanted, f"{place}: {path} is {json.dumps(found)}"
    return said, words


def _check_json(place: str, words: list[str], said: Said, dxlrun: Dxlrun) -> None:
    """Compare a refusal with the one that programs get."""
    if not _has_json(tuple(words[:2])):
        return
    for_programs = dxlrun(*words, "--json")
    refusal = read_answer(for_programs.out)
    assert (for_programs.code, for_programs.err, refusal.ok, refusal.result) == (
        said.code,
        "",
        False,
        None,
    ), place
    sentences = ["; ".join(filter(None, (one.what, one.fix))) for one in refusal.errors]
    errors = [line for line in said.errors if ": warning: " not in line]
    assert (len(sentences), len(refusal.warnings)) == (len(errors), len(said.errors) - len(errors)), place
    assert all(line.endswith(one) for line, one in zip(errors, sentences, strict=True)), place


@functools.cache
def _has_json(words: tuple[str, ...]) -> bool:
    """Check whether a command has the option --json."""
    if words[0] not in verb_registry.names():
        return False
    command = build(words[0])[words[0]]
    if len(words) > 1 and words[1] in command.resolved_commands():
        command = command[words[1]]
    return any("--json" in one.names for one in command.assemble_argument_collection())


def _item(found: Any, path: str) -> Any:
    """Return what is at a path such as `joints[0].id`; `#` is the number of items."""
    for name, index in re.findall(r"([\w/#-]+)|\[(-?\d+)\]", path):
        found = len(found) if name == "#" else found[name] if name else found[int(index)]
    return found


def _squeezed(line: str, here: Path | None = None) -> str:
    """Return a line with single spaces and single pieces of drawn lines, and without the working directory."""
    line = line.replace(f"{here}/", "") if here else line
    return re.sub(r"([ ─])\1+", r"\1", " ".join(line.split()))


def matches(pattern: str, line: str) -> bool:
    """Compare a line with one of a text, in which `...` stands for any words."""
    parts = _squeezed(pattern).split("...")
    return re.fullmatch(".*".join(map(re.escape, parts)), line) is not None
