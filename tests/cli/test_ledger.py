"""`--ledger` on the command line: a run writes it, `dxlrun analyze` compares with it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def in_a_new_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def run(dxlrun: Callable, torso: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The log and the ledger of a short run on virtual time."""
    monkeypatch.chdir(tmp_path)
    ledger = tmp_path / "run.jsonl"
    assert dxlrun(torso, "--virtual", "--duration", "0.2", "--ledger", ledger).code == 0
    (log,) = (tmp_path / "logs").glob("*.mcap")
    return log, ledger


def test_the_log_of_a_run_is_what_its_buses_saw(dxlrun: Callable, run: tuple[Path, Path]):
    log, ledger = run

    said = dxlrun("analyze", log, "--ledger", ledger)

    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("The log is what the bus saw, to the byte: ")
    assert "differences" in said.out


def test_one_changed_byte_ends_with_1_and_its_place(dxlrun: Callable, run: tuple[Path, Path]):
    log, ledger = run
    lines = ledger.read_text().splitlines()
    index = next(i for i, line in enumerate(lines) if i > 40 and json.loads(line)["direction"] == "out")
    entry = json.loads(lines[index])
    entry["bytes"] = entry["bytes"][:-2] + f"{int(entry['bytes'][-2:], 16) ^ 1:02x}"
    lines[index] = json.dumps(entry)
    ledger.write_text("\n".join(lines) + "\n")

    said = dxlrun("analyze", log, "--ledger", ledger, "--json")
    result = json.loads(said.out)
    assert said.code == 1
    assert not result["same"]
    assert [one["only_ledger"] for one in result["differences"]] == [entry["bytes"][-2:]]

    said = dxlrun("analyze", log, "--ledger", ledger)
    assert said.code == 1
    assert "it differs in 1 place on main" in said.out
    assert "only in the ledger" in said.out


def test_a_run_in_real_time_writes_the_ledger_to_its_option(
    dxlrun: Callable, torso: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    ledger = tmp_path / "seen.jsonl"
    dxlrun(torso, "--duration", "0.3", "--ledger", ledger)
    (log,) = (tmp_path / "logs").iterdir()  # none beside the log
    assert dxlrun("analyze", log, "--ledger", ledger).code == 0


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (None, "there is no ledger"),
        ("nonsense\n", "is not a ledger of a simulated bus"),
        ("", "knows no bus main"),
    ],
    ids=["missing", "another file", "empty"],
)
def test_what_is_no_ledger_is_refused_in_one_sentence(
    dxlrun: Callable, run: tuple[Path, Path], make: str | None, sentence: str
):
    log, ledger = run
    ledger.unlink() if make is None else ledger.write_text(make)

    said = dxlrun("analyze", log, "--ledger", ledger)

    assert said.code == 2
    assert len(said.errors) == 1
    assert sentence in said.err


def test_a_report_and_a_comparison_are_made_one_at_a_time(dxlrun: Callable, run: tuple[Path, Path]):
    log, ledger = run
    said = dxlrun("analyze", log, "--ledger", ledger, "--report", log.with_suffix(".html"))
    assert said.code == 2
    assert "one at a time" in said.err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("port:=/dev/ttyUSB9", "--ledger", "seen.jsonl"), "what simulated buses saw"),
        (("--ledger", "missing/seen.jsonl"), "--ledger missing/seen.jsonl cannot be written"),
        (("--ledger", "."), "cannot be written"),
    ],
)
@pytest.mark.usefixtures("in_a_new_directory")
def test_a_ledger_that_cannot_be_is_refused_before_the_run(
    dxlrun: Callable, torso: Path, words: tuple[str, ...], sentence: str
):
    said = dxlrun(torso, "--virtual", "--duration", "1", *words)
    assert said.code == 2
    assert sentence in said.err
    assert list(Path().iterdir()) == []
