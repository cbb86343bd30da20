import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels.cycle import Commands
from dxlrun.dynamixel.exchange.goals import GoalArrays
from dxlrun.dynamixel.wire import protocol1

angles = st.floats(-10, 10) | st.just(float("nan"))
speeds = st.floats(-100, 100) | st.sampled_from([float("nan"), 0.0, -0.0])


@given(
    positions=st.lists(angles, min_size=8, max_size=8), velocities=st.lists(speeds, min_size=8, max_size=8)
)
@settings(max_examples=100, deadline=None)
def test_the_sync_write_is_what_the_units_of_one_servo_say(plan8, positions, velocities, ticks):
    goals = Commands(np.array([positions, velocities, [np.nan] * 8, [np.nan] * 8]))
    included = np.array([True, False] + [True] * 6)
    packets = list(GoalArrays(plan8).packets(goals, included))
    expected = {
        servo.servo_id: ticks.position(servo, positions[servo.row]).to_bytes(2, "little")
        + ticks.speed(servo, velocities[servo.row]).to_bytes(2, "little")
        for index, servo in enumerate(plan8.servos)
        if included[index] and positions[servo.row] == positions[servo.row]
    }
    assert packets == ([protocol1.sync_write(30, 4, expected)] if expected else [])


@pytest.fixture(scope="module")
def plan8(module_plan):
    return module_plan


def test_a_smaller_packet_after_a_bigger_one_is_whole(plan8):
    arrays, goals = GoalArrays(plan8), Commands(np.array([[0.0] * 8, [1.0] * 8, [0.0] * 8, [0.0] * 8]))
    (everybody,) = arrays.packets(goals, np.ones(8, dtype=bool))
    (one,) = arrays.packets(goals, np.arange(8) == 7)
    goals.position[:] = 0.1
    list(arrays.packets(goals, np.ones(8, dtype=bool)))
    goals.position[:] = 0.0
    (again,) = arrays.packets(goals, np.ones(8, dtype=bool))
    assert protocol1.parse_status(one).parameters[:3] == bytes((30, 4, 21))
    assert len(one) == 13
    assert again == everybody
