import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.robots import compile_text

from dxlrun.compile.joints.compiled_servos import joint_reach, servo_travel
from dxlrun.compile.joints.limits import Interval, degrees
from dxlwire.control_table import all_tables, find_table

AX = find_table("AX-12A")
TRAVEL = servo_travel(AX)
INSIDE = st.floats(TRAVEL.lower, TRAVEL.upper)

SPAN = """\
name: span
buses:
  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 0 ms}}}}
loop: {{rate: 50}}
joints:
  left_arm_joint: {{bus: main, id: 1, model: "{model}", reference: {left:.12f} rad, direction: 1}}
  right_arm_joint: {{bus: main, id: 2, model: "{model}", reference: {right:.12f} rad, direction: -1}}
controllers:
  states: {{type: joint_state_broadcaster}}
"""


@pytest.mark.parametrize(
    "table", [table for table in all_tables() if not table.firmware], ids=lambda table: table.model
)
def test_a_joint_reaches_every_goal_position_of_its_model(table):
    low, high = table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick
    left = low + 0.25 * (high - low)
    text = SPAN.format(protocol=table.protocol, model=table.model, left=left, right=low + high - left)
    compiled = compile_text(text)
    for servo in compiled.plan.buses[0].servos:
        assert (servo.lower_tick, servo.upper_tick) == (table.min_tick, table.max_tick)
    for joint in compiled.plan.loop.joints:
        assert (joint.lower, joint.upper) == pytest.approx((low - left, high - left))
    assert compiled.warnings == (), "the reference is in the travel, and the twins are mirror images"


def test_a_reference_outside_of_a_travel_to_both_sides_of_0_is_a_warning():
    def warnings(left):
        text = SPAN.format(protocol=2.0, model="PH54-200-S500", left=left, right=-left)
        return [each.what for each in compile_text(text).warnings]

    assert warnings(-3.1) == []
    assert len(warnings(-3.2)) == 2
    assert "(-180..180 deg), so the joint cannot reach 0" in warnings(-3.2)[0]


@pytest.mark.parametrize(
    ("reference", "direction", "reach"),
    [  # the table of the thesis' torso
        (60, -1, (-240, 60)),
        (150, -1, (-150, 150)),
        (240, 1, (-240, 60)),
        (150, 1, (-150, 150)),
    ],
)
def test_reach_of_an_ax_12(reference: int, direction: int, reach: tuple[int, int]):
    interval = joint_reach(TRAVEL, math.radians(reference), direction)

    assert (math.degrees(interval.lower), math.degrees(interval.upper)) == pytest.approx(reach)


@settings(max_examples=50, deadline=None)
@given(theta=INSIDE, reference=INSIDE, direction=st.sampled_from([-1, 1]))
def test_every_angle_of_the_servo_lies_in_the_reach(theta: float, reference: float, direction: int):
    q = direction * (theta - reference)

    assert joint_reach(TRAVEL, reference, direction).contains(Interval(q, q))


def test_degrees_are_short_and_have_no_negative_zero():
    assert degrees(math.radians(60)) == "60"
    assert degrees(-1e-9) == "0"
    assert degrees(1.77) == "101.41"


def test_intervals_meet_only_in_more_than_a_point():
    assert Interval(0, 2).meet(Interval(1, 3)) == Interval(1, 2)
    assert Interval(0, 1).meet(Interval(1, 3)) is None
