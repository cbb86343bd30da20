"""robots/single_joint_learning.yaml on simulated servos: the error falls from run to run, replays are equal.

CI has a slow loop and few runs. The full one, ten repetitions of the thesis' whole motion at 320 Hz:

    pytest --campaign=release tests/robots/test_learning.py -rA
"""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.campaigns import campaign

from dxlrun.channels.event_records import EventCode
from dxlrun.compile.motions import LEAD_NS
from dxlrun.testing import Log, read_log, simulated_robot
from dxlrun_analysis.replay import replay_log

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
ROBOT = ROBOTS / "single_joint_learning.yaml"
MOTION = ROBOTS / "motions/single_joint_learning.yaml"
HALF_S = 3.0
QUICK = {"rate": "32"}
"""Hz; 320 takes ten times as long."""


def learned(kept: Path, log: Path, motion: Path | None = None, robot: Path = ROBOT, **arguments: str) -> Log:
    """Play the motion once, of the example's half unless another is given; what it learns is in `kept`."""
    log.unlink(missing_ok=True)
    if motion is None:
        motion = log.with_name("half.yaml")
        motion.write_text(MOTION.read_text().replace("duration: 6 s", f"duration: {HALF_S:g} s"))
    made = simulated_robot(robot, arguments=arguments, play=[motion], log=log, kept=kept)
    assert made.run().detail == ""
    assert made.unkept == ()
    return read_log(log)


def error_of(log: Log, start_s: float = 1.0, length_s: float = HALF_S) -> float:
    """Return the error, deg, by what the log's cycles have read; the controller must report the same."""
    (message,) = log.messages("/arm/repetition")
    start_ns = int(log.cycles["scheduled_ns"][0]) + round(start_s * 1e9) + LEAD_NS
    t = (log.cycles["woken_ns"] - start_ns) * 1e-9
    rows = (t > -1e-3) & (t < length_s + 1e-3)
    desired = 0.5 * (np.sin(2 * t) - np.sin(4 * t))
    error = float(np.sqrt(np.mean((desired - log.cycles["position"][:, 0])[rows] ** 2)))
    assert float(str(message["error"])) == pytest.approx(error, rel=0.02, abs=math.radians(0.02))
    return math.degrees(error)


def said(log: Log) -> list[str]:
    codes = (EventCode.KEPT, EventCode.CONTROLLER_SAYS)
    return [event.text for event in log.events if event.code in codes and event.source == "arm"]


def test_each_run_follows_better_and_a_replay_is_equal(tmp_path):
    kept, path = tmp_path / "kept", tmp_path / "run.mcap"
    errors = []
    for _ in range(4):
        log = learned(kept, path, gain="0.7", **QUICK)
        errors.append(error_of(log))
    assert errors[3] < errors[0] / 10, errors
    assert all(after < before for before, after in itertools.pairwise(errors))
    (text,) = said(log)
    assert text.startswith("starts with its kept state of ")
    report = replay_log(path)
    assert report.same, report
    assert report.messages > 5
    (kept / "arm.kept").unlink()
    assert error_of(learned(kept, path, **QUICK)) == pytest.approx(errors[0]), "it has forgotten"


def test_another_servo_begins_anew_and_is_learned(tmp_path):
    kept, path = tmp_path / "kept", tmp_path / "run.mcap"
    for _ in range(2):
        learned(kept, path, **QUICK)
    swapped = learned(kept, path, p_gain="16", **QUICK)
    first, second = said(swapped)
    assert first == f"starts without its kept state: joint p_gain was 32, now 16 ({kept}/arm.kept)"
    assert "is not learned yet: no correction" in second
    errors = [error_of(swapped), error_of(learned(kept, path, p_gain="16", **QUICK))]
    assert errors[1] < 0.7 * errors[0]


def test_it_learns_what_a_feed_forward_leaves(tmp_path):
    robot, path = tmp_path / "both.yaml", tmp_path / "run.mcap"
    robot.write_text(
        f"include: [{ROBOTS}/single_joint_feed_forward.yaml]\nname: both\nloop: {{rate: 64}}\ncontrollers:\n"
        "  arm: {type: ilc_controller, joints: [joint], command_interface: posvel, into: feed_forward}\n"
        "  posvel_trajectory: {active: false}\n"
    )
    # nine tenths of it: all of it leaves less than a tick
    errors = [error_of(learned(tmp_path, path, robot=robot, scale="0.9")) for _ in range(3)]
    assert errors[0] < 0.5, "without it they are 2.8"
    assert errors[2] < 0.5 * errors[0]
    log = learned(tmp_path, path, robot=robot, scale="0.5")
    assert said(log)[0].startswith("starts without its kept state: below: feed_forward was feed_forward ")
    assert replay_log(path).same


@campaign(ci=0, night=10, release=10)
@pytest.mark.parametrize("interface", ["position", "posvel"])
def test_the_error_of_the_thesis_motion_falls_tenfold(tmp_path, interface, amount):
    motion = tmp_path / "tracking.yaml"
    text = (ROBOTS / "motions/single_joint_tracking.yaml").read_text()
    motion.write_text(text.replace("controller: posvel_trajectory", "controller: arm"))
    errors = [
        error_of(learned(tmp_path / "kept", tmp_path / "run.mcap", motion, interface=interface), 0.0, 30.0)
        for _ in range(int(amount) + 1)
    ]
    print(f"{interface}: " + ", ".join(f"{error:.3f}" for error in errors) + " deg")
    assert errors[-1] < errors[0] / 10
