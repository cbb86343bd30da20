"""What is said of a wrong command line, in a line for a person and with --json: the cases of `refusals.txt`.

    rate 0
      0 is not a rate; give a number of Hz above 0

A command line, and what `dxlrun: ` then says, line by line; ` ...` ends one that goes on. The exit code is 2,
or 1 below the line that says so. No robot runs, and `robots` lies in the working directory.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import read_answer

ROOT = Path(__file__).parents[2]
NEEDED = {"identify": "identify"}
"""Commands that are refused for want of their extra before anything else."""
WITHOUT_JSON = (
    "robots/",
    "setup",
    "calibrate",
    "teach",
    "teleop",
    "echo",
    "examples",
    "missing",
    "swich",
    "chekc",
    "juggle",
    "other/",
    "bioloid_torso",
    ".",
    "--",
)


def _cases() -> Iterator[Any]:
    """Yield words, what is said, and the exit code."""
    for code, part in enumerate(
        reversed((Path(__file__).parent / "refusals.txt").read_text().split("==== exit code 1\n")), 1
    ):
        for block in part.strip().split("\n\n"):
            words, *said = (line.removeprefix("  ") for line in block.split("\n"))
            extra = NEEDED.get(words.split()[0])
            yield pytest.param(words, said, code, id=words, marks=pytest.mark.needs(extra) if extra else ())


@pytest.fixture
def nothing_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.usefixtures("nothing_runs")
@pytest.mark.parametrize(("words", "said", "code"), [*_cases()])
def test_a_wrong_command_line_is_refused(
    dxlrun: Callable[..., Any], tmp_path: Path, words: str, said: list[str], code: int
) -> None:
    plain = dxlrun(*shlex.split(words))
    assert (plain.code, plain.out) == (code, "")
    assert all(
        line.startswith(start.removesuffix("...")) if start.endswith(" ...") else line == start
        for line, start in zip([line.removeprefix("dxlrun: ") for line in plain.errors], said, strict=True)
    ), plain.errors

    if not words.startswith(WITHOUT_JSON):
        for_programs = dxlrun(*shlex.split(words), "--json")
        refusal = read_answer(for_programs.out)
        assert (for_programs.code, for_programs.err, refusal.ok, refusal.result) == (code, "", False, None)
        assert len(refusal.errors) == len(said)
        for one, line in zip(refusal.errors, plain.errors, strict=True):
            assert line.endswith("; ".join(filter(None, (one.what, one.fix))))
    assert [*tmp_path.iterdir()] == [tmp_path / "robots"], "nothing is written"
