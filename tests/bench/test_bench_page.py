"""The figures and commands of docs/explanation/bench.md are those of the program."""

import inspect
import re
import shlex
from pathlib import Path

import pytest
from tests.kit.pages import page_text

from dxlrun.cli import main
from dxlrun_lab.highest_rate import ALLOWED, HIGHEST_HZ
from exchange import command
from exchange.hosts import HOSTS
from exchange.rounds import WARM, measure

ROOT = Path(__file__).parents[2]
PAGE = page_text("bench.md")
FLAT = " ".join(PAGE.split())
PROGRAM = "python bench/exchange"
EXCHANGES = [
    line
    for path in sorted(ROOT.glob("docs/**/*.md"))
    for line in re.findall(rf"(?:^ *|`){PROGRAM}[^`\n]*", path.read_text(), re.MULTILINE)
]


def test_every_host_is_on_the_page_and_measured_by_default() -> None:
    names = [kind.name for kind in HOSTS]
    assert re.findall(r"^\| `([\w-]+)` \|", PAGE, re.MULTILINE) == names
    assert command.parser().get_default("peers").split(",") == names


def test_the_numbers_of_the_page_are_those_of_the_program() -> None:
    assert inspect.signature(measure).parameters["most"].default == 100
    assert WARM == 3
    assert f"at most {HIGHEST_HZ:.0f} Hz" in FLAT
    assert ALLOWED == 1 / 1000


def test_the_search_for_a_rate_is_understood_as_the_page_has_it(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = re.findall(r"^    dxlrun (bench .+)$", PAGE, re.MULTILINE)
    words = [str(ROOT / word) if word.startswith("robots/") else word for word in shlex.split(line)]
    # refused for this alone, so everything before it was understood
    assert main([*words, "--duration", "-1"]) == 2
    assert capsys.readouterr().err.startswith("dxlrun: --duration -1: give 0.1")


def test_the_exchange_is_measured_with_the_options_of_the_pages(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(EXCHANGES) >= 2
    for line in EXCHANGES:
        assert command.main([*shlex.split(line.partition(PROGRAM)[2]), "--seconds", "-1"]) == 2, line
        assert "--seconds -1: give from" in capsys.readouterr().err, line
