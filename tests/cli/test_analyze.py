"""`dxlrun analyze LOG --report FILE.html` on the command line."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def log(dxlrun: Callable, torso: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The log of a short run on virtual time."""
    monkeypatch.chdir(tmp_path)
    assert dxlrun(torso, "--virtual", "--duration", "0.2").code == 0
    (path,) = (tmp_path / "logs").glob("*.mcap")
    return path


def test_a_report_is_written_beside_what_is_said(dxlrun: Callable, log: Path, tmp_path: Path):
    target = tmp_path / "report.html"

    said = dxlrun("analyze", log, "--report", target)

    assert said.code == 0
    assert "report: " in said.out
    assert "report.html" in said.out
    text = target.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "All 8 servos answered every time." in text
    assert "virtual: times are computed, not measured" in text

    said = dxlrun("analyze", log, "--json", "--report", target)
    assert json.loads(said.out)["robot"] == "bioloid_torso"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("run.mcap", "its name ends in .html"), ("missing/report.html", "there is no directory")],
)
def test_a_report_never_goes_where_it_does_harm(dxlrun: Callable, tmp_path: Path, name: str, sentence: str):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log")

    said = dxlrun("analyze", log, "--report", tmp_path / name)

    assert said.code == 2
    assert len(said.errors) == 1
    assert sentence in said.err
    assert log.read_bytes() == b"a log"


def test_without_matplotlib_one_sentence_says_how_to_get_it(
    dxlrun: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log")
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "dxlrun.cli.analyze.find_spec", lambda name: None if name == "matplotlib" else found(name)
    )

    said = dxlrun("analyze", log, "--report", tmp_path / "report.html")

    assert said.code == 2
    assert said.errors == [
        "dxlrun: a report needs matplotlib for its plots; `pip install 'dxlrun[report]'` installs it"
    ]
