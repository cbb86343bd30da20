"""What moves the joints of a robot, in the plan and in its simulation: a servo's own joint is 1 x 1."""

from __future__ import annotations

import math

import pytest

from dxlrun.compile.simulation import simulation_of


def test_every_servo_is_in_one_mechanism_and_every_joint_too(plan):
    compiled = plan()
    names = [joint.name for joint in compiled.loop.joints]
    found = compiled.mechanics.mechanisms(len(names))
    assert sorted(row for one in found for row in one.servos) == list(range(6))
    assert sorted(row for one in found for row in one.joints) == list(range(len(names)))
    own = {names[one.joints[0]]: (one.matrix, one.inverse) for one in found if one.own}
    assert own == dict.fromkeys(("head", "gripper"), (((1.0,),), ((1.0,),)))
    assert {one.name for one in found if not one.own} == {"hip", "wrist"}


def test_the_simulation_has_the_mechanisms_of_the_plan(plan):
    simulated = simulation_of(plan()).mechanisms
    assert [(one.joints, len(one.servos), one.is_single) for one in simulated] == [
        (("head",), 1, True),
        (("gripper",), 1, True),
        (("hip",), 2, False),
        (("pitch", "roll"), 2, False),
    ]


def test_servo_of_a_transmission_reaches_all_corners_of_its_joints(plan):
    (bus,) = plan().buses
    left, right = (servo for servo in bus.servos if servo.joint.startswith("wrist"))
    for servo in (left, right):
        ends = [(tick - 2048) * servo.rad_per_tick for tick in (servo.lower_tick, servo.upper_tick)]
        assert [round(math.degrees(end)) for end in ends] == [-105, 105], "45 deg of pitch and 60 of roll"
    (head,) = (servo for servo in bus.servos if servo.joint == "head")
    assert math.degrees((head.upper_tick - 2048) * head.rad_per_tick) == pytest.approx(80, abs=0.1)
