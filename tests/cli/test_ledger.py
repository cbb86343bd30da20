"""`--ledger` of a run on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.judges import log_has_every_byte

from dxlrun.log.log_reader import read_log
from dxlsim.bus.ledger import read_ledger


@pytest.fixture
def in_a_new_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("virtual", [True, False])
@pytest.mark.usefixtures("in_a_new_directory")
def test_the_log_of_a_run_is_what_its_buses_saw(dxlrun: Callable, torso: Path, *, virtual: bool):
    dxlrun(torso, "--duration", "0.3", "--ledger", "seen.jsonl", *(["--virtual"] if virtual else []))
    (log,) = Path("logs").iterdir()  # no ledger beside the log
    log_has_every_byte(read_log(log), read_ledger(Path("seen.jsonl")))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("port:=/dev/ttyUSB9", "--ledger", "seen.jsonl"), "--ledger needs simulated buses"),
        (("--ledger", "missing/seen.jsonl"), "missing/seen.jsonl cannot be written"),
        (("--ledger", "."), "cannot be written"),
        (("--ledger", "letter.txt"), "letter.txt cannot be written (it exists)"),
    ],
)
@pytest.mark.usefixtures("in_a_new_directory")
def test_a_ledger_that_cannot_be_is_refused_before_the_run(
    dxlrun: Callable, torso: Path, words: tuple[str, ...], sentence: str
):
    Path("letter.txt").write_text("Dear servo")
    said = dxlrun(torso, "--virtual", "--duration", "1", *words)
    assert said.code == 2
    assert sentence in said.err
    assert list(Path().iterdir()) == [Path("letter.txt")]
    assert Path("letter.txt").read_text() == "Dear servo"
