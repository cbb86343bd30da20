"""Commands run in this process, and texts of what they print.

A text of `tests/cli`, or a `refusals.txt` next to tests, has files behind lines `---- NAME` up to `====`,
and then cases:

    check arm.yaml --online => 1
      > arm: good. ... 2 warnings
      ! Traceback
      json joints[0].id = 7
      warning: ID 3 has another model; ...

A line at the margin is a command with its exit code; without one that is 2 where errors are given, else 0.
Below a command are lines of the output (`>`, in its order), words that are nowhere in what it prints (`!`),
values of its answer with --json, and then all lines of the errors, without `dxlrun: `. `...` stands for any
words; spaces are not counted, and a blank line ends a case. `robots` is in the working directory,
whose path is cut from what is printed. A refused command writes nothing, and says the same with --json.

A text that begins with `# Each command is a case` has no blank lines between them.

A stage adds lines of its own to a text: what is given before a command, and what is asked after it.
"""

import functools
import json
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.kit.answers import read_answer
from tests.kit.cases import fits

from dxlrun.cli import main, verb_registry
from dxlrun.cli.app import build

ROOT = Path(__file__).parents[2]
TEXTS = ROOT / "tests" / "cli"
NEEDED = {"identify": "identify", "analyze logs/newest.mcap --report": "report"}
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


def cases(name: str | Path) -> list[Any]:
    """Return the cases of a text, in tests/cli or at a path, as parameters of a test."""
    return [*_cases(name)]


def _cases(name: str | Path) -> Iterator[Any]:
    text = (TEXTS / name).read_text("utf-8")
    head, rule, _ = text.rpartition("====\n")
    parts = re.split(r"^---- (.+)\n", head, flags=re.MULTILINE)
    files = dict(zip(parts[1::2], parts[2::2], strict=True))
    first = (head + rule).count("\n")
    each = text.startswith("# Each command is a case")
    block: list[tuple[int, str]] = []
    for number, line in enumerate([*text.splitlines(), ""], 1):
        if line.startswith("#") or number <= first:
            continue
        if block and (not line or (each and not line.startswith(" "))):
            command = block[0][1]
            marks = [pytest.mark.needs(extra) for start, extra in NEEDED.items() if command.startswith(start)]
            yield pytest.param(Case(str(name), files, block), id=command, marks=marks)
            block = []
        if line:
            block.append((number, line))


class Stage:
    """What the lines of a text can give before a command, ask after it, and name in it."""

    def __init__(self) -> None:
        self.given: dict[str, Callable[[str], object]] = {}
        """By the first word of a line at the margin: what takes the rest of the line"""
        self.asked: dict[str, Callable[[], Sequence[str]]] = {}
        """By the first word of lines below a command: what the rests of those lines are together"""
        self.names: dict[str, list[str]] = {}
        """Words of commands, and what stands for them"""

    def place(self, case: Case) -> None:
        """Write the files of a case into the working directory."""
        here = Path.cwd()
        if not (here / "robots").exists():
            (here / "robots").symlink_to(ROOT / "robots")
        for name, text in case.files.items():
            (here / name).parent.mkdir(parents=True, exist_ok=True)
            (here / name).write_text(text)


def play(case: Case, dxlrun: Dxlrun, stage: Stage | None = None) -> None:
    """Run the commands of a case and compare what they print."""
    played = _Play(dxlrun, stage or Stage(), Path.cwd(), bare=stage is None)
    played.stage.place(case)
    steps: list[tuple[int, str, list[str]]] = []
    for number, line in case.lines:
        if line.startswith("  "):
            steps[-1][2].append(line.strip())
        else:
            steps.append((number, line, []))
    for number, line, below in steps:
        word, _, rest = line.partition(" ")
        if word in played.stage.given:
            played.stage.given[word](rest)
        else:
            played.check(f"{case.text}:{number}", line, below)


class _Play(NamedTuple):
    """Commands with a stage in a working directory."""

    dxlrun: Dxlrun
    stage: Stage
    here: Path
    bare: bool

    def check(self, place: str, line: str, below: list[str]) -> None:
        """Run a command and compare it with the lines below it."""
        command, _, code = line.partition(" => ")
        words = [one for word in shlex.split(command) for one in self.stage.names.get(word, [word])]
        expected: dict[str, list[str]] = {one: [] for one in (">", "!", "json", "", *self.stage.asked)}
        for each in below:
            kind = each.partition(" ")[0]
            kind = kind if kind in expected else ""
            expected[kind].append(each.removeprefix(kind).strip())
        before = sorted(self.here.rglob("*"))
        said = self.dxlrun(*words)
        shown = f"{place}: {said.code}\n{said.out}{said.err}"

        assert said.code == int(code or 2 * bool(expected[""])), shown
        lines = iter([self.squeezed(one) for one in said.out.splitlines()])
        for one in expected[">"]:
            assert any(matches(one, line) for line in lines), f"{one!r} is missing: {shown}"
        assert [one for one in expected["!"] if one in said.out + said.err] == [], shown
        self.compare(expected[""], [one.removeprefix("dxlrun: ") for one in said.errors], shown)
        refused = said.code == 2 or (self.bare and bool(said.err) and not said.out)  # not twice on a stage
        if refused and "--json" not in words:
            self.check_json(place, words, said)
        for word, ask in self.stage.asked.items():
            if expected[word]:
                self.compare(expected[word], ask(), place)
        if said.code == 2:
            assert sorted(self.here.rglob("*")) == before, f"{place}: something is written"
        if expected["json"]:
            answer = read_answer(said.out if "--json" in words else self.dxlrun(*words, "--json").out)
            for one in expected["json"]:
                path, _, value = one.partition(" = ")
                found, wanted = _item(answer.result, path), json.loads(value)
                wanted = pytest.approx(wanted) if isinstance(wanted, float) else wanted
                assert found == wanted, f"{place}: {path} is {json.dumps(found)}"

    def compare(self, expected: Sequence[str], found: Sequence[str], shown: str) -> None:
        """Compare lines with all those that a text has."""
        found = [self.squeezed(one) for one in found]
        assert len(found) == len(expected), (shown, found)
        assert all(map(matches, expected, found)), (shown, found)

    def check_json(self, place: str, words: list[str], said: Said) -> None:
        """Compare a refusal with the one that programs get."""
        if not _has_json(tuple(words[:2])):
            return
        code, out, err = self.dxlrun(*words, "--json")
        refusal = read_answer(out)
        assert (code, err, refusal.ok) == (said.code, "", False), (place, out, err)
        sentences = ["; ".join(filter(None, (one.what, one.fix))) for one in refusal.errors]
        errors = [line for line in said.errors if ": warning: " not in line]
        counts = len(sentences), len(refusal.warnings)
        assert counts == (len(errors), len(said.errors) - len(errors)), place
        assert all(line.endswith(one) for line, one in zip(errors, sentences, strict=True)), place

    def squeezed(self, line: str) -> str:
        """Return a line with single spaces, without the working directory."""
        return _squeezed(line.replace(f"{self.here}/", ""))


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


def _squeezed(line: str) -> str:
    """Return a line with single spaces, and one piece of each drawn line."""
    return re.sub(r"([ ─])\1+", r"\1", " ".join(line.split()))


def matches(pattern: str, line: str) -> bool:
    """Compare a line with one of a text, in which `...` stands for any words."""
    return fits(line, _squeezed(pattern))
