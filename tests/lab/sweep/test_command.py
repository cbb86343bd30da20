"""`dxlrun sweep`: mistakes at once, with their places; tables, JSON and pictures of what was measured."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import result_of
from tests.kit.experiments import commands_of

from dxlrun.plan.robot_plan import from_json
from dxlrun_lab.sweep import sweep as sweep_module
from dxlrun_lab.sweep import workers
from dxlrun_lab.sweep.measuring import Measured, Task
from dxlrun_lab.sweep.results import only_writer
from dxlrun_lab.sweep.scores import Scores

Sweep = Callable[..., Any]


def pretended(task: Task) -> Measured:
    """Return scores that follow from the gains, in place of a run: the best is p = 6 where there is one."""
    pid = next(one for one in from_json(task.plan).loop.controllers if "gains" in one.parameters)
    p = float(json.loads(pid.parameters)["gains"]["p"])
    if p == 13:
        return Measured("crashed", "its process ended 2 times")
    rms = abs(p - 6) + 0.01
    return Measured("measured", "", Scores(rms, 1.0, "elbow", 0.1, None, p, 31.0, 99, 0, 0, 0, 0, 1, 1))


@pytest.fixture
def no_workers(monkeypatch):
    """Pretend all runs; gives the counts of workers that were asked for."""
    asked = []

    def here(workers, tasks):
        return ((task.run, pretended(task)) for task in tasks)

    def local(count):
        asked.append(count)
        return nullcontext()

    monkeypatch.setattr(sweep_module, "measured", here)
    monkeypatch.setattr(workers, "workers", local)
    return asked


def test_all_mistakes_are_reported_at_once(sweep, files):
    files.robot.write_text(files.robot.read_text().replace("id: 1", "id: 300"))
    said = sweep("--over", "gains.q=1..2x2", "--over", "limits.position=1,2", "--workers", "0", "rate:=0")
    assert said.code == 2
    assert [error.split(": ", 1)[1].split("; ")[0] for error in said.errors] == [
        "--workers is 0",
        "--over gains.q=1..2x2: the robot file has no gains.q",
        "--over limits.position=1,2: limits.position has values in it",
        "loop.rate is 0 (argument rate:=0), but must be at least 0.001",
        "joints.elbow.id is 300, but must be at most 253",
    ]
    assert [error.split(":")[0] for error in said.errors] == ["command line"] * 3 + ["robot.yaml"] * 2


def test_a_value_that_the_file_forbids_is_reported_at_its_place(sweep):
    said = sweep("--over", "gains.p=-2..1x4", "--over", "elbow.limits.velocity=1,2", "--over", "id=300,1")
    assert said.code == 2
    assert said.errors == [
        "robot.yaml:10:9: with id=300: joints.elbow.id is 300, but must be at most 253; "
        "write for example `id: 1`",
        "robot.yaml:14:53: with elbow.limits.velocity=1 (and 1 more of its values): "
        "joints.elbow.limits.velocity: 1 has no unit; write a velocity with its unit, such as "
        "2 rad/s, or 50 mm/s of a linear joint",
        "robot.yaml:22:16: with gains.p=-2 (and 1 more of its values): controllers.arm_pid.gains.p is -2, "
        "but must be at least 0; correct it",
    ]


def test_a_file_that_is_no_sweep_stays_as_it_is(sweep):
    other = Path("other.parquet")
    for text, sentence in (
        ("PAR1, but no table", "other.parquet is no file of a sweep ("),
        ("something else", "other.parquet cannot be written (it exists, and is not from dxlrun)"),
    ):
        other.write_text(text)
        said = sweep("--over", "gains.p=1,2", "--output", "other.parquet")
        assert said.code == 2
        assert said.errors[0].startswith(f"dxlrun: {sentence}")
        assert other.read_text() == text


def test_two_sweeps_do_not_write_one_file(sweep, no_workers):
    with only_writer(Path("mine.parquet")):
        said = sweep("--over", "gains.p=1,2", "--output", "mine.parquet")
    assert (said.code, said.errors) == (
        2,
        ["dxlrun: another sweep writes --output mine.parquet; wait for its end, or choose another"],
    )
    assert sweep("--over", "gains.p=1,2", "--output", "mine.parquet").code == 0
    assert [path.name for path in Path().glob(".*")] == []


def test_the_best_runs_come_first(sweep, no_workers):
    words = ("--over", "gains.p=4..13x4", "--over", "gains.d=0.1,0.2")
    said = sweep(*words, "--workers", "3")
    assert (said.code, said.errors, no_workers) == (0, [], [3])
    lines = [line.split() for line in said.out.splitlines()]
    best = lines.index(["the", "best", "6", "of", "6", "runs", "by", "rms"])
    assert lines[best + 3][:3] == ["7", "0.1", "1.01000"]
    assert ["2", "crashed", "its", "process", "ended", "2", "times"] in lines
    again = sweep(*words)
    assert "8 of 8 runs, 6 of them before" in again.out  # the crashed ones were tried again
    by_energy = result_of(sweep(*words, "--sort", "energy", "--json").out)
    assert [row["values"]["controllers.arm_pid.gains.p"] for row in by_energy["rows"]][:3] == [4.0, 4.0, 7.0]
    assert by_energy["rows"][-1]["status"] == "crashed"
    assert by_energy["rows"][-1]["scores"] is None
    assert by_energy["counts"] == {"points": 8, "there": 6, "measured": 2}
    by_settling = sweep(*words, "--sort", "settling")
    assert "no run has a score for --sort settling" in by_settling.out


@pytest.mark.parametrize(
    "over",
    [
        ["gains.p=2..10x3"],
        ["rate=50,100", "command_interface=effort,pwm"],
    ],
)
def test_the_score_is_drawn_as_a_map(sweep, no_workers, over):
    words = [word for one in over for word in ("--over", one)]
    said = sweep(*words, "--picture", "drawn.svg")
    assert (said.code, said.errors) == (0, [])
    drawn = Path("drawn.svg").read_text()
    assert drawn.count("rms") > 1
    assert all(one.partition("=")[0] in drawn for one in over)


def test_an_older_map_is_replaced_and_nothing_else(sweep, no_workers):
    for name in ("drawn.svg", "drawn.png", "drawn.pdf"):
        for _ in range(2):
            said = sweep("--over", "gains.p=1,2", "--picture", name)
            assert (said.code, said.errors) == (0, [])
        Path(name).write_text("a letter")
        said = sweep("--over", "gains.p=1,2", "--picture", name)
        assert (said.code, Path(name).read_text()) == (2, "a letter")
        assert f"{name} cannot be written (it exists, and is not from dxlrun)" in said.errors[0]


def test_the_commands_of_the_page_are_understood(no_workers, here, dxlrun):
    for words in commands_of("experiments.md", "sweep"):
        said = dxlrun(*words)
        assert (said.code, "by " in said.out) == (0, True), words


def test_without_its_library_one_sentence_has_the_command(sweep, monkeypatch):
    monkeypatch.setattr("dxlrun.errors.find_spec", lambda name: None)
    said = sweep("--over", "gains.p=1,2")
    sentence = (
        "dxlrun: a sweep needs pyarrow, which is not installed; `pip install 'dxlrun[sweep]'` installs it"
    )
    assert (said.code, said.errors) == (2, [sentence])
