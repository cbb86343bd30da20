"""Joints that are moved by hand in a pause begin again where they are; those that were not moved continue.

Judged by the simulated shafts.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.line_faults import turn_by_hand
from tests.kit.sampled_run import SampledRun, texts
from tests.kit.stories import ask, prepared, torque

from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log
from dxlrun.plan.policy_plan import SLOW_SPEED

TICK = math.tau / 4096
PERIOD_MS = 20
COMMANDED_MS, PAUSED_MS, OFF_MS, TURNED_MS, ON_MS, RESUMED_MS, AGAIN_MS = (
    300, 1000, 1100, 1300, 1500, 2000, 3500,
)  # fmt: skip
REACH, SPEED = 1.2, 0.8  # rad, and rad/s of the wheel
BEGUN = "restarted at the measured positions: "
SHAPE = """\
name: pauses
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 4_000_000, return_delay_time: 0 us, adapter: {kind: direct}}
loop: {rate: 50}
joint_defaults:
  bus: main
  model: XM430-W350
  reference: 180 deg
  direction: 1
  limits: {velocity: 3 rad/s}
  simulation: {inertia: 0.005 kg m^2, gravity: 0 Nm}
joints:
  arm: {id: 1}
  other: {id: 2}
  wheel: {id: 3, continuous: true}
  led: {id: 4}
controllers:
  arm:
    type: keyframe_player
    joints: [arm, other]
    partial: true
    motions: {reach: {steps: [{time: 2 s, pose: {arm: 1.2 rad, other: 1.2 rad}}]}}
  wheel: {type: joint_group_velocity_controller, joints: [wheel]}
  led:
    type: joint_trajectory_controller
    joints: [led]
    command_interface: effort
    gains: {p: 3.0, d: 0.1}
    derivative_filter: 5 ms
"""


@pytest.fixture
def run(tmp_path: Path) -> SampledRun:
    """A robot that is paused while its joints move."""
    run = SampledRun(tmp_path, SHAPE, 5.0)
    run.ask(COMMANDED_MS, *commands(run))
    run.ask(PAUSED_MS, ask("pause"))
    run.ask(RESUMED_MS, ask("resume"))
    return run


def commands(run: SampledRun) -> list[CommandMessage]:
    return [
        prepared(run.robot, "arm", "play", motion="reach"),
        prepared(run.robot, "wheel", "velocities", velocities=[SPEED]),
        prepared(run.robot, "led", "trajectory", points=[{"positions": [REACH], "time": 2.0}]),
    ]


def turn(run: SampledRun, joint: str, by_deg: float, at_ms: int = TURNED_MS) -> None:
    servo = run.servos[joint]
    run.at(at_ms, lambda: turn_by_hand(servo, servo.shaft.angle + math.radians(by_deg)))


def restarts(log: Log) -> dict[str, str]:
    found = [one for one in log.events if one.code == EventCode.POLICY and one.text.startswith(BEGUN)]
    return {event.source: event.text.removeprefix(BEGUN) for event in found}


def goes_on(run: SampledRun, *joints: str) -> None:
    """Check that joints reach what was commanded before the pause."""
    for joint in joints:
        if joint == "wheel":
            assert np.ptp(run.shaft(joint, RESUMED_MS + 1000, RESUMED_MS + 2000)) > 0.9 * SPEED
        else:
            assert run.shaft(joint)[-1] == pytest.approx(REACH, abs=math.radians(3))


def test_motions_continue_after_a_pause_in_which_no_joint_was_moved(run):
    log = run.run()
    assert restarts(log) == {}
    goes_on(run, "arm", "other", "led", "wheel")
    ends = [texts(log, EventCode.GOAL_ENDED, source=name) for name in ("arm", "led")]
    assert [end.split()[2] for (end,) in ends] == ["reached:"] * 2


def test_joint_that_was_limp_in_a_pause_waits_there_for_a_command(run):
    run.ask(OFF_MS, torque(["arm"], on=False))
    turn(run, "arm", -60.0)
    run.ask(ON_MS, torque(["arm"], on=True))
    run.ask(AGAIN_MS, commands(run)[0])
    log = run.run()
    assert restarts(log) == {"arm": "arm regained torque"}
    assert texts(log, EventCode.GOAL_ENDED, source="arm")[0] == "goal 1 aborted: arm regained torque"
    assert np.ptp(run.shaft("arm", TURNED_MS + PERIOD_MS, AGAIN_MS)) <= 2 * TICK
    again = run.shaft("arm", AGAIN_MS)
    assert np.ptp(again) > 10 * TICK
    assert np.abs(np.diff(again))[:40].max() < 1.2 * SLOW_SPEED * PERIOD_MS * 1e-3
    goes_on(run, "wheel")


@pytest.mark.parametrize("joint", ["wheel", "led"])
@pytest.mark.parametrize("by_deg", [-30.0, 30.0])
def test_joint_without_a_position_goal_that_was_turned_in_a_pause_waits_there(run, joint, by_deg):
    turn(run, joint, by_deg)
    run.ask(AGAIN_MS, *commands(run)[1:])
    log = run.run()
    assert restarts(log) == {joint: f"{joint} moved in the pause"}
    assert np.ptp(run.shaft(joint, TURNED_MS + PERIOD_MS, AGAIN_MS)) <= 2 * TICK
    assert np.ptp(run.shaft(joint, AGAIN_MS)) > 10 * TICK
    if joint == "led":
        assert texts(log, EventCode.GOAL_ENDED, source="led")[0] == "goal 2 aborted: led moved in the pause"


@pytest.mark.parametrize("joint", ["wheel", "led"])
def test_joint_that_was_hardly_turned_in_a_pause_continues(run, joint):
    turn(run, joint, 2.0)
    assert restarts(run.run()) == {}
    goes_on(run, joint)


def test_joint_that_follows_a_position_continues_though_it_was_turned_away(run):
    """Its servo has kept its goal, and brings it back."""
    turn(run, "arm", -30.0, at_ms=RESUMED_MS - PERIOD_MS)
    assert restarts(run.run()) == {}
    assert run.shaft("arm", RESUMED_MS)[0] < run.shaft("arm", TURNED_MS)[0] - math.radians(10)
    goes_on(run, "arm")
