"""`dxlrun teleop` at a terminal: keys move the base of teleoperation.md; by Ctrl-C and a kill it holds."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from tests.kit.awaited import until
from tests.kit.hands import CODE, Screen, plain
from tests.kit.wire import changes

from dxlrun import RemoteRobot, connect, running
from dxlrun.testing import plan_of
from dxlsim.bus.ledger import read_ledger

pytestmark = pytest.mark.long

ROBOT = Path(__file__).parents[2] / "robots" / "diff_drive.yaml"
GOAL_VELOCITY = 104


@pytest.fixture
def ledger(tmp_path, monkeypatch):
    """The ledger of a base that runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    words = [sys.executable, "-P", "-c", CODE, str(ROBOT), "--no-record", "--ledger", "seen.jsonl"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL) as run:
        until(lambda: run.poll() is not None or bool(running()))
        yield tmp_path / "seen.jsonl"
        run.terminate()


def speeds() -> tuple[float, ...]:
    """Return the goals of the wheels now, rad/s."""
    with connect() as robot:
        return tuple(robot.states().goal_velocity.tolist())


def is_held(robot: RemoteRobot) -> bool:
    """Return whether the stream for the base ran out."""
    (base,) = [one for one in cast("Any", robot.info())["controllers"] if one["name"] == "base"]
    return bool(base["active"] and base["held"])


def drives(screen: Screen, key: str, done: Callable[[], bool]) -> None:
    """Hold a key as a keyboard repeats it."""

    def typed() -> bool:
        screen.types(key)
        return done()

    until(typed)


def test_a_base_is_driven_and_holds_when_the_program_is_interrupted_and_when_it_is_killed(ledger, tmp_path):
    with Screen(tmp_path, "teleop") as screen:
        screen.sees("diff_drive: base holds")
        drives(screen, "q", lambda: min(speeds()) > 0.5)
        screen.sees("base moves")
        screen.types("\x03")
        assert screen.ended() == 0
        assert plain(screen.text).strip().endswith("diff_drive holds")
        assert screen.echoes()
    until(lambda: speeds() == (0.0, 0.0))
    with Screen(tmp_path, "teleop") as screen:
        screen.sees("base holds")
        drives(screen, "\x1b[D", lambda: speeds()[0] < -0.5 and speeds()[1] > 0.5)  # turns left
        screen.kill()
    with connect() as robot:
        until(lambda: is_held(robot) and speeds() == (0.0, 0.0))
        robot.stop()
    goals = [value for _, value in changes(read_ledger(ledger), plan_of(ROBOT), GOAL_VELOCITY)[1]]
    assert max(goals) > 20
    assert min(goals) < -20
    assert goals[-1] == 0
