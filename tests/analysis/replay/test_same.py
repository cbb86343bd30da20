"""A replay of what was not changed has no difference, whatever happened in the run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.changed_logs import command, edited
from tests.kit.examples import as_parameters
from tests.kit.stories import differing, replayed, silence

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import InputError
from dxlrun.log.log_reader import read_log
from dxlrun.testing import plan_of, simulated_robot
from dxlrun_analysis.replay import replay_log
from dxlrun_analysis.replay.recorded_inputs import recorded

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[3] / "robots"
DXLRUN = Path(sys.executable).with_name("dxlrun")


def motions_for(robot: Path) -> list[Path]:
    """Return the motion that fits a robot, if there is one; the robot file names its controllers."""
    text = robot.read_text()
    for motion in sorted((ROBOTS / "motions").glob("*.yaml")):
        names = re.findall(r"controller: (\w+)", motion.read_text())
        if "include:" not in text and not all(f"{name}:" in text for name in names):
            continue
        with suppress(InputError):
            compile_files(robot, {}, [motion])
            return [motion]
    return []


@campaign(ci=4, night=15, release=60)
@pytest.mark.parametrize("robot", as_parameters(sorted(ROBOTS.glob("*.yaml"))))
def test_replay_of_each_robot_has_no_difference(robot: Path, tmp_path: Path, amount: float) -> None:
    """`amount` is the length in seconds, or as many cycles as a robot of 100 Hz has in them."""
    log = tmp_path / "run.mcap"
    seconds = min(amount, 100 * amount * plan_of(robot).loop.period_ns * 1e-9)
    simulated_robot(robot, play=motions_for(robot), duration_s=seconds, log=log).run()
    read = replayed(log)
    periods = len(read.cycles) + read.cycles["skipped"].sum()
    assert periods == round(seconds * 1e9 / read.period_ns)


def test_small_robot_shows_every_kind_of_value(pair_log: Path) -> None:
    cycles = read_log(pair_log).cycles
    assert np.isnan(cycles["command_velocity"]).any()
    assert np.isfinite(cycles["command_velocity"][:, 2]).all()
    assert len(np.unique(cycles["command_position"][:, 2])) == len(cycles) == 50


def test_silent_servo_and_periods_that_were_skipped(
    run: Callable[..., Path], changed: Callable[..., Path], robot_file: Path, tmp_path: Path
) -> None:
    robot = tmp_path / "fast.yaml"
    robot.write_text(robot_file.read_text().replace("default: 50,", "default: 200,").replace("25}", "50}"))
    log = run(lambda one: silence(one, (3, 7, 8), 300, 600), robot, 4.0)  # a lost one is asked once a second
    cycles = read_log(log).cycles
    assert cycles["skipped"].sum() > 0
    assert not cycles["valid"].all()
    assert cycles["valid"][-1].all()
    assert replay_log(log).same
    late_after_the_read = edited(lambda cycles: cycles["read_ns"].__setitem__(..., cycles["woken_ns"]))
    assert replay_log(changed(log, late_after_the_read)).same


def test_commands_from_outside_come_from_the_log(pair_log: Path, changed: Callable[..., Path]) -> None:
    (planned,) = recorded(read_log(pair_log)).plan.loop.commands
    by_value = command("trajectory", planned=-1, data=planned.data)
    assert replay_log(changed(pair_log, by_value)).same
    other_data = command("trajectory", data=(np.frombuffer(planned.data) * 1.01).tobytes())
    _, first = differing(changed(pair_log, by_value, other_data))
    assert first.joint == "pan"


def test_run_in_real_time(tmp_path: Path, robot_file: Path, plugin: Path) -> None:
    environment = os.environ | {"PYTHONPATH": f"{plugin}:{os.environ.get('PYTHONPATH', '')}"}

    def dxlrun(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [DXLRUN, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    motion = robot_file.with_name("look.yaml")
    ran = dxlrun(str(robot_file), "--play", str(motion), "--duration", "1.5", "--no-gateway")
    logs = list((tmp_path / "logs").glob("*.mcap"))  # how the run went is not judged: machines are busy
    assert len(logs) == 1, ran.stdout + ran.stderr
    cycles = read_log(logs[0]).cycles
    assert len(cycles) > 0, ran.stderr
    told = dxlrun("replay", str(logs[0]))
    assert told.returncode == 0, told.stdout + told.stderr
    assert told.stdout == f"pair: {len(cycles)} cycles replayed, 0 differences\n"
