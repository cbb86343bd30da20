import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.compile.reach import Interval, degrees, joint_reach

TRAVEL = math.radians(300)


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
@given(theta=st.floats(0, TRAVEL), reference=st.floats(0, TRAVEL), direction=st.sampled_from([-1, 1]))
def test_every_angle_of_the_servo_lies_in_the_reach(theta: float, reference: float, direction: int):
    q = direction * (theta - reference)

    assert joint_reach(TRAVEL, reference, direction).contains(Interval(q, q))


def test_degrees_are_short_and_have_no_negative_zero():
    assert degrees(math.radians(60)) == "60"
    assert degrees(math.radians(60), signed=True) == "+60"
    assert degrees(-1e-9, signed=True) == "0"
    assert degrees(1.77) == "101.41"


def test_intervals_meet_only_in_more_than_a_point():
    assert Interval(0, 2).meet(Interval(1, 3)) == Interval(1, 2)
    assert Interval(0, 1).meet(Interval(1, 3)) is None
