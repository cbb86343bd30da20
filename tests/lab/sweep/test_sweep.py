"""A sweep on several processes: the same rows wherever they are measured, and nothing is lost that was."""

from __future__ import annotations

import itertools
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from multiprocessing import active_children
from pathlib import Path

import pytest
from msgspec import structs

from dxlrun.errors import InputError
from dxlrun_lab.sweep import sweep as sweep_module
from dxlrun_lab.sweep.grid import Grid
from dxlrun_lab.sweep.measuring import Measured, Task, code_checksum, measure
from dxlrun_lab.sweep.results import difference, read_results
from dxlrun_lab.sweep.sweep import Sweep, header_of
from dxlrun_lab.sweep.workers import Worker, measured
from dxlrun_lab.sweep.workers import workers as processes

SIDE = int(os.environ.get("DXLRUN_SWEEP_SIDE", "3"))
"""Values of each of two parameters; the campaign has 8, so 64 runs."""
FULL = SIDE >= 8
OVER = (f"gains.p=2..10x{SIDE}", f"gains.d=0.05..0.2x{SIDE}")


@pytest.fixture(scope="module")
def workers(plugin):
    """Two processes, which know the plug-in."""
    sys.path.insert(0, str(plugin))
    try:
        with processes(2) as found:
            yield found
    finally:
        sys.path.remove(str(plugin))


def prepared(files: object, output: str, over: Sequence[str] = OVER, limit_s: float = 60.0) -> Sweep:
    robot, motion = Path("robot.yaml"), Path("motion.yaml")
    grid = Grid(robot, {}, [motion], over)
    return Sweep(grid, header_of(grid, {}, "dxlrun sweep"), Path(output), limit_s)


def run_on(
    workers: list[Worker], sweep: Sweep, progress: Callable[[str, float], None] = lambda *_: None
) -> None:
    sweep.run(lambda: nullcontext(workers), progress)


def in_one_process(monkeypatch: pytest.MonkeyPatch, output: str, over: Sequence[str] = OVER) -> Sweep:
    """Run the sweep here, one run after the other."""

    def here(workers: object, tasks: Iterator[Task]) -> Iterator[tuple[str, Measured]]:
        for task in tasks:
            yield task.run, measure(task)

    with monkeypatch.context() as patch:
        patch.setattr(sweep_module, "measured", here)
        sweep = prepared(None, output, over)
        sweep.run(lambda: nullcontext([]), lambda *_: None)
    return sweep


@pytest.fixture(scope="module")
def rows(texts, tmp_path_factory):
    """The rows of the sweep, measured in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("one"))
        for name, text in zip(("robot.yaml", "motion.yaml"), texts, strict=True):
            Path(name).write_text(text)
        in_one_process(patch, "one.parquet")
        return read_results(Path("one.parquet"))[1]


def test_each_run_has_scores_of_its_own(rows):
    assert len(rows) == SIDE * SIDE
    assert {row.measured.status for row in rows} == {"measured"}
    scores = [row.measured.scores for row in rows]
    assert len({one.rms_rad for one in scores if one is not None}) == SIDE * SIDE  # each is a run of its own


@pytest.mark.campaign
@pytest.mark.parametrize("kills", [0, 2] if FULL else [1])
def test_the_rows_of_processes_are_those_of_one_also_when_some_are_killed(workers, files, rows, kills):
    killed = []

    def kill(text, share):
        if share > 0.2 * (1 + len(killed)) and len(killed) < kills:
            process = active_children()[0]
            killed.append(process.pid or 0)
            process.kill()

    run_on(workers, prepared(files, "several.parquet"), kill)
    assert len(set(killed)) == kills
    assert read_results(Path("several.parquet"))[1] == rows


@pytest.mark.campaign
def test_a_run_that_fails_is_a_row_with_its_reason(workers, files):
    robot = Path("robot.yaml")
    robot.write_text(robot.read_text() + "  bad: {type: troubled, trouble: none}\n")
    endless = ["slow"] + ["hangs"] * FULL  # one that hangs does so twice, for 4 s
    run_on(workers, prepared(files, "trouble.parquet", [f"trouble={','.join(endless)}"], 2.0))
    over = [f"trouble={','.join(('crashes', 'raises', 'none', *endless))}"]
    sweep = prepared(files, "trouble.parquet", over)

    def but_endless(workers, tasks):
        return measured(workers, itertools.islice(tasks, 3))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_module, "measured", but_endless)
        run_on(workers, sweep)
    found = {row.values[0]: row.measured for row in sweep.rows}
    assert found["none"].status == "measured"
    assert found["raises"].status == "failed"
    assert "out of ideas" in found["raises"].reason
    assert found["slow"] == Measured("too long", "it took longer than 2 s")
    ended = "its process ended 2 times: it crashed, hung, or had too little memory"
    assert found["crashes"] == found.get("hangs", found["crashes"]) == Measured("crashed", ended)
    # what depends on the machine is tried again, what the robot did is not
    again = prepared(files, "trouble.parquet", over)
    tried = []

    def only_slow(_, tasks):
        tried.extend(task.run for task in tasks)
        return iter(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_module, "measured", only_slow)
        run_on(workers, again)
    assert {row.values[0] for row in sweep.rows if row.run in tried} == {"crashes", *endless}


def test_a_combination_that_the_robot_file_forbids_is_a_row(workers, files):
    limits = ["limits.position[0]=-2 rad,0.1 rad", "limits.position[1]=0.05 rad,1 rad"]
    sweep = prepared(files, "limits.parquet", limits)
    run_on(workers, sweep)
    found = {row.values: row.measured for row in sweep.rows}
    assert {values for values, one in found.items() if one.status == "measured"} == {
        (-2.0, 0.05),
        (-2.0, 1.0),
        (0.1, 1.0),
    }
    refused = found[0.1, 0.05]
    assert (refused.status, refused.scores) == ("refused", None)
    assert "joints.elbow.limits.position: the lower limit is not below the upper one" in refused.reason


def test_rows_are_kept_when_it_is_interrupted_and_continued(workers, files, rows):
    def interrupt(text, share):
        if share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on(workers, prepared(files, "kept.parquet"), interrupt)
    kept = read_results(Path("kept.parquet"))[1]
    assert 0 < len(kept) < SIDE * SIDE
    sweep = prepared(files, "kept.parquet")
    run_on(workers, sweep)
    assert (sweep.there, sweep.measured) == (len(kept), SIDE * SIDE - len(kept))
    assert read_results(Path("kept.parquet"))[1] == rows
    # a finer range of the same parameters goes into the same file, and measures only what is new
    finer = prepared(files, "kept.parquet", ["gains.p=2,3", OVER[1]])
    run_on(workers, finer)
    assert (finer.there, finer.measured) == (SIDE, SIDE)
    assert len(read_results(Path("kept.parquet"))[1]) == SIDE * SIDE + SIDE


def test_nothing_is_started_where_all_rows_are_there(files, monkeypatch):
    in_one_process(monkeypatch, "all.parquet", ["gains.p=1,2"])
    sweep = prepared(files, "all.parquet", ["gains.p=1,2"])
    before = Path("all.parquet").stat().st_mtime_ns
    sweep.run(lambda: pytest.fail("workers were started"), lambda *_: None)
    assert sweep.there == 2
    assert Path("all.parquet").stat().st_mtime_ns == before


def test_another_sweep_at_the_same_file_is_refused(files, monkeypatch):
    in_one_process(monkeypatch, "mine.parquet", ["gains.p=1,2"])
    robot, motion = Path("robot.yaml"), Path("motion.yaml")

    def refused(over, arguments=None):
        grid = Grid(robot, arguments or {}, [motion], [over])
        with pytest.raises(InputError) as error:
            Sweep(grid, header_of(grid, arguments or {}, ""), Path("mine.parquet"), 1.0)
        return str(error.value)

    assert refused("gains.i=1,2") == (
        "--output mine.parquet holds a sweep of other parameters (controllers.arm_pid.gains.p); "
        "choose another --output"
    )
    assert "holds a sweep of other arguments" in refused("gains.p=1,2", {"rate": "200"})
    text = motion.read_text()
    motion.write_text(text.replace("0.3 rad", "0.2 rad"))
    assert "holds a sweep of another motion" in refused("gains.p=1,2")
    motion.write_text(text)
    robot.write_text(robot.read_text().replace("i: 8.0", "i: 9.0"))
    assert "holds a sweep of another robot file (arm)" in refused("gains.p=1,2")


def test_another_urdf_or_motor_file_is_another_sweep(files):
    grid = Grid(Path("robot.yaml"), {}, [Path("motion.yaml")], ["gains.p=1,2"])
    first, before = grid.first, header_of(grid, {}, "")
    with_urdf = structs.replace(first.plan.loop, urdf="<robot/>")
    for change in ({"loop": with_urdf}, {"included": {"elbow.motor.yaml": "model: XM430-W350"}}):
        grid.first = structs.replace(first, plan=structs.replace(first.plan, **change))
        assert difference(before, header_of(grid, {}, "")) == "another robot file (arm)"


def test_the_version_of_a_plug_in_has_its_code(tmp_path, monkeypatch):
    package = tmp_path / "worked_on"
    package.mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    seen = set()
    for name, text in (("__init__.py", "1"), ("__init__.py", "2"), ("weights.bin", "1"), ("law.py", "2")):
        (package / name).write_text(text)
        seen.add(code_checksum({"worked_on"}))
    assert len(seen) == 4
    (package / "__pycache__").mkdir()
    for name in ("__pycache__/law.cpython-311.pyc", "kernel.so"):
        (package / name).write_text("of this machine")
        assert code_checksum({"worked_on"}) in seen
    (tmp_path / "alone.py").write_text("1")
    assert code_checksum({"worked_on", "alone"}) not in seen


COMMAND = "import sys; from dxlrun.cli import main; sys.exit(main())"


def started(files: object, output: str) -> subprocess.Popen[str]:
    """Start a long sweep as a command, and return it when its file has some rows."""
    words = [
        "sweep",
        "robot.yaml",
        "--play",
        "motion.yaml",
        "--over",
        "gains.p=2..10x12",
        "--over",
        "gains.d=0..0.2x12",
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *words, "--workers", "1", "--output", output],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < until:
        if Path(output).exists():  # whole, with some rows
            break
        time.sleep(0.05)
    return process


def children(process: subprocess.Popen[str]) -> list[int]:
    """Return process descriptors of the children of a process."""
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    found = [pid for task in tasks for pid in task.read_text().split()]
    return [os.pidfd_open(int(pid)) for pid in found]


def test_a_command_that_is_killed_leaves_rows_and_no_process(files, monkeypatch):
    process = started(files, "killed.parquet")
    workers = children(process)
    assert workers
    process.kill()
    process.communicate(timeout=20)
    for worker in workers:
        assert select.select([worker], [], [], 30.0)[0]
        os.close(worker)
    kept = read_results(Path("killed.parquet"))[1]
    assert kept
    sweep = prepared(files, "killed.parquet", ["gains.p=2..10x12", "gains.d=0..0.2x12"])
    first = next(sweep.missing())
    assert first.run not in {row.run for row in kept}
    assert sweep.there > 0


@pytest.mark.parametrize("number", [signal.SIGTERM, *[signal.SIGINT] * FULL], ids=lambda number: number.name)
def test_a_signal_keeps_the_rows_and_nothing_ever_listened(files, listening, number):
    process = started(files, "interrupted.parquet")
    workers = children(process)
    assert listening(process.pid) == ([], [])
    if number is signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "interrupted\n")
    for worker in workers:
        assert select.select([worker], [], [], 30.0)[0]
        os.close(worker)
    kept = read_results(Path("interrupted.parquet"))[1]
    assert f"{len(kept)} of 144 runs; the same command continues" in out
