"""`dxlrun logs`: rows as the report on each log has them, read once, asked in SQL that can only read."""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.answers import result_of
from tests.kit.commands import Said, cases, play
from tests.kit.held_logs import being_written, cut_end
from tests.kit.pages import page_text

from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LogHeader
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, read_log, simulated_robot
from dxlrun_analysis.latency import latency_log
from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.season import season_runs
from dxlrun_analysis.season.pools import processes

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[3] / "robots"
NAMES = ["first.mcap", "may/broken.mcap", "may/copy.mcap", "may/second.mcap", "may/third.mcap"]
Here = list[str]  # Names of the logs that were read


def rows(said: Said) -> dict[str, dict[str, Any]]:
    """Return the rows that a command printed as JSON, by the names of their logs."""
    assert said.code == 0, said.err
    return {row["log"]: row for row in result_of(said.out)["rows"]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Some logs of runs on virtual time, one that is none, and other files; all have been there for long.

    They are only asked, and their table is kept from test to test.
    """
    directory = tmp_path_factory.mktemp("season")
    (directory / "may").mkdir()
    torso, joint = ROBOTS / "bioloid_torso.yaml", ROBOTS / "single_joint.yaml"
    simulated_robot(torso, duration_s=0.5, log=directory / "first.mcap").run()
    simulated_robot(torso, duration_s=0.8, log=directory / "may" / "second.mcap").run()
    simulated_robot(joint, duration_s=0.3, log=directory / "may" / "third.mcap").run()
    shutil.copy(directory / "first.mcap", directory / "may" / "copy.mcap")
    (directory / "may" / "broken.mcap").write_bytes(b"no log at all")
    (directory / "first.ledger.jsonl").write_text("{}")
    (directory / "notes.txt").write_text("the robot fell over")
    for path in directory.rglob("*.mcap"):
        os.utime(path, (1e9, 1e9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield directory


@pytest.fixture
def season(made, tmp_path, monkeypatch):
    """The same to be changed, in a directory of the test, which keeps its table there too."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(made, tmp_path / "season"))


REPORTS: dict[bytes, Any] = {}
"""Of each log that was read in this process, by its content"""


@pytest.fixture
def here(monkeypatch):
    """Let `dxlrun logs` read logs in this process, each content once for all tests."""
    read: Here = []
    analyze = season_runs.analyze

    def analyze_once(reader: Any) -> Any:
        if not reader.about.complete or not reader.path.is_file():
            return analyze(reader)
        content = hashlib.sha256(reader.path.read_bytes()).digest()
        if content not in REPORTS:
            REPORTS[content] = analyze(reader)
        return REPORTS[content]

    def together(logs: Sequence[season_runs.FoundLog], *_: object) -> dict[str, season_runs.Row]:
        read.extend(log.name for log in logs)
        return {log.name: season_runs.row_of(log) for log in logs}

    monkeypatch.setattr(season_runs, "analyze", analyze_once)
    monkeypatch.setattr(season_runs, "_together", together)
    return read


def test_rows_are_what_the_analysis_of_each_log_has(season, here, dxlrun):
    found = rows(dxlrun("logs", season, "--json"))

    assert list(found) == NAMES
    broken = found.pop("may/broken.mcap")
    assert broken["unreadable"] == "this is not an MCAP file; give a log of dxlrun"
    assert (broken["robot"], broken["bytes"]) == (None, 13)
    for name, row in found.items():
        report = analyze_log(season / name)
        assert row["robot"] == report.robot
        assert row["good"] == report.verdict.good
        assert row["cycles"] == report.totals.periods.records
        assert row["lasted_s"] == pytest.approx(report.totals.periods.seconds)
        assert row["asked"] == sum(servo.asked for servo in report.totals.servos)
        assert row["sentence"] == report.verdict.findings[1].sentence
        assert row["findings"] == [one.code for one in report.verdict.findings]
        assert row["bytes"] == (season / name).stat().st_size
        cycles = read_log(season / name).cycles
        assert row["hottest_deg_c"] == np.nanmax(cycles["temperature"])
        assert row["lowest_voltage_v"] == pytest.approx(np.nanmin(cycles["voltage"]))
    assert found["may/copy.mcap"] | {"log": ""} == found["first.mcap"] | {"log": ""}


def test_a_log_that_is_being_written_is_called_so_and_read_again(season, here, dxlrun):
    log = season / "first.mcap"
    cut_end(log)
    os.utime(log, (1e9, 1e9))
    with being_written(log):
        assert rows(dxlrun("logs", season, "--json"))["first.mcap"]["being_written"]
        assert "being written" in dxlrun("logs", season).out
    here.clear()
    assert not rows(dxlrun("logs", season, "--json"))["first.mcap"]["being_written"]
    assert here == ["first.mcap"]


def test_a_log_is_read_once_and_again_only_when_it_changed(season, here, dxlrun):
    first = rows(dxlrun("logs", season, "--json"))
    assert sorted(here) == NAMES
    here.clear()
    assert rows(dxlrun("logs", season, "--json")) == first
    assert here == []

    shutil.copy(season / "may/third.mcap", season / "first.mcap")  # it may change again within a tick
    os.utime(season / "may/second.mcap", (1e9 + 1, 1e9 + 1))
    (season / "may/copy.mcap").unlink()
    for expected in (["first.mcap", "may/second.mcap"], ["first.mcap"]):
        here.clear()
        changed = rows(dxlrun("logs", season, "--json"))
        assert changed["first.mcap"]["robot"] == "single_joint"
        assert "may/copy.mcap" not in changed
        assert here == expected


def test_a_table_that_is_damaged_or_of_other_code_is_made_anew(season, here, dxlrun, monkeypatch):
    first = rows(dxlrun("logs", season, "--json"))
    (file,) = season_runs.cache_directory().rglob("*.parquet")
    data = file.read_bytes()
    flipped = data[:-20] + bytes([data[-20] ^ 0xFF]) + data[-19:]
    for damaged in (flipped, data[: len(data) // 2], b"no table", None):
        if damaged is None:
            monkeypatch.setattr(season_runs, "runtime_hash", lambda: "0" * 64)
        else:
            file.write_bytes(damaged)
        here.clear()
        assert rows(dxlrun("logs", season, "--json")) == first
        assert here == NAMES, damaged


@pytest.mark.parametrize(
    ("where", "sort", "expected"),
    [
        ("robot = 'single_joint'", "log", ["may/third.mcap"]),
        ("unreadable IS NOT NULL", "log", ["may/broken.mcap"]),
        ("cycles > 30", "cycles DESC", ["may/third.mcap", "may/second.mcap"]),
        ("list_contains(findings, 'kept_rate')", "log", [name for name in NAMES if "broken" not in name]),
        ("robot LIKE 'single%' -- and no more", "log", ["may/third.mcap"]),
        ("true", "log DESC", NAMES[::-1]),
        ("cycles = (SELECT max(cycles) FROM logs)", "log", ["may/third.mcap"]),
    ],
)
def test_conditions_choose_logs(made, here, dxlrun, where, sort, expected):  # noqa: PLR0917
    assert list(rows(dxlrun("logs", made, "--json", "--where", where, "--sort", sort))) == expected


def test_people_get_a_table_and_answers_to_the_questions_of_logs_md(made, here, dxlrun):
    said = dxlrun("logs", made)
    assert said.errors == [f"1 other file is in {made}: notes.txt"]
    assert "unreadable" in said.out
    assert "this is not an MCAP file" in " ".join(said.out.split())
    assert said.out.rstrip().endswith("5 of 5 logs")
    lines = re.findall(r"^    dxlrun logs (?!.*--prune)(.+)$", page_text("logs.md"), re.MULTILINE)
    assert len(lines) == 4
    for line in lines:
        place, *words = shlex.split(line)
        assert place in ("logs", "s3://lab/torso")
        assert dxlrun("logs", made, *words).code == 0, line


def test_a_program_of_its_own_prints_nothing_at_its_end(season):
    """DuckDB would print there what of it is not collected."""
    words = [Path(sys.executable).with_name("dxlrun"), "logs", season / "may", "--where", "lost > 5"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("0 of 4 logs", "")


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(made, tmp_path, monkeypatch, dxlrun, case):
    monkeypatch.chdir(tmp_path)
    Path("season").symlink_to(made)
    before = sorted(made.rglob("*"))
    play(case, dxlrun)
    assert sorted(made.rglob("*")) == before


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("no duckdb", "duckdb and pyarrow (not installed); install it: `pip install 'dxlrun[logs]'`"),
        ("no cache", "set XDG_CACHE_HOME to another directory"),
    ],
)
def test_what_cannot_be_is_one_sentence(season, here, dxlrun, monkeypatch, kind, sentence):  # noqa: PLR0917
    if kind == "no duckdb":
        monkeypatch.setattr("dxlrun.errors.find_spec", lambda name: None)
    if kind == "no cache":
        monkeypatch.setenv("XDG_CACHE_HOME", str(season / "notes.txt"))
    said = dxlrun("logs", season)
    assert (said.code, len(said.errors)) == (2, 1)
    assert sentence in said.errors[0]


def test_a_log_in_parts_is_one_log(season, here, dxlrun):
    path = season / "torso_1"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=2.0)
    VirtualRobot(replace(plan, recording=RecordingPlan(split_ns=1_000_000_000)), log=path).run()
    (path / "notes.txt").touch()
    said = dxlrun("logs", season, "--json")
    row = rows(said)["torso_1"]
    assert row["cycles"] == analyze_log(path).totals.periods.records == 100
    assert row["bytes"] == sum(part.stat().st_size for part in path.glob("*.mcap"))
    assert result_of(said.out)["other_files"] == ["notes.txt", "torso_1/notes.txt"]
    assert list(rows(said)) == [*NAMES, "torso_1"]
    assert list(rows(dxlrun("logs", path, "--json"))) == ["torso_1"]


def test_an_odd_file_hides_no_other_log(season, here, dxlrun, monkeypatch):
    """A name that is not UTF-8, a pipe, a broken link, a measurement, and a log that is too much for us."""
    shutil.copy(season / "first.mcap", season / os.fsdecode(b"\xff.mcap"))
    os.mkfifo(season / "pipe.mcap")
    (season / "gone.mcap").symlink_to("nowhere")
    record = {latency_log.METADATA_NAME: {"settings": "{}"}}
    LogWriter(season / "latency.mcap", LogHeader("latency", (), (), (), 10**6, 0, metadata=record)).close()
    opened = season_runs.open_log

    def strange(path: Path) -> object:
        if path.name == "third.mcap":
            raise ArithmeticError("a strange log\nand more")
        return opened(path)

    monkeypatch.setattr(season_runs, "open_log", strange)
    for _ in range(2):
        said = dxlrun("logs", season, "--json")
        found = rows(said)
        assert set(found) - set(NAMES) == {"\\udcff.mcap", "gone.mcap", "latency.mcap"}
        assert found["\\udcff.mcap"]["robot"] == found["first.mcap"]["robot"] == "bioloid_torso"
        assert "No such file" in found["gone.mcap"]["unreadable"]
        assert "pipe.mcap" in result_of(said.out)["other_files"]
        assert found["latency.mcap"]["good"] is None
        assert found["latency.mcap"]["unreadable"] == (
            "a measurement of `dxlrun latency`, not a run; `dxlrun analyze` shows it"
        )
        assert found["may/third.mcap"]["unreadable"] == "internal error: ArithmeticError: a strange log"


def test_a_process_that_ends_costs_its_own_log_only(season, monkeypatch, dxlrun):
    """A log whose name makes its process end, as too little memory would."""
    (season / "dies.mcap").write_bytes((season / "first.mcap").read_bytes()[:-9])
    (season.parent / "deadly.py").write_text(
        "import os\n"
        "from dxlrun_analysis.season.season_runs import row_of as true_row_of\n"
        "def row_of(log):\n"
        "    if log.name == 'dies.mcap':\n"
        "        os._exit(9)\n"
        "    return true_row_of(log)\n"
    )
    monkeypatch.syspath_prepend(str(season.parent))
    import deadly

    monkeypatch.setattr(season_runs, "row_of", deadly.row_of)
    for name in NAMES[1:]:
        (season / name).unlink()
    found = rows(dxlrun("logs", season, "--json"))
    reason = "the process reading the log crashed or ran out of memory"
    assert {name: row["unreadable"] for name, row in found.items()} == {
        "dies.mcap": reason,
        "first.mcap": None,
    }
    assert processes is season_runs.processes
