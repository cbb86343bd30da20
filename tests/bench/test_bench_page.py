"""docs/bench.md says what is so."""

from __future__ import annotations

import inspect
import re
import shlex
from pathlib import Path

import pytest

from dxlrun.bench.hosts import HOSTS
from dxlrun.bench.rate import ALLOWED, HIGHEST_HZ
from dxlrun.bench.rounds import WARM, measure
from dxlrun.cli import main
from dxlrun.cli.bench import bench_bus

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "bench.md").read_text()
FLAT = " ".join(PAGE.split())
COMMANDS = [line.strip() for line in PAGE.splitlines() if re.match(r"(    )?dxlrun ", line)]


def test_every_host_is_on_the_page_and_measured_unless_somebody_says_otherwise() -> None:
    names = [kind.name for kind in HOSTS]
    assert re.findall(r"^\| `([\w-]+)` \|", PAGE, re.MULTILINE) == names
    assert inspect.signature(bench_bus).parameters["peers"].default.split(",") == names


def test_the_numbers_of_the_page_are_those_of_the_program() -> None:
    assert inspect.signature(measure).parameters["most"].default == 100
    assert WARM == 3
    assert f"at most {HIGHEST_HZ:.0f} Hz" in FLAT
    assert ALLOWED == 1 / 1000


@pytest.mark.parametrize("line", [line for line in COMMANDS if " bench " in line])
def test_the_commands_of_the_page_are_understood(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = [word for word in shlex.split(line)[1:] if not word.startswith(("robots/", "--json"))]
    # refused for this alone, so everything before it was understood
    robot = [str(ROOT / "robots" / "single_joint.yaml")] if "rate" in words else []
    assert main([*words, *robot, "--seconds", "-1"]) == 2
    assert capsys.readouterr().err.startswith("dxlrun: --seconds -1: give from")
