"""`dxlrun stop` and `dxlrun list` on real runs without a gateway, of one name, and at their start and end."""

from pathlib import Path

import pytest
from tests.kit.awaited import until
from tests.kit.commands import Dxlrun, command_line
from tests.kit.live_run import GOAL_POSITION, PAIR, ROBOT, Running, Start
from tests.kit.wire import all_writes

POSE = """\
poses: {raised: {pan: 40 deg, tilt: 40 deg}}
policies: {on_exit: [{pose: raised, speed: 25 deg/s}, limp], exit_timeout: 12 s}
"""
RAISED = 512 + round(40 * 1023 / 300)
"""Goal Position of the pose for `pan`, ticks."""
NO_GATEWAY = "runs but cannot be steered: it has no gateway"


@pytest.fixture
def dxlrun(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Dxlrun:
    """Run a command line in this process, in a runtime directory of this test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return command_line(capsys)


def robot_file(folder: Path, name: str, more: str = "") -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(ROBOT.replace("name: pair", f"name: {name}", 1) + more)
    return path


def pan_goals(running: Running) -> list[int]:
    """Return the goal positions of `pan` in the order in which they were on the wire."""
    return [
        int.from_bytes(data[GOAL_POSITION - address :][:2], "little")
        for _, servo, address, data in all_writes(running.ledger(), PAIR)
        if servo == 3 and address <= GOAL_POSITION < address + len(data)
    ]


def test_stop_leaves_a_run_that_is_already_ending_its_pose(
    dxlrun: Dxlrun, start: Start, tmp_path: Path
) -> None:
    running = start(robot=robot_file(tmp_path, "bare_arm", POSE))
    running.wait_until_moving()
    assert dxlrun("list").err == f"dxlrun: bare_arm {NO_GATEWAY}; end it by `dxlrun stop --robot bare_arm`\n"
    assert dxlrun("stop", "--no-wait").out.startswith("bare_arm is ending")
    until(lambda: max(pan_goals(running)) > 512 + 20, "the way to the pose")
    assert dxlrun("stop").out.startswith("bare_arm has ended")
    _, out, err = running.finish()
    assert "cut" not in out + err
    assert abs(pan_goals(running)[-1] - RAISED) <= 2
    assert running.is_limp()
