"""`dxlrun stop` and `dxlrun list` on real runs without a gateway, of one name, and at their start and end."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.commands import command_line
from tests.kit.wire import all_writes
from tests.run.conftest import PAIR, ROBOT, Running, Start

from dxlrun.process_table import found_runs
from dxlrun.remote.sockets import sockets
from dxlrun.run.unsteered import unsteered_runs

POSE = """\
poses: {raised: {pan: 40 deg, tilt: 40 deg}}
policies: {on_exit: [{pose: raised, speed: 25 deg/s}, limp], exit_timeout: 12 s}
"""
RAISED = 512 + round(40 * 1023 / 300)
"""Goal Position of the pose for `pan`, ticks."""
GOAL_POSITION = 30


@pytest.fixture
def dxlrun(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Run a command line in this process, in a runtime directory of this test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return command_line(capsys)


def robot_file(folder: Path, name: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(ROBOT.replace("name: pair", f"name: {name}", 1) + POSE)
    return path


def pan_goals(running: Running) -> list[int]:
    """Return the goal positions of `pan` in the order in which they were on the wire."""
    return [
        int.from_bytes(data[GOAL_POSITION - address :][:2], "little")
        for _, servo, address, data in all_writes(running.ledger(), PAIR)
        if servo == 3 and address <= GOAL_POSITION < address + len(data)
    ]


@pytest.mark.parametrize("asked_before", ["by Ctrl-C", "by dxlrun stop"])
def test_stop_leaves_a_run_without_a_gateway_its_pose_at_the_end(  # noqa: PLR0917  fixtures
    dxlrun: Any,
    start: Start,
    tmp_path: Path,
    wait_for: Callable[..., Any],
    asked_before: str,
    all_limp: Callable[[Running], bool],
) -> None:
    running = start(robot=robot_file(tmp_path, "bare_arm"))
    running.wait_until_moving()
    said = dxlrun("list")
    assert said.err == (
        "dxlrun: bare_arm runs but cannot be steered: it has no gateway; "
        "end it by `dxlrun stop --robot bare_arm`\n"
    )
    if asked_before == "by Ctrl-C":
        running.signal(signal.SIGINT)
    else:
        assert dxlrun("stop", "--no-wait").out.startswith("bare_arm is ending")
    wait_for(lambda: max(pan_goals(running)) > 512 + 20, "the way to the pose")
    assert dxlrun("stop").out.startswith("bare_arm has ended")
    _, out, err = running.finish()
    assert "cut" not in out + err
    assert abs(pan_goals(running)[-1] - RAISED) <= 2
    assert all_limp(running)


def test_stop_ends_the_run_that_listens_under_the_name(
    dxlrun: Any, start: Start, tmp_path: Path, wait_for: Callable[..., Any]
) -> None:
    robot = robot_file(tmp_path, "twin_arm")
    steered = start(robot=robot, gateway=True)
    wait_for(lambda: "twin_arm" in sockets(), "the socket")
    bare = start(robot=robot)
    name = f"twin_arm-{bare.process.pid}"
    wait_for(lambda: any(run.name == name and run.problem for run in unsteered_runs()), "the second run")
    listed = dxlrun("list")
    assert listed.out.startswith("twin_arm: 50 Hz")
    assert f"dxlrun: {name} runs but cannot be steered: it has no gateway" in listed.err
    assert "--robot twin_arm, " in dxlrun("stop").err
    assert dxlrun("stop", "--robot", "twin_arm") == (0, "twin_arm has ended\n", "")
    assert steered.finish()[0] == 0
    assert bare.process.poll() is None
    assert dxlrun("stop", "--robot", name).out.startswith("twin_arm has ended")  # the only one of that name
    assert bare.process.wait(DEADLINE_S) == 0


def test_stop_refuses_a_name_of_several_runs_that_cannot_be_steered(
    dxlrun: Any, start: Start, tmp_path: Path, wait_for: Callable[..., Any]
) -> None:
    robot = robot_file(tmp_path, "double_arm")
    runs = [start(robot=robot) for _ in range(2)]
    wait_for(
        lambda: sum(run.run.robot == "double_arm" and bool(run.problem) for run in unsteered_runs()) == 2,
        "both runs",
    )
    said = dxlrun("stop", "--robot", "double_arm")
    assert said.code == 2
    assert all(f"--robot double_arm-{one.process.pid}" in said.err for one in runs)
    assert [one.process.poll() for one in runs] == [None, None]


def test_a_run_that_starts_is_not_called_one_that_cannot_be_steered(
    dxlrun: Any, odd: Callable[..., Running], wait_for: Callable[..., Any], tmp_path: Path
) -> None:
    go = tmp_path / "go"
    running = odd(configure=f"while not os.path.exists({str(go)!r}): time.sleep(0.01)")

    def found() -> bool:
        assert running.process.poll() is None, running.finish()
        pid = running.process.pid
        return any(one.pid == pid for run in found_runs() if run.process("loop") for one in run.processes)

    wait_for(found, "its loop")
    starting = "pair is starting; try again when it runs"
    assert dxlrun("list").err == f"dxlrun: {starting}\n"
    assert dxlrun("halt").err == f"dxlrun: {starting}\n"
    go.touch()
    running.wait_until_moving()
    assert "it has no gateway" in dxlrun("list").err
    assert dxlrun("stop").code == 0
