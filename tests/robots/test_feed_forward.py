"""feed_forward on simulated servos: the thesis' motion with it and without, other motors, limits.

`bench/feed_forward.py` prints the table of the docs; here are its bounds.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.virtual_run import VirtualRun

from bench import feed_forward as bench
from dxlrun_analysis.replay import replay_log

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "robots/single_joint_feed_forward.yaml"
SECONDS = 4.0
WITH = bench.POSITIONS.format(scale=1)
WITHOUT_RMS = 0.050
"""rad, of the MX-64 without feed-forward, which the first test finds"""


def example(folder: Path, scale: str) -> tuple[Any, Any]:
    options: dict[str, Any] = {"arguments": {"scale": scale}, "play": [bench.MOTION]}
    found = VirtualRun(EXAMPLE, folder / f"{scale}.mcap", duration_s=SECONDS, **options).finish()
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
