"""Servos that kept torque: a trajectory continues after lost replies, and is aborted after a lost line.

Judged by the simulated shafts. A trajectory of 3 s to `REACH` runs when the fault happens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.kit.line_faults import lose_replies
from tests.kit.stories import Clients, prepared, replayed

from dxlrun.channels.cycle import Floats
from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

MS = 1_000_000
TICK = math.tau / 4096
PERIOD_MS = 20
COMMANDED_MS, FAULT_MS = 300, 1000
REACH, SECONDS = 1.2, 3.0  # rad and s of the trajectory
SPEED = 0.8  # rad/s of the wheel
GOALS = (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED)
SHAPE = """\
name: kept
buses:
  main: {port: sim, PROTOCOL, return_delay_time: 0 us}
loop: {rate: 50}
joints:
  arm: {bus: main, id: 1, PLACE}
  other: {bus: main, id: 2, PLACE}
  wheel: {bus: main, id: 3, PLACE, continuous: true}
controllers:
  arm: {type: joint_trajectory_controller, joints: [arm]}
  other: {type: joint_trajectory_controller, joints: [other]}
  wheel: {type: joint_group_velocity_controller, joints: [wheel]}
"""
LINES = {
    1: "protocol: 1.0, baud_rate: 1_000_000, adapter: {kind: direct}",
    2: "protocol: 2.0, baud_rate: 4_000_000, adapter: {kind: direct}",
}


class Run:
    """A robot on virtual time whose arm follows a trajectory; all shafts are sampled."""

    def __init__(self, folder: Path, protocol: int, seconds: float = 6.0) -> None:
        model = {1: "MX-64", 2: "XM430-W350"}[protocol]
        place = f"model: {model}, reference: 180 deg, direction: 1, limits: {{velocity: 3 rad/s}}"
        text = SHAPE.replace("PROTOCOL", LINES[protocol]).replace("PLACE", place)
        (folder / "robot.yaml").write_text(text)
        self.path = folder / "run.mcap"
        self.robot: VirtualRobot = simulated_robot(folder / "robot.yaml", duration_s=seconds, log=self.path)
        self.bus = self.robot.buses[0]
        self.samples: list[tuple[float, float, float, float]] = []
        point = {"positions": [REACH], "time": SECONDS}
        asked = {
            COMMANDED_MS // PERIOD_MS: [
                prepared(self.robot, "arm", "trajectory", points=[point]),
                prepared(self.robot, "wheel", "velocities", velocities=[SPEED]),
            ]
        }
        self.clients = Clients(self.robot, asked)
        self._sample()

    def fault(self, text: str) -> None:
        FaultScript([parse_fault(text)]).attach(self.robot.buses)

    def _sample(self) -> None:
        angles = [self.bus.servo(number).shaft.angle - math.pi for number in (1, 2, 3)]
        self.samples.append((self.bus.now_ns / MS, *angles))
        self.bus.at(self.bus.now_ns + PERIOD_MS * MS, self._sample)

    def log(self) -> Log:
        assert self.robot.run().reason == "ended"
        return read_log(self.path)

    def shaft(self, number: int, from_ms: float = 0.0) -> Floats:
        """Return the angles of one shaft from a time on, rad."""
        return np.array([sample[number] for sample in self.samples if sample[0] >= from_ms])


def texts(log: Log, codes: Sequence[EventCode], source: str) -> list[str]:
    return [event.text for event in log.events if event.code in codes and event.source == source]


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
    run = Run(tmp_path, protocol)
    if executes:
        lose_replies(run.bus, 1, FAULT_MS * MS, round(until_ms * MS))
    else:  # the Bus Watchdog of Protocol 2.0 stops it
        run.fault(f"silence servo=1 at={FAULT_MS}ms for={until_ms - FAULT_MS:g}ms")
    log = run.log()
    arm = run.shaft(1)
    assert arm[-1] == pytest.approx(REACH, abs=math.radians(1))
    assert np.diff(arm).min() > -2 * TICK
    assert np.abs(np.diff(arm)).max() < 1.2 * SLOW_SPEED * PERIOD_MS * 1e-3
    (accepted, ended) = texts(log, GOALS, "arm")
    assert accepted.startswith("goal 1: trajectory")
    assert ended.startswith("goal 1 reached")
    held = ["is held until all its joints answer again", "resumes: all its joints answer again"]
    assert texts(log, [EventCode.POLICY], "arm") == (held if lost else [])
    assert len(texts(log, [EventCode.SERVO_BACK], "arm")) == lost


@pytest.mark.parametrize("protocol", [1, 2])
def test_joints_wait_for_a_command_after_their_line_came_back(tmp_path, protocol):
    """Their servos kept torque, but the goals that they have are not known to be those of this run."""
    run, again_ms = Run(tmp_path, protocol), 4000
    run.fault(f"unplug at={FAULT_MS}ms for=600ms")
    point = {"positions": [0.0], "time": 1.0}
    run.clients.asked[again_ms // PERIOD_MS] = [prepared(run.robot, "arm", "trajectory", points=[point])]
    log = run.log()
    back = [event for event in log.events if event.code == EventCode.SERVO_BACK]
    assert {event.source for event in back} == {"arm", "other", "wheel"}
    ready_ms = max(event.t_ns for event in back) / MS + 2 * PERIOD_MS
    assert ready_ms < 2500
    # on Protocol 1.0 nothing has stopped the wheel until now, and it takes a while to stand
    for number, from_ms in ((1, ready_ms), (3, ready_ms + 800)):
        still = run.shaft(number, from_ms)[: int((again_ms - from_ms) / PERIOD_MS)]
        assert np.ptp(still) <= 2 * TICK
    assert run.shaft(1, again_ms)[0] < REACH / 2
    assert run.shaft(1)[-1] == pytest.approx(0.0, abs=math.radians(1))
    ends = texts(log, GOALS, "arm")
    assert ends[1].startswith("goal 1 aborted")
    assert "regained torque" in ends[1]
    assert ends[3].startswith("goal 2 reached")
    replayed(run.path)
