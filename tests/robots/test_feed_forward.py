"""feed_forward on simulated servos: the thesis' motion with it and without, other motors, limits.

`bench/feed_forward.py` prints the table of the docs; here are its bounds.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.clients import Ask, steered

from bench import feed_forward as bench
from dxlrun.description.joints.motor_file import motor_text
from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.replay import replay_log

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "robots/single_joint_feed_forward.yaml"
SECONDS = 4.0
WITH = bench.POSITIONS.format(scale=1)
WITHOUT_RMS = 0.050
"""rad, of the MX-64 without feed-forward, which the first test finds"""


def example(folder: Path, scale: str) -> tuple[Any, Any]:
    log = folder / f"{scale}.mcap"
    arguments = {"scale": scale}
    robot = simulated_robot(EXAMPLE, arguments=arguments, play=[bench.MOTION], duration_s=SECONDS, log=log)
    result = robot.run()
    assert (result.reason, result.detail, robot.failures) == ("ended", "", ())
    found = read_log(log)
    return bench.tracking(found), found


def test_the_example_follows_the_thesis_motion_ten_times_as_well_as_without(tmp_path):
    without, plain = example(tmp_path, "0")
    assert (plain.cycles["command_position"] == plain.cycles["reference"][:, :1])[1:].all()
    # most of it is that the servo is late: its P control needs an error for each speed
    assert (without.rms, without.lag_s) == (
        pytest.approx(WITHOUT_RMS, rel=0.1),
        pytest.approx(0.031, abs=0.002),
    )
    assert without.rms_after_lag < without.rms / 4
    better, log = example(tmp_path, "1")
    assert better.rms < without.rms / 10
    # beside the lag: what gravity and friction leave
    assert better.rms_after_lag < without.rms_after_lag / 5
    assert abs(better.lag_s) < 0.001
    assert not (log.cycles["clamped"][200:] & 0b11).any()
    # the duty that it works out is the one that the servo shows as its load
    duty = log.topics["/feed_forward/state"].column("duty")[:, 0]
    assert np.corrcoef(duty, log.cycles["effort"][::7, 0][: len(duty)])[0, 1] > 0.95
    report = replay_log(log.path)
    assert (report.different, report.compared) == (0, report.cycles)
    # robot file and motor file are in the log: with another argument the same inputs give other commands
    less = replay_log(log.path, (), {"scale": "0.5"})
    assert (less.compared, less.different > less.compared / 2) == (less.cycles, True)


def test_a_motor_file_that_is_a_fifth_wrong_is_still_better_than_none(tmp_path):
    for by in (0.8, 1.2):
        found, _ = bench.tracked(tmp_path, WITH, bench.wrong(bench.MX64, by), bench.MX64, seconds=SECONDS)
        # and it matters: right it is below a tenth
        assert WITHOUT_RMS / 10 < found.rms < WITHOUT_RMS / 2


def test_what_a_goal_takes_to_act_is_looked_ahead(tmp_path):
    slow = replace(bench.MX64, delay_ns=10_000_000)
    found, _ = bench.tracked(tmp_path, WITH, slow, seconds=SECONDS)
    unknown, _ = bench.tracked(tmp_path, WITH, bench.MX64, slow, seconds=SECONDS)
    assert found.rms < unknown.rms / 5
    assert unknown.lag_s - found.lag_s == pytest.approx(0.010, abs=0.001)


@pytest.mark.parametrize("interface", ["effort", "pwm"])
def test_a_pid_controller_below_has_ten_times_less_to_do(tmp_path, interface):
    text = [
        bench.EFFORTS.format(interface=interface, gains=bench.GAINS[interface], scale=scale)
        for scale in (0, 1)
    ]
    without, _ = bench.tracked(tmp_path, text[0], bench.XM430, seconds=SECONDS)
    found, log = bench.tracked(tmp_path, text[1], bench.XM430, seconds=SECONDS)
    assert found.rms < without.rms / 10
    assert np.isfinite(log.cycles[f"goal_{interface}"][100:]).all()


STORM = """\
name: storm
buses: {main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us}}
loop: {rate: 200}
joints:
  joint: {bus: main, id: 1, model: MX-64, reference: 180 deg, direction: 1, motor: known.yaml,
          limits: {position: [-60 deg, 60 deg], velocity: 3 rad/s, acceleration: 40 rad/s^2}}
controllers:
  ff: {type: feed_forward, joints: [joint]}
  group: {type: joint_group_posvel_controller, joints: [joint], into: ff}
"""


@campaign(ci=1, night=8, release=80)
def test_the_gate_keeps_the_limits_whatever_is_added(tmp_path, number, chance):
    (tmp_path / "known.yaml").write_text(motor_text(bench.MX64, {}))
    (tmp_path / "storm.yaml").write_text(STORM)
    limit = math.radians(60)
    asks = [
        Ask(
            0.5 + 0.03 * k,
            "group",
            "posvel",
            {"positions": [chance.uniform(-limit, limit)], "velocities": [chance.uniform(0.0, 3.0)]},
        )
        for k in range(100)
    ]
    cycles = steered(tmp_path, tmp_path / "storm.yaml", 4.0, asks).log.cycles
    goals, commands = cycles["goal_position"][:, 0], cycles["command_position"][:, 0]
    speeds = np.diff(goals) * 200
    assert np.abs(goals).max() <= limit + 1e-9
    assert np.abs(speeds).max() <= 3.0 + 1e-6
    assert np.abs(np.diff(speeds)).max() * 200 <= 40.0 + 1e-3
    # the gate had something to do: the commands alone are far faster
    assert np.abs(np.diff(commands[100:])).max() * 200 > 30.0
    assert np.ptp(cycles["position"]) > 0.5
