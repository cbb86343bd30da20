"""`dxlrun analyze LOG --report FILE.html` on the command line."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.answers import read_answer, result_of
from tests.kit.held_logs import being_written, cut_end

ROBOT = Path(__file__).parents[2] / "robots" / "single_joint.yaml"
"""Of one joint, because a page has a figure for each."""
SHORT = "this is not an MCAP file"
NO_LOG = f"{SHORT}; give a log of dxlrun"


@pytest.fixture
def log(dxlrun: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The log of a short run on virtual time."""
    monkeypatch.chdir(tmp_path)
    assert dxlrun(ROBOT, "--virtual", "--duration", "0.2").code == 0
    (path,) = (tmp_path / "logs").glob("*.mcap")
    return path


@pytest.mark.needs("report")
def test_a_report_is_written_beside_the_output(dxlrun: Callable, log: Path, tmp_path: Path):
    target = tmp_path / "report.html"

    said = dxlrun("analyze", log, "--report", target)

    assert said.code == 0
    assert "report: " in said.out
    assert "report.html" in said.out
    text = target.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "answered every time." in text
    assert "virtual: times are computed, not measured" in text

    said = dxlrun("analyze", log, "--json", "--report", target)
    assert result_of(said.out)["robot"] == "single_joint"


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("run.mcap", "is not a name for a report"), ("missing/report.html", "not found")],
)
def test_a_report_never_goes_where_it_does_harm(dxlrun: Callable, tmp_path: Path, name: str, sentence: str):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log")

    said = dxlrun("analyze", log, "--report", tmp_path / name)

    assert said.code == 2
    assert len(said.errors) == 1
    assert sentence in said.err
    assert log.read_bytes() == b"a log"


def test_without_bokeh_one_sentence_has_the_command_that_installs_it(
    dxlrun: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"a log")
    found = importlib.util.find_spec
    monkeypatch.setattr("dxlrun.errors.find_spec", lambda name: None if name == "bokeh" else found(name))

    said = dxlrun("analyze", log, "--report", tmp_path / "report.html")

    assert said.code == 2
    assert said.errors == [
        "dxlrun: a report needs bokeh (not installed); install it: `pip install 'dxlrun[report]'`"
    ]


def two_logs(log: Path) -> tuple[Path, Path]:
    """Make another log beside one, an hour older."""
    older = log.with_name("older.mcap")
    older.write_bytes(log.read_bytes())
    before = log.stat().st_mtime - 3600
    os.utime(older, (before, before))
    return log, older


def test_without_an_argument_the_newest_log_of_the_directory_is_analyzed(dxlrun: Callable, log: Path):
    newest, _ = two_logs(log)

    said = dxlrun("analyze")

    assert said.code == 0
    assert said.out.splitlines()[0] == f"log: {newest.relative_to(Path.cwd())}"
    assert result_of(dxlrun("analyze", "--json").out)["log"] == str(newest.relative_to(Path.cwd()))


def test_without_an_argument_a_log_that_is_being_written_is_not_analyzed(dxlrun: Callable, log: Path):
    newest, older = two_logs(log)
    with being_written(newest):
        assert dxlrun("analyze").out.splitlines()[0] == f"log: {older.relative_to(Path.cwd())}"
        older.unlink()
        said = dxlrun("analyze")
    assert said.code == 2
    assert said.errors == [
        f"dxlrun: {newest.relative_to(Path.cwd())} is being written; end its run, or give this path "
        "for a partial analysis"
    ]


def test_a_log_that_is_being_written_is_called_so(dxlrun: Callable, log: Path):
    cut_end(log)
    with being_written(log):
        said = dxlrun("analyze", log)
        report = result_of(dxlrun("analyze", log, "--json").out)
        assert ": being written; so far: " in dxlrun("analyze", log, log).out
    assert (said.code, report["being_written"], report["complete"]) == (1, True, False)
    assert "is still being written by a run; its last cycle is at " in said.out
    assert "no, a run is writing it" in said.out
    ended = dxlrun("analyze", log)
    assert "the recorder was killed or could not write; its last cycle is at " in ended.out


def test_without_a_log_in_the_directory_one_sentence_names_the_directory(
    dxlrun: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)

    said = dxlrun("analyze")

    assert said.code == 2
    assert said.errors == [
        f"dxlrun: no log found in {tmp_path}/logs; give the path of a log, or change to the working "
        "directory of the run"
    ]


def test_several_logs_get_one_line_each(dxlrun: Callable, log: Path, tmp_path: Path):
    first, second = two_logs(log)
    other = tmp_path / "other.mcap"
    other.write_bytes(b"no log")

    said = dxlrun("analyze", first, other, second)

    assert said.code == 2  # for the one that is no log; the others are not hidden by it
    assert said.out.splitlines() == [
        f"{path}: Good: ran for 0.2 s without a motion." for path in (first, second)
    ]
    assert said.errors == [f"dxlrun: {other}: {NO_LOG}"]
    answer = read_answer(dxlrun("analyze", first, other, second, "--json").out)
    assert [each["log"] for each in answer.result["logs"]] == [str(first), str(second)]
    assert [error.what for error in answer.errors] == [f"{other}: {SHORT}"]


@pytest.mark.parametrize(("option", "value"), [("--report", "file.html"), ("--worst", "3")])
def test_what_is_for_one_log_is_refused_for_several(dxlrun: Callable, log: Path, option: str, value: str):
    first, second = two_logs(log)

    said = dxlrun("analyze", first, second, option, value)

    assert said.code == 2
    assert said.errors == [f"dxlrun: {option} is for one log, but 2 are given; analyze one at a time"]


def test_every_log_that_is_missing_is_named(dxlrun: Callable, log: Path):
    said = dxlrun("analyze", "a.mcap", log, "b.mcap")

    assert said.code == 2
    assert [line[:20] for line in said.errors] == ["dxlrun: log a.mcap n", "dxlrun: log b.mcap n"]


@pytest.mark.parametrize("worst", ["-1", "11"])
def test_more_worst_cycles_than_are_kept_are_refused(dxlrun: Callable, log: Path, worst: str):
    said = dxlrun("analyze", log, f"--worst={worst}")
    assert said.code == 2
    assert f"--worst {worst}: out of range; give 1 to 10" in said.err
    assert "Cycle " not in dxlrun("analyze", log, "--worst", "3").out  # none was late
