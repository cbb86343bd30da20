"""Wolfgang of the Bit-Bots: the team's own configuration as a robot file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dxlrun.testing import simulated_robot
from dxlwire.control_table import find_table
from dxlwire.control_table.device_models import device_table

WOLFGANG = Path(__file__).parents[2] / "robots" / "wolfgang.yaml"
MX_64, MX_106, XH540 = 311, 321, 1100
SERVOS = {
    "RShoulderPitch": (1, MX_64, "arms", 800),
    "LShoulderPitch": (2, MX_64, "arms", 800),
    "RShoulderRoll": (3, MX_64, "arms", 800),
    "LShoulderRoll": (4, MX_64, "arms", 800),
    "RElbow": (5, MX_64, "arms", 800),
    "LElbow": (6, MX_64, "arms", 800),
    "RHipYaw": (7, MX_106, "right_leg", 1200),
    "LHipYaw": (8, MX_106, "left_leg", 1200),
    "RHipRoll": (9, MX_106, "right_leg", 1200),
    "LHipRoll": (10, MX_106, "left_leg", 1200),
    "RHipPitch": (11, MX_106, "right_leg", 1200),
    "LHipPitch": (12, MX_106, "left_leg", 1200),
    "RKnee": (13, XH540, "right_leg", 4000),
    "LKnee": (14, XH540, "left_leg", 4000),
    "RAnklePitch": (15, MX_106, "right_leg", 1200),
    "LAnklePitch": (16, MX_106, "left_leg", 1200),
    "RAnkleRoll": (17, MX_106, "right_leg", 1200),
    "LAnkleRoll": (18, MX_106, "left_leg", 1200),
    "HeadPan": (19, MX_64, "head", 500),
    "HeadTilt": (20, MX_64, "head", 500),
}
"""ID, model number, bus and P gain, as the team's wolfgang.yaml and wolfgang_core.rst have them."""
DEVICES = {"core": (42, 0xABBA, "arms"), "imu": (241, 0xBAFF, "head")}


def test_it_has_the_servos_and_boards_of_the_team_and_runs():
    robot = simulated_robot(WOLFGANG, arguments={"rate": "100"}, duration_s=0.3)
    found = {
        servo.joint: (
            servo.servo_id,
            find_table(servo.model, 2.0).model_number,
            bus.name,
            servo.declared["position_p_gain"],
        )
        for bus in robot.plan.buses
        for servo in bus.servos
    }
    assert found == SERVOS
    assert {
        device.name: (device.servo_id, device_table(device.model).model_number, bus.name)
        for bus in robot.plan.buses
        for device in bus.devices
    } == DEVICES
    for servo in (servo for bus in robot.plan.buses for servo in bus.servos):
        assert (servo.reference, servo.direction) == (pytest.approx(math.pi), 1)
    result = robot.run()
    assert (result.reason, result.detail, result.skipped, robot.failures) == ("ended", "", 0, ())
    assert robot.record.sources.valid.all()
    assert [event.code for event in robot.events.errors] == []
    names = [f"{one}/{each}" for one, states in robot.plan.loop.source_states.items() for each in states]
    values = dict(zip(names, robot.record.sources.values.tolist(), strict=True))
    assert values["imu/orientation.w"] == 1.0
    assert values["core/voltage"] == pytest.approx(12.0, abs=0.02)


def test_the_buses_allow_the_teams_rate_at_two_megabits():
    fast = simulated_robot(WOLFGANG, arguments={"rate": "500", "baud": "2_000_000"})
    assert min(bus.budget.highest_rate_hz for bus in fast.plan.buses) > 500
    slow = simulated_robot(WOLFGANG)
    rates = {bus.name: bus.budget.highest_rate_hz for bus in slow.plan.buses}
    assert {name for name, rate in rates.items() if rate < 500} == {"right_leg", "left_leg", "arms"}
