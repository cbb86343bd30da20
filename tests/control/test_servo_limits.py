"""Registers of a servo that limit its goals, in the gate and in plans; runs: run/stories/servo_limits.txt."""

import pytest
from tests.kit.loops import GateRig

from dxlrun.channels.cycle import Clamp
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.plan.loop_plan import JointPlan, ServoLimit
from dxlwire.modes import Mode


def test_a_register_binds_the_steps_only_where_the_file_limits_the_speed():
    slow = ServoLimit("velocity", 2.0, "Velocity Limit (44) = 83, 114 deg/s")
    # a plan has the top speed of the servo where the file has no limit
    for velocity, step in ((None, None), (8.0, 8.0), (4.0, 2.0), (1.0, 1.0)):
        joint = JointPlan("j0", -1, 1, velocity, top_speed=8.0, servo_limits=(slow,))
        assert joint.step_speed == (step or float("inf"))
        assert joint.highest_speed == min(2.0, velocity or 2.0)


def test_goals_without_a_speed_get_the_one_that_the_servo_will_take():
    rig = GateRig(velocity=4.0, top_speed=8.0, accepts=(EventCode.GATE, EventCode.SERVO_LIMITS))
    rig.gate.take_servo_limits({0: (ServoLimit("velocity", 2.0, "Velocity Limit (44) = 83, 114 deg/s"),)})
    assert rig.apply(position=0.02).velocity == 2.0
    assert rig.apply(position=0.02, velocity=3.0).clamped == Clamp.VELOCITY
    assert rig.texts[0].startswith(
        "j0: goals of velocity are held to Velocity Limit (44) = 83, 114 deg/s, tighter"
    )
    assert rig.texts[-1].endswith("clamped by register Velocity Limit (44) = 83, 114 deg/s")


@pytest.mark.parametrize(("velocity", "severity"), [(4.0, Severity.WARNING), (None, Severity.INFO)])
def test_a_register_is_a_warning_only_where_it_is_tighter_than_the_file(velocity, severity):
    rig = GateRig(velocity=velocity, top_speed=8.0, accepts=(EventCode.SERVO_LIMITS,))
    rig.gate.take_servo_limits({0: (ServoLimit("velocity", 2.0, "Velocity Limit (44) = 83, 114 deg/s"),)})
    assert rig.severities == [severity]


@pytest.mark.parametrize(
    ("mode", "interface"), [(Mode.EFFORT, "effort"), (Mode.PWM, "pwm"), (Mode.VELOCITY, "velocity")]
)
def test_the_files_limit_is_named_where_it_is_the_tighter_one(mode, interface):
    rig = GateRig(
        mode=mode, effort=0.1, velocity=0.1, top_speed=8.0, accepts=(EventCode.GATE, EventCode.SERVO_LIMITS)
    )
    rig.gate.take_servo_limits({0: (ServoLimit(interface, 1.0, "a register"),)})
    assert rig.texts == []
    rig.apply(**{interface: 5.0})
    assert "a register" not in rig.texts[-1]


def test_a_limit_of_the_manual_is_not_described_as_one_of_the_register():
    joint = JointPlan("j", -1, 1, None, top_effort=3.0, servo_limits=(ServoLimit("effort", 3.0, "x"),))
    assert joint.find_servo_limit("effort") is None
    assert joint.highest_effort == 3.0
    tight = JointPlan(
        "j", -1, 1, None, effort=2.0, top_effort=3.0, servo_limits=(ServoLimit("effort", 1.0, "x"),)
    )
    assert tight.describe_servo_limit(tight.servo_limits[0]).startswith(
        "goals of effort are held to x, tighter"
    )
