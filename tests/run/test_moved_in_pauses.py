"""Joints that are moved by hand in a pause begin again where they are; those that were not moved continue.

Judged by the simulated shafts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.kit.line_faults import turn_by_hand
from tests.kit.stories import Clients, ask, prepared, replayed, torque

from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.cycle import Floats
from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlrun.testing import VirtualRobot, simulated_robot

MS = 1_000_000
TICK = math.tau / 4096
PERIOD_MS = 20
COMMANDED_MS, PAUSED_MS, OFF_MS, TURNED_MS, ON_MS, RESUMED_MS = 300, 1000, 1100, 1300, 1500, 2000
AGAIN_MS, SECONDS = 3500, 5.0
REACH, SPEED = 1.2, 0.8  # rad, and rad/s of the wheel
SHAPE = """\
name: pauses
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 4_000_000, return_delay_time: 0 us, adapter: {kind: direct}}
loop: {rate: 50}
joints:
  arm: {bus: main, id: 1, PLACE}
  other: {bus: main, id: 2, PLACE}
  wheel: {bus: main, id: 3, PLACE, continuous: true}
  led: {bus: main, id: 4, PLACE}
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
PLACE = """\
model: XM430-W350, reference: 180 deg, direction: 1, limits: {velocity: 3 rad/s},
simulation: {inertia: 0.005 kg m^2, gravity: 0 Nm}"""
ARM, OTHER, WHEEL, LED = 1, 2, 3, 4


class Run:
    """A robot on virtual time that is paused while its joints move; all shafts are sampled."""

    def __init__(self, folder: Path) -> None:
        (folder / "robot.yaml").write_text(SHAPE.replace("PLACE", PLACE.replace("\n", " ")))
        self.path = folder / "run.mcap"
        self.robot: VirtualRobot = simulated_robot(folder / "robot.yaml", duration_s=SECONDS, log=self.path)
        self.bus = self.robot.buses[0]
        self.samples: list[list[float]] = []
        self.clients = Clients(self.robot, {})
        self.at(COMMANDED_MS, *self.commands())
        self.at(PAUSED_MS, ask("pause"))
        self.at(RESUMED_MS, ask("resume"))
        self._sample()

    def at(self, ms: int, *commands: CommandMessage) -> None:
        self.clients.asked = {**self.clients.asked, ms // PERIOD_MS: commands}

    def commands(self) -> list[CommandMessage]:
        point = {"positions": [REACH], "time": 2.0}
        return [
            prepared(self.robot, "arm", "play", motion="reach"),
            prepared(self.robot, "wheel", "velocities", velocities=[SPEED]),
            prepared(self.robot, "led", "trajectory", points=[point]),
        ]

    def turn(self, servo: int, by_deg: float, at_ms: int = TURNED_MS) -> None:
        def turn() -> None:
            turned = self.bus.servo(servo)
            turn_by_hand(turned, turned.shaft.angle + math.radians(by_deg))

        self.bus.at(at_ms * MS, turn)

    def _sample(self) -> None:
        self.samples.append([self.bus.servo(number).shaft.angle - math.pi for number in (1, 2, 3, 4)])
        self.bus.at(self.bus.now_ns + PERIOD_MS * MS, self._sample)

    def log(self) -> Log:
        assert self.robot.run().reason == "ended"
        return replayed(self.path)

    def shaft(self, servo: int, from_ms: int, to_ms: int = round(1000 * SECONDS)) -> Floats:
        """Return the angles of a shaft in a time, rad."""
        rows = slice(from_ms // PERIOD_MS, to_ms // PERIOD_MS)
        return np.array([sample[servo - 1] for sample in self.samples[rows]])


def restarts(log: Log) -> dict[str, str]:
    begun = "restarted at the measured positions: "
    return {
        event.source: event.text.removeprefix(begun)
        for event in log.events
        if event.code == EventCode.POLICY and event.text.startswith(begun)
    }


def ends(log: Log, controller: str) -> Sequence[str]:
    return [
        event.text for event in log.events if (event.code, event.source) == (EventCode.GOAL_ENDED, controller)
    ]


def test_motions_continue_after_a_pause_in_which_no_joint_was_moved(tmp_path):
    run = Run(tmp_path)
    log = run.log()
    assert restarts(log) == {}
    for servo in (ARM, OTHER, LED):
        assert run.shaft(servo, RESUMED_MS)[-1] == pytest.approx(REACH, abs=math.radians(3))
    assert np.ptp(run.shaft(WHEEL, RESUMED_MS + 1000, RESUMED_MS + 2000)) > 0.9 * SPEED
    assert [end.split()[2] for name in ("arm", "led") for end in ends(log, name)] == ["reached:"] * 2


def test_joint_that_was_limp_in_a_pause_waits_there_for_a_command(tmp_path):
    run = Run(tmp_path)
    run.at(OFF_MS, torque(["arm"], on=False))
    run.turn(ARM, -60.0)
    run.at(ON_MS, torque(["arm"], on=True))
    run.at(AGAIN_MS, run.commands()[0])
    log = run.log()
    assert restarts(log) == {"arm": "arm regained torque"}
    assert ends(log, "arm")[0] == "goal 1 aborted: arm regained torque"
    assert np.ptp(run.shaft(ARM, TURNED_MS + PERIOD_MS, AGAIN_MS)) <= 2 * TICK
    again = run.shaft(ARM, AGAIN_MS)
    assert np.ptp(again) > 10 * TICK
    assert np.abs(np.diff(again))[:40].max() < 1.2 * SLOW_SPEED * PERIOD_MS * 1e-3
    assert np.ptp(run.shaft(WHEEL, RESUMED_MS + 1000, RESUMED_MS + 2000)) > 0.9 * SPEED


@pytest.mark.parametrize(("servo", "name"), [(WHEEL, "wheel"), (LED, "led")])
@pytest.mark.parametrize("by_deg", [-30.0, 30.0])
def test_joint_without_a_position_goal_that_was_turned_in_a_pause_waits_there(tmp_path, servo, name, by_deg):
    run = Run(tmp_path)
    run.turn(servo, by_deg)
    run.at(AGAIN_MS, *run.commands()[1:])
    log = run.log()
    assert restarts(log) == {name: f"{name} moved in the pause"}
    assert np.ptp(run.shaft(servo, TURNED_MS + PERIOD_MS, AGAIN_MS)) <= 2 * TICK
    assert np.ptp(run.shaft(servo, AGAIN_MS)) > 10 * TICK
    if name == "led":
        assert ends(log, name)[0] == "goal 2 aborted: led moved in the pause"


@pytest.mark.parametrize(("servo", "name"), [(WHEEL, "wheel"), (LED, "led")])
def test_joint_that_was_hardly_turned_in_a_pause_continues(tmp_path, servo, name):
    run = Run(tmp_path)
    run.turn(servo, 2.0)
    log = run.log()
    assert restarts(log) == {}
    if name == "led":
        assert run.shaft(LED, RESUMED_MS)[-1] == pytest.approx(REACH, abs=math.radians(3))
    else:
        assert np.ptp(run.shaft(WHEEL, RESUMED_MS + 1000, RESUMED_MS + 2000)) > 0.9 * SPEED


def test_joint_that_follows_a_position_continues_though_it_was_turned_away(tmp_path):
    """Its servo has kept its goal, and brings it back."""
    run = Run(tmp_path)
    run.turn(ARM, -30.0, at_ms=RESUMED_MS - PERIOD_MS)
    assert restarts(run.log()) == {}
    assert run.shaft(ARM, RESUMED_MS)[0] < run.shaft(ARM, TURNED_MS)[0] - math.radians(10)
    assert run.shaft(ARM, RESUMED_MS)[-1] == pytest.approx(REACH, abs=math.radians(3))
