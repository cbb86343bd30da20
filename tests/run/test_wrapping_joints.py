"""Every standard controller that takes positions: a joint with `wrap: true` goes the shorter way."""

import itertools
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.laws import chain_of
from tests.kit.line_faults import turn_by_hand
from tests.kit.virtual_run import VirtualRun
from tests.run.test_torque_matrix import Steered, steered

from dxlrun import nearest_turn
from dxlrun.channels.cycle import Floats
from dxlsim.servo.simulated_servo import SimulatedServo

STEP = math.radians(2)
MOST = math.radians(45)
"""A law of efforts or velocities may overshoot; the longer way is 358 deg."""
MOTOR = Path(__file__).parents[2] / "robots/motors/XM430-W350.motor.yaml"


def sent_to(value: Any, goal: float, key: str = "") -> Any:
    """Return the content of a command, or a controller's keys, with this goal for each position."""
    if isinstance(value, dict):
        return {
            name: f"{goal} rad" if key == "pose" else sent_to(one, goal, name)
            for name, one in value.items()
            if not (name == "velocities" and "time" in value)
        }
    if key in ("positions", "rows") and isinstance(value, list):
        return [sent_to(one, goal, key) if isinstance(one, list) else goal for one in value]
    if isinstance(value, list | tuple):
        return [sent_to(one, goal) for one in value]
    return goal if key == "position" else value


@cache
def ways() -> tuple[Steered, ...]:
    """Return the standard controllers that take positions, or follow those of a leader."""
    offered = (one for one in steered() if not {"position", "effort"} <= {*one.interfaces})  # if continuous
    return tuple(one for one in offered if one.leader or _takes_positions(one))


def _takes_positions(one: Steered) -> bool:
    if one.case.keys.get("command_interface") in ("velocity", "effort", "pwm") and "sample" in one.case.type:
        return False
    return any(kind == "play" or sent_to(data, 0.0) != data for kind, data in one.asks)


def _exact() -> list[Steered]:
    """Return the ways that command positions to servos, without a law that overshoots."""
    own = (one for one in ways() if "position" in one.interfaces and not one.case.into)
    return [one for one in own if one.case.type != "pid_controller"]


class Story(VirtualRun):
    """A robot with a joint for each way, and clients that command all of them at 0.5 s."""

    def __init__(self, folder: Path, ratio: int) -> None:
        self.begin = math.radians(180 / ratio - 1)
        self.goal = self.begin + STEP - math.tau
        joints, controllers = {}, {}
        ids = itertools.count(1)
        line = "port: sim, protocol: 2.0, baud_rate: 4_000_000, adapter: {kind: direct}"
        line += ", return_delay_time: 0 us"
        common = "model: XM430-W350, reference: 180 deg, direction: 1, motor: XM430-W350.motor.yaml"
        common += ", simulation: {inertia: 0.005 kg m^2, gravity: 0 Nm}"
        for one in ways():
            controllers |= one.controllers
            (joint,) = one.joints
            joints[joint] = f"{common}, id: {next(ids)}, gear_ratio: {ratio}, continuous: true, wrap: true"
            joints[joint] += ", limits: {velocity: 2 rad/s}"
            if one.leader:
                joints[one.leader] = f"{common}, id: {next(ids)}, torque: off"
        lines = [line for line in MOTOR.read_text().splitlines() if not line.startswith("load:")]
        (folder / MOTOR.name).write_text("\n".join(lines))
        weights = [one.joints[0] for one in ways() if one.case.type == "gravity_compensation"]
        (folder / "wrap.urdf").write_text(chain_of(weights).replace('mass value="0.1"', 'mass value="1e-9"'))
        text = "\n".join((
            "name: wrapping",
            f"buses: {{main: {{{line}}}}}",
            "loop: {rate: 50}",
            "joints:",
            *(f"  {name}: {{bus: main, {joint}}}" for name, joint in joints.items()),
            "controllers:",
            *(f"  {name}: {json.dumps(sent_to(keys, self.goal))}" for name, keys in controllers.items()),
            "model: {urdf: wrap.urdf}",
        ))  # fmt: skip
        (folder / "robot.yaml").write_text(text)
        super().__init__(folder / "robot.yaml", duration_s=4.5)
        for one in ways():
            turn_by_hand(self.servos[one.joints[0]], math.pi + self.begin * ratio)
            if one.leader:
                turn_by_hand(self.servos[one.leader], math.pi - nearest_turn(self.goal, 0.0))
            for kind, data in one.asks:
                self.command(500, one.top, kind, sent_to(data, self.goal))
        self.ratio = ratio
        self.sample(self.followers, 20, 500)

    @property
    def followers(self) -> list[SimulatedServo]:
        return [self.servos[one.joints[0]] for one in ways()]

    @property
    def turned(self) -> Floats:
        """The way of each joint since the begin, rad, a row each sample."""
        angles = np.array([self.shaft(servo) for servo in self.followers]).T
        return (angles - math.pi) / self.ratio - self.begin


def test_each_standard_controller_that_takes_positions_is_in_the_matrix() -> None:
    assert {one.case.type for one in steered()} - {one.case.type for one in ways()} == {
        "cartesian_controller",  # by poses; the positions are those of its solver
        "diff_drive_controller",
        "joint_group_effort_controller",
        "joint_group_poseffort_controller",  # not offered for a continuous joint
        "joint_group_pwm_controller",
        "joint_group_velocity_controller",
        "joint_position_controller",  # by velocities in its case; it is the pid_controller
    }


@pytest.mark.parametrize("ratio", [1, 2])
def test_joint_that_wraps_takes_the_shorter_way(tmp_path: Path, ratio: int) -> None:
    story = Story(tmp_path, ratio)

    story.run()

    turned = story.turned
    for one, farthest, last in zip(ways(), np.abs(turned).max(axis=0), turned[-1], strict=True):
        assert farthest < MOST, f"{one.case.name}: {math.degrees(farthest):.1f} deg"
        if one in _exact():
            assert last == pytest.approx(STEP, abs=math.radians(1)), one.case.name
    exact = {one.top for one in _exact()}
    assert [one.sentence for one in story.events.goals.failed if one.controller in exact] == []
