"""A season: logs of runs on virtual time, one not good, one of another robot, one no log."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest

from dxlrun.cli import main
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, simulated_robot
from dxlrun_analysis.season import cache
from dxlrun_analysis.season.season import converted, find_logs

ROBOTS = Path(__file__).parents[3] / "robots"


class Here(Executor):
    """Works in this process, at once; counts what it does."""

    def __init__(self) -> None:
        self.jobs: list[object] = []

    def submit(self, work, /, *arguments, **options):
        self.jobs.append(arguments)
        future: Future = Future()
        try:
            future.set_result(work(*arguments, **options))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some logs, and other files."""
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
    return directory


@pytest.fixture(scope="session")
def tables(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with the tables of these logs."""
    directory = tmp_path_factory.mktemp("tables")
    found = converted(
        find_logs(made), directory / "dxlrun" / "logs", lambda: nullcontext(Here()), lambda *_: None
    )
    assert not found.problems
    return directory


@pytest.fixture
def season(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same in a directory of the test, with a cache of its own; the logs have been there for long."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_SETTLED_NS", 0)
    return Path(shutil.copytree(made, tmp_path / "season"))


@pytest.fixture
def known(season: Path, tables: Path, tmp_path: Path) -> Path:
    """The same, with the tables of these logs in the cache: copies of known contents."""
    shutil.copytree(tables, tmp_path / "cache")
    return season


@pytest.fixture(scope="session")
def split_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log in parts, of 100 cycles."""
    path = tmp_path_factory.mktemp("split") / "run"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=2.0)
    VirtualRobot(replace(plan, recording=RecordingPlan(split_ns=1_000_000_000)), log=path).run()
    return path


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """Let `dxlrun logs` convert in this process."""
    executor = Here()

    @contextmanager
    def processes(count: int) -> Iterator[Executor]:
        yield executor

    monkeypatch.setattr("dxlrun_analysis.season.pools.processes", processes)
    return executor


class Said(NamedTuple):
    code: int
    out: str
    errors: list[str]


@pytest.fixture
def dxlrun(capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Run a command line in this process."""

    def dxlrun(*words: object) -> Said:
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        return Said(code, said.out, said.err.splitlines())

    return dxlrun
