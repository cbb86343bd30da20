"""`dxlrun analyze`: which logs it reads, what it refuses, and where it writes a report: analyze.txt."""

import os
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.kit.commands import Case, Dxlrun, Stage, cases, play
from tests.kit.held_logs import being_written, cut_end

from dxlrun.testing import simulated_robot

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


@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize("case", cases("analyze.txt"))
def test_logs_are_analyzed(dxlrun: Dxlrun, case: Case) -> None:
    stage = Stage()
    with ExitStack() as held:
        stage.given = {
            "writing": lambda _: held.enter_context(being_written(NEWEST)),
            "cut": lambda _: cut_end(NEWEST),
            "gone": lambda _: OLDER.unlink(),
        }
        play(case, dxlrun, stage)
    if any("--report" in line for _, line in case.lines):
        text = Path("report.html").read_text(encoding="utf-8")
        assert text.startswith("<!DOCTYPE html>")
        assert "answered every time." in text
        assert "virtual: times are computed, not measured" in text


@pytest.mark.usefixtures("logs")
def test_report_without_its_extra_is_one_sentence(dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other refusals are in refusals.txt."""
    monkeypatch.setattr("dxlrun.errors.find_spec", lambda _: None)
    said = dxlrun("analyze", NEWEST, "--report", "report.html")
    sentence = "a report needs bokeh (not installed); install it: `pip install 'dxlrun[report]'`"
    assert (said.code, said.errors) == (2, [f"dxlrun: {sentence}"])
