"""Goals of played motions on the command line, warnings of goals out of reach, and a shutdown at the goal."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from tests.kit.commands import Dxlrun
from tests.kit.stories import Clients, prepared

from dxlrun.channels.event_records import EventCode
from dxlrun.testing import read_log, simulated_robot

BUSES = """
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}, return_delay_time: 0 us}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
"""
FAR_GOAL = f"""
name: far_goal{BUSES}
loop: {{rate: 50}}
joints:
  reel: {{id: 1, continuous: true, limits: {{velocity: 2 rad/s}}}}
  elbow: {{id: 2, limits: {{position: [-90 deg, 90 deg], velocity: 1 rad/s}}}}
controllers:
  reel: {{type: joint_trajectory_controller, joints: [reel]}}
  elbow: {{type: joint_trajectory_controller, joints: [elbow]}}
"""
FAR = """
name: far
motions:
  - controller: reel
    points:
      - {time: 1 s, joints: {reel: {position: 0 rad}}}
      - {time: 3 s, joints: {reel: {position: 8 rad}}}
"""
PEAK = """
name: peak
motions:
  - controller: elbow
    points:
      - {time: 1 s, joints: {elbow: {position: -80 deg, velocity: 0 deg/s}}}
      - {time: 4 s, joints: {elbow: {position: 80 deg, velocity: 0 deg/s}}}
"""


def written(directory: Path, text: str, name: str = "robot.yaml") -> Path:
    path = directory / name
    path.write_text(text)
    return path


@pytest.fixture
def play(tmp_path: Path, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a robot with a motion from the command line; return what the run and `analyze` printed."""

    def played(robot: str, motion: str) -> tuple[Any, Any]:
        monkeypatch.chdir(tmp_path)
        files = written(tmp_path, robot), written(tmp_path, motion, "motion.yaml")
        ran = dxlrun(files[0], "--virtual", "--play", files[1])
        (log,) = [line.split()[1] for line in ran.out.splitlines() if line.startswith("log: ")]
        return ran, dxlrun("analyze", log)

    return played


def test_a_played_goal_that_the_velocity_limit_holds_back_is_missed(play):
    ran, analyzed = play(FAR_GOAL, FAR)
    assert (ran.code, analyzed.code) == (1, 1)
    assert "failed: " in ran.out
    assert "reel missed the goal of its trajectory: after 4.000 s, joint reel is " in ran.out
    for printed in (ran.out, analyzed.out):
        assert "joint reel is 12" in printed, "it is 4.15 rad off at the end, and has one second more"
    assert analyzed.out.splitlines()[0].startswith("Not good: ")
    assert "(reel 12" in analyzed.out
    assert "0 of 1 goal reached" in analyzed.out


def test_a_played_goal_that_is_aborted_at_once_fails_the_run(play):
    ran, analyzed = play(FAR_GOAL, PEAK)
    assert (ran.code, analyzed.code) == (1, 1)
    assert "failed: " in ran.out
    assert "elbow aborted the goal of its trajectory" in ran.out
    assert analyzed.out.splitlines()[0].startswith("Not good: ")


@pytest.mark.parametrize(("protocol", "model"), [(1.0, "MX-64"), (2.0, "XM430-W350")])
@pytest.mark.parametrize("before_ms", [3, 12])
def test_a_joint_that_shuts_itself_down_before_its_goal_is_judged_has_not_reached_it(
    tmp_path, protocol, model, before_ms
):
    """Its reply reports the error, so its torque is in doubt, although it still stands at the goal."""
    text = BUSES.replace("2.0", str(protocol)).replace("XM430-W350", model).replace("{kind: direct}", "{}")
    file = written(tmp_path, f"name: arm{text}loop: {{rate: 50}}\njoints: {{a: {{id: 1}}}}\ncontrollers:\n"
                   "  arm: {type: joint_trajectory_controller, joints: [a]}\n")  # fmt: skip

    def run(overloads_ms: float | None) -> tuple[str, float]:
        log = tmp_path / "log.mcap"
        log.unlink(missing_ok=True)
        robot = simulated_robot(file, duration_s=2.8, log=log)
        points = [{"positions": [0.5], "time": 1.0}]
        Clients(robot, {50: [prepared(robot, "arm", "trajectory", points=points)]})
        if overloads_ms is not None:
            robot.buses[0].at(round(overloads_ms * 1e6), robot.buses[0].servo(1).trigger_overload)
        robot.run()
        (end,) = [event for event in read_log(log).events if event.code == EventCode.GOAL_ENDED]
        return end.text, end.t_ns / 1e6

    text, ended_ms = run(None)
    assert "reached" in text
    text, _ = run(ended_ms - before_ms)
    assert re.match(r"goal 1 aborted: after .* s, joint a \(ID 1 on bus main\) is limp", text)
