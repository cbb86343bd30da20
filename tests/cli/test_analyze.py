"""`dxlrun analyze`: which logs it reads, what it refuses, and where it writes a report."""

import os
from pathlib import Path

import pytest
from tests.kit.answers import read_answer, result_of
from tests.kit.commands import Dxlrun
from tests.kit.held_logs import being_written, cut_end

from dxlrun.testing import simulated_robot

SHORT = "this is not an MCAP file"
NEWEST, OLDER = Path("logs/newest.mcap"), Path("logs/older.mcap")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The log of a short run; of one joint, because a page has a figure for each."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    robot = Path(__file__).parents[2] / "robots" / "single_joint.yaml"
    simulated_robot(robot, duration_s=0.2, log=path).run()
    return path.read_bytes()


@pytest.fixture
def logs(reader: Path, recorded: bytes) -> None:
    """Two logs in the working directory; the older one is an hour old."""
    for path, age in ((NEWEST, 0), (OLDER, 3600)):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(recorded)
        then = path.stat().st_mtime - age
        os.utime(path, (then, then))


@pytest.mark.needs("report")
@pytest.mark.usefixtures("logs")
def test_report_is_written_next_to_the_output(dxlrun: Dxlrun) -> None:
    said = dxlrun("analyze", NEWEST, "--report", "report.html")
    assert said.code == 0
    assert "report: report.html" in said.out
    text = Path("report.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "answered every time." in text
    assert "virtual: times are computed, not measured" in text
    said = dxlrun("analyze", NEWEST, "--json", "--report", "report.html")
    assert result_of(said.out)["robot"] == "single_joint"


@pytest.mark.usefixtures("logs")
def test_report_without_its_extra_is_one_sentence(dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other refusals are in refusals.txt."""
    monkeypatch.setattr("dxlrun.errors.find_spec", lambda _: None)
    said = dxlrun("analyze", NEWEST, "--report", "report.html")
    sentence = "a report needs bokeh (not installed); install it: `pip install 'dxlrun[report]'`"
    assert (said.code, said.errors) == (2, [f"dxlrun: {sentence}"])


@pytest.mark.usefixtures("logs")
def test_without_an_argument_the_newest_finished_log_of_the_directory_is_analyzed(dxlrun: Dxlrun) -> None:
    said = dxlrun("analyze")
    assert (said.code, said.out.splitlines()[0]) == (0, f"log: {NEWEST}")
    assert result_of(dxlrun("analyze", "--json").out)["log"] == str(NEWEST)
    assert "Cycle " not in dxlrun("analyze", "--worst", "3").out  # none was late
    with being_written(NEWEST):
        assert dxlrun("analyze").out.splitlines()[0] == f"log: {OLDER}"
        OLDER.unlink()
        said = dxlrun("analyze")
    assert said.code == 2
    assert said.errors == [
        f"dxlrun: {NEWEST} is being written; end its run, or give this path for a partial analysis"
    ]


@pytest.mark.usefixtures("logs")
def test_log_that_is_being_written_is_called_so(dxlrun: Dxlrun) -> None:
    cut_end(NEWEST)
    with being_written(NEWEST):
        said = dxlrun("analyze", NEWEST)
        report = result_of(dxlrun("analyze", NEWEST, "--json").out)
        assert ": being written; so far: " in dxlrun("analyze", NEWEST, NEWEST).out
    assert (said.code, report["being_written"], report["complete"]) == (1, True, False)
    assert "is still being written by a run; its last cycle is at " in said.out
    assert "no, a run is writing it" in said.out
    ended = dxlrun("analyze", NEWEST)
    assert "the recorder was killed or could not write; its last cycle is at " in ended.out


@pytest.mark.usefixtures("logs")
def test_several_logs_get_one_line_each(dxlrun: Dxlrun) -> None:
    other = Path("other.mcap")
    other.write_bytes(b"no log")
    said = dxlrun("analyze", NEWEST, other, OLDER)
    assert said.code == 2  # for the one that is not a log; the others are not hidden by it
    assert said.out.splitlines() == [
        f"{path}: Good: ran for 0.2 s without a motion." for path in (NEWEST, OLDER)
    ]
    assert said.errors == [f"dxlrun: {other}: {SHORT}; give a log of dxlrun"]
    answer = read_answer(dxlrun("analyze", NEWEST, other, OLDER, "--json").out)
    assert [each["log"] for each in answer.result["logs"]] == [str(NEWEST), str(OLDER)]
    assert [error.what for error in answer.errors] == [f"{other}: {SHORT}"]
    said = dxlrun("analyze", "a.mcap", NEWEST, "b.mcap")  # every one that is missing is named
    assert (said.code, [line[:20] for line in said.errors]) == (
        2,
        [f"dxlrun: log {one}.mcap n" for one in "ab"],
    )
