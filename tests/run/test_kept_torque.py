"""Servos that kept torque: a trajectory continues after lost replies, and is aborted after a lost line.

Judged by the simulated shafts. A trajectory of 3 s to `REACH` runs when the fault happens.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.line_faults import lose_replies
from tests.kit.sampled_run import MS, SampledRun, texts
from tests.kit.stories import prepared

from dxlrun.channels.event_records import EventCode
from dxlrun.plan.policy_plan import SLOW_SPEED

pytestmark = pytest.mark.long

TICK = math.tau / 4096
PERIOD_MS = 20
COMMANDED_MS, FAULT_MS = 300, 1000
REACH, SECONDS = 1.2, 3.0  # rad and s of the trajectory
SPEED = 0.8  # rad/s of the wheel
GOALS = (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED)
SHAPE = """\
name: kept
buses:
  main: {port: sim, PROTOCOL, return_delay_time: 0 us, adapter: {kind: direct}}
loop: {rate: 50}
joint_defaults: {bus: main, model: MODEL, reference: 180 deg, direction: 1, limits: {velocity: 3 rad/s}}
joints:
  arm: {id: 1}
  other: {id: 2}
  wheel: {id: 3, continuous: true}
controllers:
  arm: {type: joint_trajectory_controller, joints: [arm]}
  other: {type: joint_trajectory_controller, joints: [other]}
  wheel: {type: joint_group_velocity_controller, joints: [wheel]}
"""
LINES = {
    1: ("protocol: 1.0, baud_rate: 1_000_000", "MX-64"),
    2: ("protocol: 2.0, baud_rate: 4_000_000", "XM430-W350"),
}


def commanded(folder: Path, protocol: int) -> SampledRun:
    """Return a run whose arm follows a trajectory, and whose wheel turns."""
    line, model = LINES[protocol]
    run = SampledRun(folder, SHAPE.replace("PROTOCOL", line).replace("MODEL", model), 6.0)
    run.ask(
        COMMANDED_MS,
        prepared(run.robot, "arm", "trajectory", points=[{"positions": [REACH], "time": SECONDS}]),
        prepared(run.robot, "wheel", "velocities", velocities=[SPEED]),
    )
    return run


@pytest.mark.parametrize("protocol", [1, 2])
@pytest.mark.parametrize(
    ("until_ms", "executes", "lost"),
    [
        (FAULT_MS + 15, True, False),
        (FAULT_MS + 60, True, True),
        (FAULT_MS + 1500, True, True),
        (COMMANDED_MS + 1000 * SECONDS + 700, True, True),
        (FAULT_MS + 600, False, True),
    ],
    ids=["one reply", "until lost", "while its controller waits", "beyond its end", "deaf"],
)
def test_servo_that_kept_torque_and_goal_continues_its_trajectory(
    tmp_path, protocol, until_ms, executes, lost
):
    run = commanded(tmp_path, protocol)
    if executes:
        lose_replies(run.bus, 1, FAULT_MS * MS, round(until_ms * MS))
    else:  # the Bus Watchdog of Protocol 2.0 stops it
        run.fault(f"silence servo=1 at={FAULT_MS}ms for={until_ms - FAULT_MS:g}ms")
    log = run.run()
    arm = run.shaft("arm")
    assert arm[-1] == pytest.approx(REACH, abs=math.radians(1))
    assert np.diff(arm).min() > -2 * TICK
    assert np.abs(np.diff(arm)).max() < 1.2 * SLOW_SPEED * PERIOD_MS * 1e-3
    (accepted, ended) = texts(log, *GOALS, source="arm")
    assert accepted.startswith("goal 1: trajectory")
    assert ended.startswith("goal 1 reached")
    held = ["is held until all its joints answer again", "resumes: all its joints answer again"]
    assert texts(log, EventCode.POLICY, source="arm") == (held if lost else [])
    assert len(texts(log, EventCode.SERVO_BACK, source="arm")) == lost


@pytest.mark.parametrize("protocol", [1, 2])
def test_joints_wait_for_a_command_after_their_line_came_back(tmp_path, protocol):
    """Their servos kept torque, but the goals that they have are not known to be those of this run."""
    run, again_ms = commanded(tmp_path, protocol), 4000
    run.fault(f"unplug at={FAULT_MS}ms for=600ms")
    point = {"positions": [0.0], "time": 1.0}
    run.ask(again_ms, prepared(run.robot, "arm", "trajectory", points=[point]))
    log = run.run()
    back = [event for event in log.events if event.code == EventCode.SERVO_BACK]
    assert {event.source for event in back} == {"arm", "other", "wheel"}
    ready_ms = max(event.t_ns for event in back) / MS + 2 * PERIOD_MS
    assert ready_ms < 2500
    # on Protocol 1.0 nothing has stopped the wheel until now, and it takes a while to stand
    for joint, from_ms in (("arm", ready_ms), ("wheel", ready_ms + 800)):
        assert np.ptp(run.shaft(joint, from_ms, again_ms)) <= 2 * TICK
    assert run.shaft("arm", again_ms)[0] < REACH / 2
    assert run.shaft("arm")[-1] == pytest.approx(0.0, abs=math.radians(1))
    ends = texts(log, *GOALS, source="arm")
    assert ends[1].startswith("goal 1 aborted")
    assert "regained torque" in ends[1]
    assert ends[3].startswith("goal 2 reached")
